"""ONNX models: names, dynamic sizes, notes, preprocessing, large weights, results of every layer and of real nets."""

import re
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import netspec
from exported import (
    ONNX_EXTRA,
    assert_same,
    golden_net,
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
from golden_cases import set_parameters
from netspec import use_dialect
from netspec.errors import SpecError
from netspec.export.formats.onnx import export_onnx, onnx_definition
from netspec.export.formats.preprocess import Preprocess
from netspec.export.formats.shapes import find_shapes
from netspec.export.formats.torch import export_torch
from netspec.net.net import Net
from netspec.proto.schema import PHASES
from netspec.proto.text import parse_net
from netspec.proto.writer import write_text
from netspec.terminal.commands import Interrupted, interruptible
from paths import GOLDEN, ROOT, shared

pytestmark = pytest.mark.slow

onnx: Any = pytest.importorskip("onnx", reason=ONNX_EXTRA)
OPENCV_5 = int(cv2.__version__.split(".")[0]) >= 5
IMAGE = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 12 dim: 10 } } }\n'
CONV = """layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
  convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
"""
# The recurrent layer is in line 3.
RECURRENT = """layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 3 dim: 2 dim: 4 } } }
  layer { name: "cont" type: "Input" top: "cont" input_param { shape { dim: 3 dim: 2 } } }
  layer { name: "r" type: "%s" bottom: "x" bottom: "cont" top: "r" %s
    recurrent_param { num_output: 5 expose_hidden: %s weight_filler { type: "xavier" } } }
"""


def names_of(model: Any) -> list[str]:
    return [name for node in model.graph.node for name in node.output]


def sizes_of(values: object) -> dict[str, list[object]]:
    return {v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in values}  # type: ignore


def test_values_have_the_names_of_blobs(net_of: Callable[..., Net]) -> None:
    text = """layer { name: "relu" type: "ReLU" bottom: "conv" top: "conv" }
    layer { name: "drop" type: "Dropout" bottom: "conv" top: "dropped" }
    layer { name: "a" type: "AbsVal" bottom: "dropped" top: "a" }
    layer { name: "b" type: "Sigmoid" bottom: "dropped" top: "b" }"""
    model, _ = onnx_model(net_of(IMAGE + CONV + text))
    assert names_of(model) == ["conv_of_conv", "conv", "a", "b"]  # and no Dropout or Split
    assert [v.name for v in model.graph.output] == ["a", "b"]
    props = {each.key: each.value for each in model.metadata_props}
    assert props["netspec.blobs"] == '{"conv_of_conv": "blob \\"conv\\" after layer \\"conv\\""}'


def test_an_input_that_is_changed_in_place_keeps_its_name(net_of: Callable[..., Net]) -> None:
    net = net_of(IMAGE + 'layer { name: "relu" type: "ReLU" bottom: "data" top: "data" }' + CONV)
    model, _ = onnx_model(net)
    assert [v.name for v in model.graph.input] == ["data"]
    inputs = random_inputs(net)
    assert_same(in_onnxruntime(model, inputs), here(net, inputs))


def test_batch_height_and_width_are_free_where_the_net_allows_it(net_of: Callable[..., Net]) -> None:
    model, notes = onnx_model(net_of(IMAGE + CONV))
    assert notes == []
    assert sizes_of(model.graph.input) == {"data": ["N", 3, "H", "W"]}
    assert sizes_of(model.graph.output) == {"conv": ["N", 4, "conv_2", "conv_3"]}


def test_a_note_names_the_layer_that_fixes_a_size(net_of: Callable[..., Net]) -> None:
    text = 'layer { name: "ip" type: "InnerProduct" bottom: "conv" top: "ip" inner_product_param { num_output: 2 } }'
    model, notes = onnx_model(net_of(IMAGE + CONV + text))
    assert sizes_of(model.graph.input) == {"data": ["N", 3, 12, 10]}
    assert len(notes) == 2
    assert notes[0].startswith("the height is fixed at 12: net.prototxt:4:")
    assert notes[0].endswith('layer "ip" (InnerProduct) accepts no other size'), "not the shape that was tried"


@pytest.mark.parametrize(("layer_type", "state"), [("RNN", "h"), ("LSTM", "h, c")])
@pytest.mark.parametrize("target", ["ONNX", "PyTorch source"])
def test_a_note_reports_that_recurrent_state_starts_at_zero(
    net_of: Callable[..., Net], tmp_path: Path, target: str, layer_type: str, state: str
) -> None:
    net = net_of(RECURRENT % (layer_type, "", "false"))
    notes = export_onnx(net, tmp_path / "net.onnx") if target == "ONNX" else export_torch(net, tmp_path / "net.py")
    note = (
        f'net.prototxt:3:3: layer "r" ({layer_type}): its state ({state}) starts at zero in every run; '
        "in Caffe it continues in the next run if cont is 1"
    )
    assert note in notes


