"""The differences from OpenCV 4 in docs/coming-from-opencv.md."""

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import netspec
from dnn_program import HERE
from netspec import dnn

INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 4 dim: 4 } } }\n'
DATA = np.random.RandomState(0).rand(1, 3, 4, 4).astype(np.float32)


def read(name: str) -> dnn.Net:
    return dnn.readNetFromCaffe(str(HERE / f"{name}.prototxt"), str(HERE / f"{name}.caffemodel"))


def made(layers: str) -> dnn.Net:
    return dnn.readNetFromCaffe((INPUT + layers).encode())


@pytest.mark.slow
def test_one_line_replaces_the_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "dnn", dnn)
    module: Any = cv2.dnn
    net = module.readNetFromCaffe(str(HERE / "classify.prototxt"), str(HERE / "classify.caffemodel"))
    net.setInput(module.blobFromImage(np.zeros((20, 20, 3), np.uint8), 1.0, (20, 20)))
    assert net.forward().shape == (1, 10)
    assert module.ClassificationModel(net).setInputSize((20, 20)).classify(np.zeros((9, 9, 3), np.uint8))[1] > 0
    assert list(cv2.dnn.NMSBoxes([[0, 0, 9, 9], [1, 1, 9, 9]], [0.9, 0.8], 0.5, 0.4)) == [0]
    with pytest.raises(cv2.error):
        cv2.dnn.readNet("net.unknown")


def test_layers_for_training_are_left_out() -> None:
    net = made(
        'layer { name: "a" type: "Power" bottom: "data" top: "a" include { phase: TRAIN } }'
        'layer { name: "b" type: "Power" bottom: "data" top: "b" include { phase: TEST } }'
    )
    assert net.getLayerNames() == ("b",)


def test_layers_that_opencv_lacks_run() -> None:
    net = made('layer { name: "r" type: "Reduction" bottom: "data" top: "r" reduction_param { axis: 2 } }')
    net.setInput(DATA)
    np.testing.assert_allclose(net.forward(), DATA.sum((2, 3)), rtol=1e-6)


def test_an_unknown_field_is_skipped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    net = made(
        'layer { name: "a" type: "Power" bottom: "data" top: "a" no_such_param { x: 1 }'
        " power_param { scale: 2 no_such: FOO } }"
    )
    net.setInput(DATA)
    np.testing.assert_allclose(net.forward(), 2 * DATA)
    assert '<prototxt>:2:57: layer "a" (Power): skipped: LayerParameter has no field "no_such_param"' in caplog.text
    assert 'skipped: PowerParameter has no field "no_such"' in caplog.text


@pytest.mark.parametrize(
    "param", ["convolution_param { num_output: 1 kernel_size: 3", "pooling_param { kernel_size: 2"]
)
def test_an_unknown_field_of_a_window_is_refused(param: str) -> None:
    kind = "Convolution" if "output" in param else "Pooling"
    with pytest.raises(dnn.DnnError, match=r'^<prototxt>:2:\d+: .*has no field "no_such"'):
        made(f'layer {{ name: "a" type: "{kind}" bottom: "data" top: "a" {param} no_such: 1 }} }}')


def test_old_formats_and_fields_without_effect_give_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    text = """input: "data" input_dim: 1 input_dim: 3 input_dim: 4 input_dim: 4
        layers { name: "a" type: POWER bottom: "data" top: "a" power_param { scale: 2 }
        relu_param { negative_slope: 1 } }"""
    net = dnn.readNetFromCaffe(text.encode())
    net.setInput(DATA)
    assert net.forward().shape == DATA.shape
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_an_axpy_multiplies_the_second_bottom() -> None:
    net = made(
        'layer { name: "pool" type: "Pooling" bottom: "data" top: "a" pooling_param { global_pooling: true pool: AVE }}'
        'layer { name: "minus" type: "Power" bottom: "data" top: "y" power_param { scale: -1 } }'
        'layer { name: "sum" type: "Axpy" bottom: "a" bottom: "data" bottom: "y" top: "sum" }'
        'layer { name: "end" type: "ReLU" bottom: "sum" top: "end" }'
    )
    assert net.getLayerNames() == ("pool", "minus", "sum/scale", "sum", "end")
    assert [net.getLayer(number).type for number in (3, 4)] == ["Scale", "Eltwise"]
    assert list(net.getUnconnectedOutLayers()) == [5]
    net.setInput(DATA)
    np.testing.assert_allclose(net.forward("sum"), DATA.mean((2, 3), keepdims=True) * DATA - DATA, rtol=0, atol=1e-6)


def test_an_input_is_scaled_once() -> None:
    net = read("classify")
    net.setInput(np.ones((1, 3, 20, 20)) * 4, scalefactor=0.25)
    first = net.forward("conv2")
    net.forward("fc")
    np.testing.assert_array_equal(net.forward("conv2"), first)


@pytest.mark.slow
def test_detections_without_keep_top_k() -> None:
    text = (HERE / "detect.prototxt").read_text()
    net = dnn.readNetFromCaffe(text.replace("keep_top_k: 40", "").encode(), HERE / "detect.caffemodel")
    whole = read("detect")
    for each in (net, whole):
        each.setInput(np.random.RandomState(3).rand(1, 3, 32, 32) * 2 - 1)
    found, expected = net.forward()[0, 0], whole.forward()[0, 0]
    assert 0 < len(found) < 40
    np.testing.assert_array_equal(found, expected[: len(found)])
    assert not expected[len(found) :].any()


