"""Net of netspec.dnn: features that OpenCV does not have, and errors for wrong use."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import netspec
from dnn_program import HERE
from netspec import dnn
from netspec.fast.prepared import Prepared

DATA = np.random.RandomState(0).rand(1, 3, 20, 20).astype(np.float32)
INPUT = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 8 dim: 8 } } }\n'


def read(name: str) -> dnn.Net:
    return dnn.readNetFromCaffe(HERE / f"{name}.prototxt", HERE / f"{name}.caffemodel")


def made(layers: str) -> dnn.Net:
    return dnn.readNetFromCaffe((INPUT + layers).encode())


def test_a_fault_is_a_cv2_error_and_a_spec_error() -> None:
    with pytest.raises(cv2.error) as caught:
        made('layer { name: "x" type: "Powr" bottom: "data" top: "x" }')
    fault = caught.value
    assert isinstance(fault, netspec.SpecError)
    assert str(fault) == fault.msg
    assert str(fault).startswith('<prototxt>:2:19: layer "x" (Powr): unknown layer type "Powr"; did you mean "Power"?')
    assert (fault.file, fault.line, fault.func) == ("<prototxt>", 2, "readNetFromCaffe")


def test_a_wrong_name_lists_the_names() -> None:
    with pytest.raises(dnn.DnnError, match=r'two_inputs.prototxt: no input "data"; this net\'s inputs: a, b$'):
        read("two_inputs").setInput(DATA, "data")
    with pytest.raises(dnn.DnnError, match=r'no layer "scoers" in this net; did you mean "scores"\?'):
        read("segment").forward("scoers")


def test_a_missing_input_is_named() -> None:
    net = read("two_inputs")
    net.setInput(np.zeros((1, 4, 6, 6)), "a")
    with pytest.raises(dnn.DnnError, match=r'no value for input "b"; this net\'s inputs: a, b$'):
        net.forward()


def test_a_wrong_shape_is_reported_with_both_shapes_and_the_net_works_after_it() -> None:
    net = read("classify")
    net.setInput(DATA)
    expected = net.forward()
    net.setInput(DATA[:, :2])
    with pytest.raises(dnn.DnnError, match=r"bottom of shape \(1, 2, 20, 20\) .* made for 3 channels") as caught:
        net.forward()
    ending = 'input "data" has shape (1, 2, 20, 20), but the prototxt declares (1, 3, 20, 20)'
    assert str(caught.value).endswith(ending)
    net.setInput(DATA)
    np.testing.assert_array_equal(net.forward(), expected)


@pytest.mark.parametrize("as_content", [bytes, bytearray, lambda data: np.frombuffer(data, np.uint8), memoryview])
def test_files_are_given_as_content(as_content: Callable[[bytes], Any]) -> None:
    given = [as_content((HERE / f"classify.{ending}").read_bytes()) for ending in ("prototxt", "caffemodel")]
    nets = [dnn.readNetFromCaffe(*given), read("classify"), dnn.readNet("caffe", given[1], given[0])]
    outputs = []
    for net in nets:
        net.setInput(DATA)
        outputs.append(net.forward())
    np.testing.assert_array_equal(outputs[0], outputs[1])
    np.testing.assert_array_equal(outputs[2], outputs[1])


def test_other_files_than_weights_are_refused() -> None:
    with pytest.raises(dnn.DnnError, match="<caffeModel>: expected a binary NetParameter, found text"):
        dnn.readNetFromCaffe(HERE / "classify.prototxt", b"these are words, not weights")


def test_other_files_are_opened_by_opencv() -> None:
    with pytest.raises(cv2.error, match="Cannot determine an origin framework"):
        dnn.readNet("net.unknown")


def test_inputs_of_any_kind_of_number() -> None:
    net = read("classify")
    images = (DATA * 255).astype(np.uint8)
    net.setInput(images.astype(np.float32))
    expected = net.forward()
    matrix: Any = images.reshape(60, 20)
    for given in (images, images.astype(np.float64), images.astype(np.int32), cv2.UMat(matrix)):
        net.setInput(given.get().reshape(images.shape) if isinstance(given, cv2.UMat) else given)
        np.testing.assert_array_equal(net.forward(), expected)


def test_an_input_is_copied() -> None:
    net, values = made('layer { name: "x" type: "Split" bottom: "data" top: "x" }'), np.ones((1, 3, 8, 8), np.float32)
    net.setInput(values)
    values[:] = 7
    net.forward()[:] = 8
    assert (net.forward() == 1).all()


@pytest.mark.parametrize("declared", ['input: "x"', 'layer { name: "x" type: "Input" top: "x" }'])
def test_an_input_without_a_shape_gets_the_arrays(declared: str) -> None:
    net = dnn.readNetFromCaffe(f'{declared} layer {{ name: "y" type: "Power" bottom: "x" top: "y" }}'.encode())
    net.setInput(DATA)
    np.testing.assert_array_equal(net.forward(), DATA)


def test_tops_of_layers_that_are_overwritten_in_place() -> None:
    net = made(
        'layer { name: "minus" type: "Power" bottom: "data" top: "x" power_param { scale: -1 } }'
        'layer { name: "cut" type: "ReLU" bottom: "x" top: "x" }'
    )
    net.setInput(np.ones((1, 3, 8, 8)))
    minus, cut = net.forward(["minus", "cut"])
    assert (minus == -1).all()
    assert (cut == 0).all()


def test_all_tops_of_a_layer() -> None:
    net = made('layer { name: "parts" type: "Slice" bottom: "data" top: "p" top: "q" slice_param { slice_point: 1 } }')
    net.setInput(DATA[:, :, :8, :8])
    (parts,) = net.forwardAndRetrieve(["parts"])
    assert [part.shape for part in parts] == [(1, 1, 8, 8), (1, 2, 8, 8)]
    np.testing.assert_array_equal(net.forward("parts"), parts[0])


def test_the_other_forms_of_forward() -> None:
    net = read("segment")
    net.setInput(np.ones((1, 3, 16, 16)))
    expected = net.forward("conv")
    np.testing.assert_array_equal(net.forward(outputName="conv"), expected)
    np.testing.assert_array_equal(net.forward(None, "conv"), expected)
    np.testing.assert_array_equal(net.forward(outBlobNames=["conv"])[0], expected)
    np.testing.assert_array_equal(net.forward("_input"), np.ones((1, 3, 16, 16)))


def test_parameters_are_read_and_written() -> None:
    net = read("classify")
    net.setInput(DATA)
    before = net.forward("conv2")
    bias = net.getParam("conv2", 1)
    assert bias.shape == (12, 1)
    net.setParam("conv2", 1, bias + 1)
    np.testing.assert_allclose(net.forward("conv2"), before + 1, rtol=0, atol=1e-5)
    with pytest.raises(dnn.DnnError, match=r"found an array of shape \(3,\), expected \(12,\)"):
        net.setParam("conv2", 1, [1, 2, 3])


def test_a_whole_pass_runs_prepared_kernels_with_the_current_parameters() -> None:
    net, outputs = read("classify"), list[np.ndarray]()
    for _ in range(2):
        net.setInput(DATA)
        outputs.append(net.forward())
        with torch.inference_mode():
            by_layer = net._walk(len(net._caffe.net.plan.nodes) - 1)
        np.testing.assert_allclose(outputs[-1], by_layer[max(by_layer)].numpy(), rtol=0, atol=1e-6)
        net.setParam("conv2", 0, net.getParam("conv2", 0) * np.linspace(0, 2, 12).reshape(12, 1, 1, 1))
    assert isinstance(net._caffe.net.runners[0], Prepared)
    assert np.abs(outputs[0] - outputs[1]).max() > 1e-3


def test_shapes_of_one_layer() -> None:
    bottoms, tops = read("segment").getLayerShapes([1, 3, 20, 28], "conv")
    assert [tuple(shape) for shape in (*bottoms, *tops)] == [(1, 3, 20, 28), (1, 6, 10, 14)]


def test_computing_shapes_does_not_change_the_net() -> None:
    net = read("detect")
    net.setInput(np.ones((1, 3, 32, 32)))
    before = net.forward()
    net.getLayersShapes([2, 3, 64, 64])
    np.testing.assert_array_equal(net.forward(), before)


def test_a_net_without_files_is_empty() -> None:
    assert dnn.Net().empty()
    assert not read("classify").empty()


def test_other_names_are_those_of_cv2_dnn() -> None:
    assert dnn.blobFromImage is cv2.dnn.blobFromImage
    assert dnn.NMSBoxes is cv2.dnn.NMSBoxes
    assert {"NMSBoxes", "readNetFromCaffe"} <= set(dir(dnn))
    with pytest.raises(AttributeError, match=r"has no attribute 'readNetFromNowhere', nor has cv2.dnn of OpenCV"):
        dnn.readNetFromNowhere  # noqa: B018


def test_assigned_blobs_are_the_layers() -> None:
    """As the colorization programs of OpenCV's samples set the centers of colors."""
    net = read("classify")
    net.setInput(DATA)
    before, layer = net.forward("conv2"), net.getLayer("conv2")
    filters, bias = layer.blobs
    layer.blobs = [filters * 2, bias * 2]
    np.testing.assert_array_equal(net.getLayer("conv2").blobs[1], bias * 2)
    np.testing.assert_allclose(net.forward("conv2"), 2 * before, rtol=0, atol=1e-5)
    layer.blobs = [filters]  # without a bias, as in OpenCV
    expected = before - bias.reshape(1, -1, 1, 1)
    np.testing.assert_allclose(net.forward("conv2"), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("arrays", [[], [np.zeros(3)], [np.zeros(3)] * 3], ids=["none", "size", "three"])
def test_blobs_of_other_sizes_or_numbers_are_refused(arrays: list[np.ndarray]) -> None:
    net = read("classify")
    before = net.getParam("conv2")
    with pytest.raises(dnn.DnnError) as fault:
        net.getLayer("conv2").blobs = arrays
    assert fault.value.code == cv2.Error.StsBadArg
    np.testing.assert_array_equal(net.getParam("conv2"), before)


@pytest.mark.parametrize("name", ["name", "type", "preferableTarget", "other"])
def test_other_attributes_of_a_layer_are_read_only(name: str) -> None:
    with pytest.raises(AttributeError):
        setattr(read("classify").getLayer("conv2"), name, "x")