def test_no_note_is_given_if_the_state_is_an_input_and_an_output(net_of: Callable[..., Net]) -> None:
    text = RECURRENT % ("RNN", 'bottom: "h0" top: "h1"', "true")
    state = 'layer { name: "h0" type: "Input" top: "h0" input_param { shape { dim: 1 dim: 2 dim: 5 } } }'
    assert not any("starts at zero" in note for note in onnx_model(net_of(state + text))[1])


def test_a_reshape_with_a_fixed_batch_equals_caffes(net_of: Callable[..., Net]) -> None:
    text = """layer { name: "flat" type: "Reshape" bottom: "conv" top: "flat"
      reshape_param { shape { dim: 1 dim: -1 dim: 4 } } }"""
    net = net_of(IMAGE + CONV + text)
    model, _ = onnx_model(net)
    inputs = {"data": np.random.default_rng(0).standard_normal((3, 3, 12, 10)).astype(np.float32)}
    expected = here(net, inputs)
    assert expected["flat"].shape == (1, 240, 4)
    assert_same(in_onnxruntime(model, inputs), expected)


POOLS = [(2, 2, 0), (3, 2, 0), (3, 2, 1), (2, 2, 1), (3, 3, 1), (5, 3, 2), (3, 1, 1), (4, 3, 2), (5, 4, 1)]


@pytest.mark.parametrize("method", ["MAX", "AVE", "STOCHASTIC"])
def test_pooling_has_caffes_windows_at_every_size(method: str, net_of: Callable[..., Net]) -> None:
    layers = [
        f'layer {{ name: "{mode}{i}" type: "Pooling" bottom: "data" top: "{mode}{i}" pooling_param {{ pool: {method} '
        f"kernel_size: {kernel} stride: {stride} pad: {pad * (method != 'STOCHASTIC')} round_mode: {mode} }} }}"
        for i, (kernel, stride, pad) in enumerate(POOLS)
        for mode in ("CEIL", "FLOOR")
    ]
    net = net_of(IMAGE + "\n".join(layers))
    model, _ = onnx_model(net)
    module = source_module(net)
    rng = np.random.default_rng(0)
    for height, width in ((12, 10), (7, 8), (9, 13), (11, 6), (5, 5)):
        inputs = {"data": rng.uniform(-1, 1, (2, 3, height, width)).astype(np.float32)}
        if method == "STOCHASTIC":
            inputs = {"data": np.abs(inputs["data"])}
        expected = here(net, inputs)
        assert_same(in_onnxruntime(model, inputs), expected)
        assert_same(run_module(module, net, inputs), expected)
        if OPENCV_5:
            assert_same(in_opencv(model, inputs), expected)


@pytest.mark.parametrize("kind", ["Convolution", "Im2col", "Deconvolution"])
def test_padded_filters_of_one_pixel_compute_the_same(kind: str, net_of: Callable[..., Net]) -> None:
    outputs = "" if kind == "Im2col" else "num_output: 8"
    settings = f"convolution_param {{ {outputs} kernel_size: 1 pad_h: 1 pad_w: 2 }}"
    net = trained(net_of(IMAGE + f'layer {{ name: "y" type: "{kind}" bottom: "data" top: "y" {settings} }}'))
    model, _ = onnx_model(net)
    inputs = random_inputs(net)
    assert_same(in_onnxruntime(model, inputs), here(net, inputs))
    if OPENCV_5:
        assert_same(in_opencv(model, inputs), here(net, inputs))


UPSAMPLING = """layer { name: "pool" type: "Pooling" bottom: "data" top: "pool"
  pooling_param { kernel_size: 3 stride: 2 } }
layer { name: "up" type: "Deconvolution" bottom: "pool" top: "up"
  convolution_param { num_output: 3 group: 3 kernel_size: 4 stride: 2 weight_filler { type: "bilinear" } } }
layer { name: "crop" type: "Crop" bottom: "up" bottom: "data" top: "crop" crop_param { axis: 2 offset: 1 } }
layer { name: "sum" type: "Eltwise" bottom: "crop" bottom: "data" top: "sum" }"""


