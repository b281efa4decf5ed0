"""Every layer in ONNX: the same numbers in onnxruntime and in OpenCV 5, at other batches and sizes too."""

from pathlib import Path

import cv2
import pytest

from each import each
from exported import ONNX_EXTRA, assert_same, golden_net, here, in_onnxruntime, in_opencv, other_inputs
from netspec.export.formats.onnx import onnx_model
from netspec.export.formats.shapes import find_shapes
from paths import GOLDEN

CASES = sorted((GOLDEN / "layers").iterdir())
pytest.importorskip("onnx", reason=ONNX_EXTRA)
OPENCV_5 = int(cv2.__version__.split(".")[0]) >= 5


@pytest.mark.slow
@each("case", CASES, lambda path: path.name)
def test_golden_layer_computes_the_same_in_onnxruntime_and_opencv_and_at_other_sizes(case: Path) -> None:
    net, inputs = golden_net(case)
    model, _ = onnx_model(net)
    expected = here(net, inputs)
    assert_same(in_onnxruntime(model, inputs), expected)
    if OPENCV_5 and expected:
        assert_same(in_opencv(model, inputs), expected, scalars_have_an_axis=True)
    names = {size.dim_param for value in model.graph.input for size in value.type.tensor_type.shape.dim}
    net, inputs = golden_net(case)  # a recurrent net remembers what it saw
    shapes = find_shapes(net)
    for free in shapes.free:
        if free.name not in names:
            shapes = shapes.without(free, "")
    inputs = other_inputs(net, shapes, inputs)
    assert_same(in_onnxruntime(model, inputs), here(net, inputs))
