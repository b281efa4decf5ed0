"""Exported layers of dialects: the same results in onnxruntime, OpenCV 5 and PyTorch, at other sizes too."""

import re
from collections.abc import Callable, Mapping

import cv2
import numpy as np
import pytest

from case_files import read_cases
from exported import (
    ONNX_EXTRA,
    assert_same,
    here,
    in_onnxruntime,
    in_opencv,
    onnx_model,
    other_inputs,
    random_inputs,
    run_module,
    source_module,
    trained,
)
from netspec import use_dialect
from netspec.export.formats.onnx import onnx_definition
from netspec.export.formats.shapes import find_shapes
from netspec.net.net import Net

pytestmark = pytest.mark.slow

pytest.importorskip("onnx", reason=ONNX_EXTRA)
OPENCV_5 = int(cv2.__version__.split(".")[0]) >= 5
Shape = tuple[int, ...]


def net_text(layer: str, shapes: Mapping[str, Shape], tops: int = 1) -> str:
    inputs = "".join(
        f'layer {{ name: "{blob}" type: "Input" top: "{blob}" input_param {{ shape {{ '
        f"{' '.join(f'dim: {size}' for size in shape)} }} }} }}\n"
        for blob, shape in shapes.items()
    )
    bottoms = " ".join(f'bottom: "{blob}"' for blob in shapes)
    made = " ".join(f'top: "top{i}"' for i in range(tops))
    return f'{inputs}layer {{ name: "it" {layer} {bottoms} {made} }}'


CASES = read_cases("netspec/export/cases/dialects.txt")
NAMES = re.compile(r'\b(name|bottom|top): "([^"]+)"')


@pytest.mark.parametrize("dialect", sorted({case["dialect"] for case in CASES.values()}))
def test_exported_layers_compute_the_same(dialect: str, net_of: Callable[..., Net]) -> None:
    """Those whose sizes are free are one net, the others another. An export of one takes nearly as long."""
    use_dialect(dialect)
    of_dialect = [case["net"] for case in CASES.values() if case["dialect"] == dialect]
    texts = [NAMES.sub(rf'\1: "\2_{k}"', text) for k, text in enumerate(of_dialect)]
    fixed = [bool(onnx_definition(net_of(text))[1].fixed) for text in texts]
    for kind in sorted(set(fixed)):
        net = trained(net_of("".join(text for text, its in zip(texts, fixed, strict=True) if its == kind)))
        inputs = random_inputs(net)
        model, _ = onnx_model(net)
        module = source_module(net)
        for given in (inputs, other_inputs(net, find_shapes(net), inputs)):
            expected = here(net, given)
            assert_same(in_onnxruntime(model, given), expected)
            assert_same(run_module(module, net, given), expected)
            if OPENCV_5:
                assert_same(in_opencv(model, given), expected, scalars_have_an_axis=True)


def detections(
    net_of: Callable[..., Net], settings: str, images: int, priors: int, kinds: int
) -> tuple[Net, dict[str, np.ndarray]]:
    """Return a net of one DetectionOutput over 3 classes, and predictions that overlap, some scores being equal.

    With keep_top_k all scores differ: exports keep the first of equal ones, the layer those that std::sort has first.
    """
    use_dialect("ssd")
    shapes = {"loc": (images, 4 * priors * kinds), "conf": (images, 3 * priors), "prior": (1, 2, 4 * priors)}
    net = net_of(net_text(f"type: 'DetectionOutput' detection_output_param {{ num_classes: 3 {settings} }}", shapes))
    rng = np.random.default_rng(3)
    low = rng.uniform(0, 0.7, (priors, 2))
    boxes = np.concatenate([low, low + rng.uniform(0.1, 0.3, (priors, 2))], axis=1)
    prior = np.stack([boxes, np.full((priors, 4), 0.1)]).reshape(shapes["prior"])
    scores = rng.integers(0, 40, shapes["conf"]) / 40
    if "keep_top_k" in settings:
        scores = rng.permutation(scores.size).reshape(scores.shape) / scores.size
    given = {"loc": rng.standard_normal(shapes["loc"]) / 3, "conf": scores, "prior": prior}
    return net, {name: values.astype(np.float32) for name, values in given.items()}


DETECTIONS = {
    "as SSD": "nms_param { nms_threshold: 0.45 top_k: 30 } keep_top_k: 20 confidence_threshold: 0.1 "
    "code_type: CENTER_SIZE",
    "most": "nms_param { nms_threshold: 0.5 } code_type: CENTER_SIZE confidence_threshold: 0.01",
    "all classes": "nms_param { nms_threshold: 0.3 } keep_top_k: 9 code_type: CENTER_SIZE background_label_id: -1",
    "nothing": "nms_param { nms_threshold: 0.3 } confidence_threshold: 2 keep_top_k: 5 code_type: CENTER_SIZE",
    "corners": "nms_param { nms_threshold: 0.4 } code_type: CORNER confidence_threshold: 0.2",
    "own boxes": "share_location: false nms_param { nms_threshold: 0.4 top_k: 20 } keep_top_k: 12 "
    "code_type: CENTER_SIZE confidence_threshold: 0.05",
}


@pytest.mark.parametrize("name", DETECTIONS)
def test_detection_output_computes_the_same(name: str, net_of: Callable[..., Net]) -> None:
    settings = DETECTIONS[name]
    net, inputs = detections(net_of, settings, 2, 60, 3 if "false" in settings else 1)
    model, _ = onnx_model(net)
    module = source_module(net)
    one = {blob: x[:1] for blob, x in inputs.items()}
    for given in (inputs, one):
        expected = here(net, given)
        assert (expected["top0"].shape[2] > len(given["loc"])) == (name != "nothing")
        assert_same(in_onnxruntime(model, given), expected)
        if OPENCV_5 and "confidence_threshold" in settings:  # its suppression takes no threshold below 0
            assert_same(in_opencv(model, given), expected)
        assert_same(run_module(module, net, given), expected)