def test_a_net_that_crops_to_its_input_runs_at_other_sizes(net_of: Callable[..., Net]) -> None:
    net = net_of(IMAGE.replace("12", "16") + UPSAMPLING)
    model, notes = onnx_model(net)
    module = source_module(net)
    assert notes == []
    for height, width in ((16, 10), (22, 31), (9, 9)):
        inputs = {"data": np.random.default_rng(0).standard_normal((2, 3, height, width)).astype(np.float32)}
        expected = here(net, inputs)
        assert_same(in_onnxruntime(model, inputs), expected)
        assert_same(run_module(module, net, inputs), expected)
        if OPENCV_5:
            assert_same(in_opencv(model, inputs), expected)


def test_large_weights_are_in_a_file_beside_the_model(net_of: Callable[..., Net], tmp_path: Path) -> None:
    text = 'layer { name: "ip" type: "InnerProduct" bottom: "conv" top: "ip" inner_product_param { num_output: 20 } }'
    net = trained(net_of(IMAGE + CONV + text))
    notes = export_onnx(net, tmp_path / "net.onnx", largest=10_000)
    assert notes[-1] == "the weights are in net.onnx.data, next to the model"
    assert (tmp_path / "net.onnx").stat().st_size < 5_000 < (tmp_path / "net.onnx.data").stat().st_size
    inputs = random_inputs(net)
    assert_same(in_onnxruntime(str(tmp_path / "net.onnx"), inputs), here(net, inputs))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["net.onnx", "net.onnx.data"]