def test_detections_are_opencvs_not_the_forks() -> None:
    values = np.random.RandomState(3).rand(1, 3, 32, 32).astype(np.float32) * 2 - 1
    net = read("detect")
    net.setInput(values)
    fork = netspec.load_net(HERE / "detect.prototxt", weights=HERE / "detect.caffemodel")
    detections, theirs = net.forward(), fork(data=values)["detections"]
    assert detections.shape == (1, 1, 40, 7)
    assert theirs.shape[2] < 40
    fork.keep = ["prior1"]
    fork(data=values)
    priors = [prior[0, 0].reshape(16, 16, 3, 4) for prior in (net.forward("prior1"), fork.blobs["prior1"].numpy())]
    widths = [prior[8, 8, 0, 2] - prior[8, 8, 0, 0] for prior in priors]
    np.testing.assert_allclose(widths, [4.6 / 32, 4 / 50], rtol=1e-5)  # min_size: 4.6 img_size: 50
    assert [prior.min() < 0 for prior in priors] == [False, True]


def test_a_net_without_weights_gives_a_warning() -> None:
    net = dnn.readNetFromCaffe(str(HERE / "classify.prototxt"))
    net.setInput(np.zeros((1, 3, 20, 20)))
    with pytest.raises(dnn.DnnError, match=r"this net was read without weights; also give the \.caffemodel"):
        net.forward()


def test_weights_in_hdf5(tmp_path: Path) -> None:
    plain = netspec.load_net(HERE / "classify.prototxt", weights=HERE / "classify.caffemodel")
    netspec.save_weights(plain, tmp_path / "x.caffemodel.h5")
    net = dnn.readNet(str(tmp_path / "x.caffemodel.h5"), str(HERE / "classify.prototxt"))
    values = np.random.RandomState(0).rand(1, 3, 20, 20).astype(np.float32)
    net.setInput(values)
    np.testing.assert_allclose(net.forward(), plain(data=values)["prob"].detach().numpy(), rtol=0, atol=1e-5)


def test_the_profile_is_measured_in_a_separate_run() -> None:
    net = read("segment")
    net.setInput(np.ones((1, 3, 16, 16)))
    total, ticks = net.getPerfProfile()
    assert ticks.shape == (len(net.getLayerNames()),)
    assert (ticks > 0).all()
    assert total == int(ticks.sum())


def test_backends_and_targets_change_nothing() -> None:
    net = read("classify")
    net.setInput(np.ones((1, 3, 20, 20)))
    expected = net.forward()
    net.setPreferableBackend(dnn.DNN_BACKEND_HALIDE)
    net.setPreferableTarget(dnn.DNN_TARGET_CUDA_FP16)
    np.testing.assert_array_equal(net.forward(), expected)


def test_opencvs_other_models_refuse_these_nets() -> None:
    with pytest.raises(cv2.error):
        dnn.KeypointsModel(read("segment"))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("addLayer", ("a", "ReLU", cv2.CV_32F, {})),
        ("addLayerToPrev", ("a", "ReLU", cv2.CV_32F, {})),
        ("connect", ("_input", "fc")),
        ("registerOutput", ("a", 1, 0)),
        ("quantize", ([], cv2.CV_32F, cv2.CV_32F)),
        ("forwardAsync", ()),
        ("dump", ()),
        ("dumpToFile", ("net.dot",)),
        ("getFLOPS", ([1, 3, 20, 20],)),
        ("getMemoryConsumption", ([1, 3, 20, 20],)),
        ("getInputDetails", ()),
        ("getOutputDetails", ()),
    ],
)
def test_methods_that_are_not_supported_are_refused(name: str, arguments: tuple[Any, ...]) -> None:
    with pytest.raises(dnn.DnnError):
        getattr(read("classify"), name)(*arguments)


def test_every_method_of_opencv_4_exists() -> None:
    methods = """addLayer addLayerToPrev connect dump dumpToFile empty enableFusion enableWinograd forward
        forwardAndRetrieve forwardAsync getFLOPS getInputDetails getLayer getLayerId getLayerNames getLayerShapes
        getLayerTypes getLayersCount getLayersShapes getMemoryConsumption getOutputDetails getParam getPerfProfile
        getUnconnectedOutLayers getUnconnectedOutLayersNames quantize registerOutput setHalideScheduler setInput
        setInputShape setInputsNames setParam setPreferableBackend setPreferableTarget"""
    assert [name for name in methods.split() if not hasattr(dnn.Net, name)] == []
    assert dnn.DNN_LAYOUT_NCHW == 2


def test_weights_shrink_to_half_precision_as_opencv_4_writes_them(tmp_path: Path) -> None:
    small, values = str(tmp_path / "small.caffemodel"), np.random.RandomState(1).rand(1, 3, 20, 20)
    dnn.shrinkCaffeModel(HERE / "classify.caffemodel", small)
    assert Path(small).stat().st_size < 0.6 * (HERE / "classify.caffemodel").stat().st_size
    net, whole = dnn.readNetFromCaffe(str(HERE / "classify.prototxt"), small), read("classify")
    for each in net, whole:
        each.setInput(values)
    np.testing.assert_array_equal(net.getParam("fc"), whole.getParam("fc").astype(np.float16))
    np.testing.assert_array_equal(net.getParam("bn1"), whole.getParam("bn1"))
    np.testing.assert_allclose(net.forward(), whole.forward(), atol=1e-3)
    with pytest.raises(dnn.DnnError, match="No such file"):
        dnn.shrinkCaffeModel(str(tmp_path / "none"), small)