def test_a_signal_waits_for_the_end_of_torchs_export(
    net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []

    def export(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGTERM)
        done.append("the next line")
        raise SpecError("stopped")

    monkeypatch.setattr("torch.export.export", export)
    with pytest.raises(Interrupted), interruptible():
        onnx_model(net_of(IMAGE + CONV))
    assert done


STEPS = {
    "mean": Preprocess(mean=np.array([104, 117, 123], np.float32)),
    "all": Preprocess(mean=np.array([1, 2, 3], np.float32), scale=0.5, raw_scale=255, swap=True),
    "image mean": Preprocess(mean=np.random.default_rng(1).uniform(0, 9, (3, 14, 13)).astype(np.float32), uint8=True),
    "crop": Preprocess(mean=np.array([5], np.float32), crop=True, uint8=True, swap=True),
}
FIXED = (
    CONV + 'layer { name: "ip" type: "InnerProduct" bottom: "conv" top: "ip" inner_product_param { num_output: 2 } }'
)


@pytest.mark.parametrize("name", STEPS)
def test_the_preprocessing_of_images_is_part_of_the_model(name: str, net_of: Callable[..., Net]) -> None:
    steps = STEPS[name]
    net = trained(net_of(IMAGE + FIXED))
    model, _ = onnx_model(net, preprocess=steps)
    size = (15, 13) if steps.crop else (12, 10)
    images = np.random.default_rng(0).integers(0, 256, (2, 3, *size)).astype(np.uint8 if steps.uint8 else np.float32)
    done = images.astype(np.float32)[:, :, 1:13, 1:11] if steps.crop else images.astype(np.float32)
    done = (done[:, ::-1] if steps.swap else done) * np.float32(steps.raw_scale)
    mean = np.asarray(steps.mean)
    mean = mean[:, 1:13, 1:11] if mean.ndim == 3 else mean.reshape(-1, 1, 1)
    expected = here(net, {"data": np.ascontiguousarray((done - mean) * np.float32(steps.scale))})
    assert_same(in_onnxruntime(model, {"data": images}), expected)
    (reported,) = [each.value for each in model.metadata_props if each.key == "netspec.input"]
    assert reported.startswith(f"data: {'uint8' if steps.uint8 else 'float32'} (N, C, H, W), ")


@pytest.mark.parametrize(
    ("steps", "fault"),
    [
        (Preprocess(mean=np.zeros(2)), "the mean has 2 values, expected 1 or 3, one for each channel"),
        (Preprocess(mean=np.zeros((3, 5, 20))), "the mean has shape (3, 5, 20), expected at least (3, 12, 10)"),
    ],
    ids=["channels", "pixels"],
)
def test_a_mean_of_wrong_size_is_refused(steps: Preprocess, fault: str, net_of: Callable[..., Net]) -> None:
    with pytest.raises(SpecError) as caught:
        onnx_model(net_of(IMAGE + FIXED), preprocess=steps)
    assert fault in str(caught.value)


def test_cropping_in_a_net_of_dynamic_size_is_refused(net_of: Callable[..., Net]) -> None:
    with pytest.raises(SpecError, match="the height and width of data are dynamic"):
        onnx_model(net_of(IMAGE + CONV), preprocess=Preprocess(crop=True))


@pytest.mark.parametrize("name", ["siamese_8", "siamese_resnet27_256"])
def test_nets_of_the_paper_compute_the_same(name: str) -> None:
    net = trained(netspec.load_net(ROOT / "prototxt" / "small" / name / "deploy.prototxt", seed=0))
    inputs = random_inputs(net)
    expected = here(net, inputs)
    model, _ = onnx_model(net)
    assert_same(in_onnxruntime(model, inputs), expected)
    if OPENCV_5:
        assert_same(in_opencv(model, inputs), expected)


MODELS = {
    "mtcnn_kp_det1": ("det1.prototxt", "det1.caffemodel", "caffe.npz"),
    "mtcnn_kp_det3": ("det3.prototxt", "det3.caffemodel", "caffe.npz"),
    "ultraface_slim320": ("slim-320.prototxt", "slim-320.caffemodel", "opencv.npz"),
    "wechat_sr": ("sr.prototxt", "sr.caffemodel", "opencv.npz"),
}


@pytest.mark.parametrize("name", MODELS)
def test_real_models_equal_caffe_or_opencv(name: str) -> None:
    folder = shared("golden", "models", name)
    prototxt, weights, golden = MODELS[name]
    use_dialect("blocks")
    net = netspec.load_net(folder / prototxt, weights=folder / weights)
    model, _ = onnx_model(net)
    module = source_module(net)
    stored = np.load(folder / golden)
    for k in sorted({key.split("/")[0] for key in stored.files}):
        inputs = {key.split("/", 2)[2]: stored[key] for key in stored.files if key.startswith(f"{k}/in/")}
        expected = {key.split("/", 2)[2]: stored[key] for key in stored.files if key.startswith(f"{k}/out/")}
        found = in_onnxruntime(model, inputs)
        assert_same(found, here(net, inputs))
        assert_same(run_module(module, net, inputs), here(net, inputs))
        for blob, wanted in expected.items():
            np.testing.assert_allclose(found[blob], wanted, rtol=1e-3, atol=2e-5)
        if OPENCV_5:
            assert_same(in_opencv(model, inputs), here(net, inputs))


# Every layer: the same results in onnxruntime and in OpenCV 5, and in onnxruntime at other batch sizes and sizes
CASES = sorted((GOLDEN / "layers").iterdir())
NAMES = re.compile(r'\b(name|bottom|top): "([^"]+)"')


def golden_nets(cases: Sequence[Path], file: Path, phase: str) -> tuple[Net, dict[str, np.ndarray]]:
    """Return golden nets as one net, and its inputs. An export of one takes nearly as long."""
    net = netspec.load_net(file, phase=phase)
    inputs = {}
    for case in cases:
        golden = np.load(case / "golden.npz")
        named = {re.sub(r"/(\d+)$", rf"_{case.name}/\1", key): golden[key] for key in golden.files}
        set_parameters(net, named, "param_init/")
        inputs |= {f"{key[3:]}_{case.name}": golden[key] for key in golden.files if key.startswith("in/")}
    return net, inputs


@pytest.mark.parametrize("fixed", [False, True], ids=["all sizes free", "others"])
@pytest.mark.parametrize("phase", ["TEST", "TRAIN"])
def test_golden_layers_compute_the_same_in_onnxruntime_and_opencv(phase: str, fixed: bool, tmp_path: Path) -> None:
    found = [(case, golden_net(case)[0]) for case in CASES]
    suited = [case for case, net in found if (net.phase, bool(onnx_definition(net)[1].fixed)) == (PHASES[phase], fixed)]
    for cases in (suited[i : i + 10] for i in range(0, len(suited), 10)):
        file = tmp_path / f"{cases[0].name}.prototxt"
        texts = [
            re.sub(r"(?m)^(name|force_backward):.*$", "", write_text(parse_net(case / "net.prototxt")[0]))
            for case in cases
        ]
        named = [NAMES.sub(rf'\1: "\2_{case.name}"', text) for case, text in zip(cases, texts, strict=True)]
        file.write_text("force_backward: false\n" + "".join(named))
        net, inputs = golden_nets(cases, file, phase)
        model, notes = onnx_model(net)
        assert fixed or not any("is fixed" in note for note in notes)
        expected = here(net, inputs)
        assert_same(in_onnxruntime(model, inputs), expected)
        if OPENCV_5 and expected:
            assert_same(in_opencv(model, inputs), expected, scalars_have_an_axis=True)
        names = {size.dim_param for value in model.graph.input for size in value.type.tensor_type.shape.dim}
        net, inputs = golden_nets(cases, file, phase)  # a recurrent net remembers what it saw
        shapes = find_shapes(net)
        for free in shapes.free:
            if free.name not in names:
                shapes = shapes.without(free, "")
        inputs = other_inputs(net, shapes, inputs)
        assert_same(in_onnxruntime(model, inputs), here(net, inputs))
