"""Blobs are memory, as in Caffe, bug for bug: what scripts see between, during and after passes."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

import netspec
import netspec.pycaffe as caffe
from case_files import read_cases
from paths import ROOT

INPUT = 'force_backward: true input: "data" input_shape { dim: 1 dim: 3 dim: 12 dim: 12 }\n'
# The shape of MTCNN's first net: fully convolutional, run on an image pyramid.
PYRAMID = (Path(__file__).parent / "nets" / "pyramid.prototxt").read_text()
ROUNDS = (Path(__file__).parent / "programs" / "rounds.py").read_text()


def image(*shape: int) -> np.ndarray:
    return np.random.default_rng(len(shape) + sum(shape)).standard_normal(shape).astype(np.float32)


def test_outputs_are_views_that_the_next_pass_changes(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    first = net.forward(data=image(1, 3, 12, 12))["prob1"]
    before = first.copy()
    second = net.forward(data=-image(1, 3, 12, 12))["prob1"]
    assert not np.array_equal(before, first)
    assert np.array_equal(first, second)
    assert np.shares_memory(first, second)


LARGE = """
input: "data" input_shape { dim: 2 dim: 16 dim: 24 dim: 24 }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
  convolution_param { num_output: 32 kernel_size: 3 weight_filler { type: "msra" } } }
layer { name: "pool" type: "Pooling" bottom: "conv" top: "pool" pooling_param { kernel_size: 2 stride: 2 } }
layer { name: "flat" type: "Flatten" bottom: "pool" top: "flat" }
"""


def test_blobs_that_kernels_make_in_channels_last_are_caffes_arrays(net_of: Callable[..., caffe.Net]) -> None:
    """Such blobs are only copied when they are read: at once, in a later pass, or by a layer that runs alone."""
    net = net_of(LARGE)
    core = netspec.load_net("net.prototxt")
    for mine, params in zip(net.params.values(), core.params.values(), strict=True):
        for blob, parameter in zip(mine, params, strict=True):
            blob.data[...] = parameter.detach().numpy()
    core.keep, views = "all", dict[str, np.ndarray]()
    for seed in range(3):
        data = np.random.default_rng(seed).standard_normal((2, 16, 24, 24), np.float32)
        with torch.no_grad():
            core(data=data)
        net.forward(data=data)
        if seed == 1:
            views = {name: blob.data for name, blob in net.blobs.items()}
            assert all(view.flags.c_contiguous for view in views.values())
        for name, view in views.items():
            np.testing.assert_array_equal(view, core.blobs[name])
    again = net_of(LARGE)
    again.share_with(net)
    again.forward(data=net.blobs["data"].data)
    np.testing.assert_array_equal(again.forward(start="pool", end="pool")["pool"], views["pool"])


def test_smaller_shapes_use_the_start_of_the_memory(net_of: Callable[..., caffe.Net]) -> None:
    """A public MTCNN demo keeps the outputs of all scales: the last one overwrites the front of the others."""
    net = net_of(PYRAMID)
    kept = []
    for size in (40, 28, 20):
        net.blobs["data"].reshape(1, 3, size, size)
        net.blobs["data"].data[...] = image(1, 3, size, size)
        kept.append(net.forward()["prob1"])
    assert [array.shape[2] for array in kept] == [19, 13, 9]
    assert np.array_equal(kept[0].reshape(-1)[: kept[2].size], kept[2].reshape(-1))
    assert np.array_equal(kept[1].reshape(-1)[: kept[2].size], kept[2].reshape(-1))


def test_memory_is_as_large_as_its_largest_shape_was(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    net.blobs["data"].reshape(1, 3, 40, 40)
    net.reshape()  # nothing has run yet, but this much memory is there from now on
    kept = []
    for size in (20, 28):
        net.blobs["data"].reshape(1, 3, size, size)
        kept.append(net.forward(data=image(1, 3, size, size))["prob1"])
    assert np.array_equal(kept[0].reshape(-1), kept[1].reshape(-1)[: kept[0].size])


def test_grown_memory_is_new_and_old_views_keep_their_values(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    old = net.forward(data=image(1, 3, 12, 12))["prob1"]
    before = old.copy()
    net.blobs["data"].reshape(1, 3, 30, 30)
    assert not net.blobs["data"].data.any()
    new = net.forward(data=image(1, 3, 30, 30))["prob1"]
    assert new.shape == (1, 2, 14, 14)
    assert np.array_equal(old, before)


def test_reshape_takes_effect_immediately_and_keeps_values(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    blob = net.blobs["data"]
    blob.data[...] = image(1, 3, 12, 12)
    flat = blob.data.reshape(-1).copy()
    blob.reshape(2, 3, 4, 4)
    assert blob.data.shape == (2, 3, 4, 4)
    assert np.array_equal(blob.data.reshape(-1), flat[:96])
    blob.reshape(1, 3, 12, 12)
    assert np.array_equal(blob.data.reshape(-1), flat)
    assert (blob.num, blob.channels, blob.height, blob.width, blob.count) == (1, 3, 12, 12, 432)
    blob.reshape(5, 1)
    assert (blob.num, blob.channels, blob.height, blob.width) == (5, 1, 1, 1)


def test_fresh_arrays_and_reused_memory_give_the_same_numbers(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    other = caffe.Net("net.prototxt", caffe.TEST)
    other.share_with(net)
    for size in (12, 31, 17, 40, 12):
        held = [blob.data for blob in net.blobs.values()]  # so that passes write to memory
        array = image(1, 3, size, size)
        for one in (net, other):
            one.blobs["data"].reshape(1, 3, size, size)
        outputs = net.forward(data=array), other.forward(data=array)
        for name in net.outputs:
            assert np.array_equal(outputs[0][name], outputs[1][name])
        del held


def test_in_place_layers_overwrite_values(net_of: Callable[..., caffe.Net]) -> None:
    text = INPUT + (
        'layer { name: "twice" type: "Power" bottom: "data" top: "x" power_param { scale: 2 } }'
        'layer { name: "relu" type: "ReLU" bottom: "x" top: "x" }'
        'layer { name: "more" type: "Power" bottom: "x" top: "x" power_param { shift: 1 } }'
    )
    net = net_of(text)
    data = image(1, 3, 12, 12)
    assert np.array_equal(net.forward(data=data, end="twice")["x"], 2 * data)
    assert np.array_equal(net.forward(start="relu", end="relu")["x"], np.maximum(2 * data, 0))
    view = net.blobs["x"].data
    net.forward(start="more")
    assert np.array_equal(view, np.maximum(2 * data, 0) + 1)
    net.forward()
    assert np.array_equal(view, np.maximum(2 * data, 0) + 1)


@pytest.mark.parametrize("held", [False, True])
def test_in_place_layers_keep_data_for_their_gradient(net_of: Callable[..., caffe.Net], held: bool) -> None:
    """The gradient of Scale reads what Scale has overwritten: Caffe keeps a copy, even if scripts view the blob."""
    text = INPUT + (
        'layer { name: "twice" type: "Power" bottom: "data" top: "x" power_param { scale: 2 } }'
        'layer { name: "scale" type: "Scale" bottom: "x" top: "x" scale_param { filler { value: 3 } } }'
    )
    net = net_of(text, caffe.TRAIN)
    data = image(1, 3, 12, 12)
    views = [net.blobs["x"].data, net.blobs["x"].diff] if held else []
    for _ in range(2):
        net.forward(data=data)
        net.clear_param_diffs()
        net.blobs["x"].diff[...] = 1
        net.backward()
        np.testing.assert_allclose(net.params["scale"][0].diff, 2 * data.sum((0, 2, 3)), rtol=1e-4)
        assert (net.blobs["data"].diff == 6).all()
    del views


def _in_place(settings: str, phase: int, net_of: Callable[..., caffe.Net]) -> tuple[np.ndarray, ...]:
    """Return what a layer reads, what it makes of it in place, the diff given to it, and the one it gives."""
    text = 'force_backward: true layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 4 dim: 3 } } }'
    text += 'layer { name: "twice" type: "Scale" bottom: "x" top: "y" scale_param { filler { value: 2 } } }'
    text += f'layer {{ name: "it" bottom: "y" top: "y" {settings} }}'
    net = net_of(text, phase)
    view = net.blobs["y"].data if phase == caffe.TRAIN else None
    x = y = diff = np.zeros(0)
    for seed in range(2):
        x, diff = np.random.default_rng(seed).standard_normal((2, 4, 3)).astype(np.float32)
        y = net.forward(x=x)["y"].copy()
        net.blobs["y"].diff[...] = diff
        net.backward()
    del view
    return 2 * x, y, diff, net.blobs["x"].diff / 2


def _gate(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


IN_PLACE = {
    'type: "ReLU" relu_param { negative_slope: 0.1 }': lambda x, y, d: d * np.where(x > 0, 1, 0.1),
    'type: "PReLU"': lambda x, y, d: d * np.where(x > 0, 1, 0.25),
    'type: "ELU"': lambda x, y, d: d * np.where(x > 0, 1, 1 + y),
    'type: "Sigmoid"': lambda x, y, d: d * y * (1 - y),
    'type: "TanH"': lambda x, y, d: d * (1 - y * y),
    'type: "Exp"': lambda x, y, d: d * y,
    'type: "Swish" swish_param { beta: 2 }': lambda x, y, d: d * (2 * y + _gate(2 * x) * (1 - 2 * y)),
    'type: "Bias" bias_param { filler { value: 3 } }': lambda x, y, d: d,
    'type: "Scale" scale_param { bias_term: true filler { value: 3 } }': lambda x, y, d: 3 * d,
    'type: "Dropout"': lambda x, y, d: d * np.divide(y, x, out=np.ones_like(x), where=x != 0),
    'type: "Softmax"': lambda x, y, d: y * (d - (d * y).sum(1, keepdims=True)),
    'type: "BatchNorm" batch_norm_param { use_global_stats: true }': lambda x, y, d: d / np.float32(1e-5) ** 0.5,
    # What these read is overwritten; Power and Log lose the diff as well, since they write their slope over it.
    'type: "BNLL"': lambda x, y, d: d * _gate(y),
    'type: "Clip" clip_param { min: -1 max: 1 }': lambda x, y, d: d,
    'type: "Power" power_param { scale: 3 }': lambda x, y, d: np.full_like(x, 9),
    'type: "Power" power_param { power: 2 scale: 3 shift: 1 }': lambda x, y, d: (6 * (1 + 3 * y)) ** 2,
    'type: "Power" power_param { power: 3 shift: 9 }': lambda x, y, d: (3 * y / (y + 9)) ** 2,
    'type: "Log" log_param { shift: 9 }': lambda x, y, d: (y + 9) ** -2.0,
}


@pytest.mark.parametrize("phase", [caffe.TRAIN, caffe.TEST])
@pytest.mark.parametrize("settings", IN_PLACE)
def test_in_place_layers_have_caffes_gradients(net_of: Callable[..., caffe.Net], settings: str, phase: int) -> None:
    x, y, diff, found = _in_place(settings, phase, net_of)
    np.testing.assert_allclose(found, IN_PLACE[settings](x, y, diff), rtol=1e-4, atol=1e-5)


DRAWN = 'dummy_data_param { shape { dim: 1 dim: 2 } data_filler { type: "gaussian" } } }'
DRAWS = f'layer {{ name: "d" type: "DummyData" top: "x" {DRAWN}'
FC = 'layer {{ name: "ip" type: "InnerProduct" bottom: "x" top: "y" inner_product_param {{ num_output: {} }} }}'.format
READS = 'layer { name: "d" type: "HDF5Data" top: "x" hdf5_data_param { source: "list" batch_size: 1 } }'


IN_PLACE_OF_ANY_SHAPE = [
    *(
        f'type: "MVN" mvn_param {{ {options} }}'
        for options in ("", "across_channels: true", "normalize_variance: false")
    ),
    'type: "ReLU"',
    'type: "BatchNorm"',
]


@pytest.mark.parametrize("layer", IN_PLACE_OF_ANY_SHAPE)
@pytest.mark.parametrize("shape", [(3, 5), (3, 4, 5), (2, 3, 4, 5)])
@pytest.mark.parametrize("after", ["", 'layer { name: "after" type: "ReLU" bottom: "c" top: "c" }'])
def test_a_layer_in_place_that_adds_axes_has_the_gradient_of_a_net(
    write: Callable[..., str], layer: str, shape: tuple[int, ...], after: str
) -> None:
    """MVN makes four axes of its bottom, which is also the top of the layer before it."""
    dims = " ".join(f"dim: {size}" for size in shape)
    path = write(
        f"""
force_backward: true
layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ {dims} }} }} }}
layer {{ name: "c" type: "Power" bottom: "x" top: "c" power_param {{ scale: 2 power: 3 }} }}
layer {{ name: "it" {layer} bottom: "c" top: "c" }}
{after}
layer {{ name: "p" type: "Power" bottom: "c" top: "p" power_param {{ power: 2 }} }}
"""
    )
    x = torch.from_numpy(image(*shape)).requires_grad_()
    top = netspec.load_net(path, phase="TRAIN")(x=x)["p"]
    top.backward(torch.from_numpy(diff := image(*top.shape)))
    assert x.grad is not None
    net = caffe.Net(path, caffe.TRAIN)
    for _ in range(2):
        net.forward(x=x.detach().numpy())
        np.testing.assert_allclose(net.backward(p=diff)["x"], x.grad.numpy(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "net",
    [
        "force_backward: true " + READS + FC(1),
        DRAWS + FC(2) + 'layer { name: "bn" type: "BatchNorm" bottom: "y" top: "y" propagate_down: false }',
        "force_backward: true " + DRAWS + 'layer { name: "drop" type: "Dropout" bottom: "x" top: "y" }',
    ],
)
@pytest.mark.parametrize("alone", [False, True])
def test_a_backward_pass_reads_no_data_and_draws_no_random_numbers(
    net_of: Callable[..., caffe.Net], net: str, alone: bool
) -> None:
    """Also before any forward pass, when autograd has recorded nothing."""
    with h5py.File("x.h5", "w") as file:
        file["x"] = np.arange(1, 9, dtype=np.float32).reshape(8, 1)
    Path("list").write_text("x.h5")
    text = net + 'layer { name: "r" type: "Reduction" bottom: "y" top: "r" loss_weight: 1 }'
    nets = []
    for _ in range(2):
        caffe.set_random_seed(5)
        nets.append(net_of(text, caffe.TRAIN))
    one, other = nets
    if alone:
        other.backward()
    for _ in range(3):
        one.forward()
        other.forward()
        other.backward()
        for name in ("x", "y"):
            np.testing.assert_array_equal(one.blobs[name].data, other.blobs[name].data)
    for mine, others in zip(one.params.values(), other.params.values(), strict=True):
        for a, b in zip(mine, others, strict=True):
            np.testing.assert_array_equal(a.data, b.data)


def test_split_copies_and_reshaped_blobs_share_memory(net_of: Callable[..., caffe.Net]) -> None:
    text = INPUT + (
        'layer { name: "x" type: "Power" bottom: "data" top: "x" power_param { scale: 2 } }'
        'layer { name: "flat" type: "Flatten" bottom: "x" top: "flat" }'
        'layer { name: "again" type: "Power" bottom: "x" top: "again" }'
    )
    net = net_of(text)
    assert list(net.blobs) == ["data", "x", "x_x_0_split_0", "x_x_0_split_1", "flat", "again"]
    net.forward(data=image(1, 3, 12, 12))
    net.blobs["x"].data[...] = 5
    for name in ("x_x_0_split_0", "x_x_0_split_1", "flat"):
        assert (net.blobs[name].data == 5).all()
        assert np.shares_memory(net.blobs[name].data, net.blobs["x"].data)
    assert not (net.blobs["again"].data == 5).any()
    net.blobs["flat"].diff[...] = 1
    assert np.shares_memory(net.blobs["flat"].diff, net.blobs["x_x_0_split_0"].diff)
    assert not np.shares_memory(net.blobs["flat"].diff, net.blobs["x"].diff)
    net.blobs["again"].diff[...] = 2
    net.backward()
    assert (net.blobs["x"].diff == 3).all()
    assert (net.blobs["data"].diff == 6).all()


def test_blobs_that_share_memory_can_be_maps_of_one_pixel(net_of: Callable[..., caffe.Net]) -> None:
    """Torch's copies misinterpret the strides of such maps as an overlap."""
    net = net_of(
        """
        force_backward: true
        layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 4 dim: 5 dim: 3 dim: 2 } } }
        layer { name: "pool" type: "Pooling" bottom: "x" top: "p"
                pooling_param { kernel_h: 3 kernel_w: 2 stride: 3 round_mode: FLOOR } }
        layer { name: "flat" type: "Flatten" bottom: "p" top: "f" flatten_param { axis: 3 end_axis: 3 } }
        layer { name: "cut" type: "Slice" bottom: "p" top: "a" top: "b" slice_param { axis: 1 slice_point: 3 } }
        """
    )
    net.blobs["x"].data[...] = np.arange(120).reshape(4, 5, 3, 2)
    net.forward()
    net.blobs["a"].diff[...], net.blobs["b"].diff[...] = 1, 2
    net.backward()
    assert net.blobs["x"].diff.reshape(4, 5, 6).max(axis=2).tolist() == [[1, 1, 1, 2, 2]] * 4


def test_dropout_of_the_test_phase_copies(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(INPUT + 'layer { name: "drop" type: "Dropout" bottom: "data" top: "drop" }')
    net.forward(data=image(1, 3, 12, 12))
    before = net.blobs["drop"].data.copy()
    net.blobs["data"].data[...] = 0
    assert np.array_equal(net.blobs["drop"].data, before)


def test_backward_belongs_to_the_last_forward(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(INPUT + 'layer { name: "drop" type: "Dropout" bottom: "data" top: "drop" }', caffe.TRAIN)
    kept = net.forward(data=np.ones((1, 3, 12, 12)))["drop"] != 0
    assert 0 < kept.mean() < 1
    net.blobs["drop"].diff[...] = 1
    for _ in range(2):
        assert np.array_equal(net.backward()["data"], 2.0 * kept)


def test_backward_reads_values_that_scripts_wrote(net_of: Callable[..., caffe.Net]) -> None:
    """Caffe's backward pass reads data and weights from memory: between the passes, scripts may change them."""
    text = INPUT + (
        'layer { name: "relu" type: "ReLU" bottom: "data" top: "relu" }'
        'layer { name: "fc" type: "InnerProduct" bottom: "relu" top: "fc" inner_product_param { num_output: 2 '
        'weight_filler { type: "xavier" } } }'
    )
    net = net_of(text, caffe.TRAIN)
    net.forward(data=np.ones((1, 3, 12, 12)))
    net.blobs["data"].data[0, 0] = -1
    net.blobs["relu"].data[...] = 4
    net.params["fc"][0].data[...] = 3
    net.blobs["fc"].diff[...] = 1
    net.backward()
    assert (net.params["fc"][0].diff == 4).all()
    assert (net.blobs["relu"].diff == 6).all()
    assert (net.blobs["data"].diff[0, 0] == 0).all()
    assert (net.blobs["data"].diff[0, 1:] == 6).all()


DATA = """
layer { name: "d" type: "DummyData" top: "x" top: "cont" dummy_data_param {
  shape { dim: 3 dim: 2 dim: 4 dim: 5 } shape { dim: 3 dim: 2 }
  data_filler { type: "gaussian" } data_filler { type: "gaussian" } } }
"""
RECURRENT = 'recurrent_param { num_output: 2 weight_filler { type: "xavier" } }'
SQUARES = (
    'layer { name: "end" type: "Reduction" bottom: "y" top: "end" loss_weight: 1 reduction_param { operation: SUMSQ } }'
)
WRITES_DIFFS_OF_DATA = {
    "BatchNorm": 'type: "BatchNorm" bottom: "x"',
    "LSTM": f'type: "LSTM" bottom: "x" bottom: "cont" {RECURRENT}',
    "RNN": f'type: "RNN" bottom: "x" bottom: "cont" {RECURRENT}',
}


@pytest.mark.parametrize("layer", WRITES_DIFFS_OF_DATA)
def test_layers_that_ignore_propagate_down_write_the_diff_of_data(layer: str, net_of: Callable[..., caffe.Net]) -> None:
    text = DATA + f'layer {{ name: "it" {WRITES_DIFFS_OF_DATA[layer]} top: "y" }}' + SQUARES
    net = net_of(text, caffe.TRAIN)
    net.forward()
    net.backward()
    assert net.blobs["x"].diff.any()
    assert not net.blobs["cont"].diff.any()
    frozen = net_of(
        text.replace('top: "y"', 'top: "y" param { lr_mult: 0 } param { lr_mult: 0 } param { lr_mult: 0 }'), caffe.TRAIN
    )
    frozen.forward()
    frozen.backward()
    assert bool(frozen.blobs["x"].diff.any()) == (layer == "RNN")  # its other blobs learn


@pytest.mark.parametrize("layer", ["Softmax", "MVN", "LRN", "BatchNorm", "Im2col", "ReLU"])
def test_propagate_down_false_keeps_a_diff_at_zero_if_the_layer_heeds_it(
    layer: str, net_of: Callable[..., caffe.Net]
) -> None:
    """No layer below gets a gradient, and Caffe does not run its backward pass."""
    text = f"""
layer {{ name: "low" type: "Scale" bottom: "x" top: "low" }}
layer {{ name: "it" type: "{layer}" bottom: "low" top: "y" propagate_down: false
  convolution_param {{ kernel_size: 2 }} }}
"""
    net = net_of(DATA + text + SQUARES, caffe.TRAIN)
    net.forward()
    net.backward()
    assert net.blobs["low"].diff.any() == (layer != "ReLU")
    assert not net.params["low"][0].diff.any()


def test_flatten_of_data_shares_no_diff(net_of: Callable[..., caffe.Net]) -> None:
    """Caffe shares it in the backward pass, which does not run here; Reshape shares it from the start."""
    for layer, shared in (("Flatten", False), ("Reshape", True)):
        text = f"""
layer {{ name: "it" type: "{layer}" bottom: "x" top: "flat" reshape_param {{ shape {{ dim: 3 dim: -1 }} }} }}
layer {{ name: "bn" type: "BatchNorm" bottom: "flat" top: "y" }}
"""
        net = net_of(DATA + text + SQUARES, caffe.TRAIN)
        net.forward()
        net.backward()
        assert net.blobs["flat"].diff.any()
        assert net.blobs["x"].diff.any() == shared


def test_layers_without_gradients_are_skipped(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID.replace("force_backward: true", ""), caffe.TEST)
    net.forward(data=image(1, 3, 12, 12))
    net.blobs["prob1"].diff[...] = 1
    net.blobs["data"].diff[...] = 9
    assert (net.backward()["data"] == 9).all()  # no loss, nothing to learn from: Caffe leaves every diff alone
    assert not net.params["conv1"][0].diff.any()


def test_guided_backpropagation(net_of: Callable[..., caffe.Net]) -> None:
    """Layer by layer, negative gradients cut off at each ReLU."""
    text = INPUT + "".join(
        f'layer {{ name: "c{i}" type: "Convolution" bottom: "{bottom}" top: "c{i}" convolution_param {{ num_output: 4 '
        f'kernel_size: 3 weight_filler {{ type: "xavier" }} }} }} '
        f'layer {{ name: "r{i}" type: "ReLU" bottom: "c{i}" top: "c{i}" }}'
        for i, bottom in enumerate(("data", "c0"))
    )
    net = net_of(text)
    net.forward(data=image(1, 3, 12, 12))
    plain = {}
    net.blobs["c1"].diff[...] = image(1, 4, 8, 8)
    net.backward(start="c1", end="c0")
    plain["data"] = net.blobs["data"].diff.copy()
    net.blobs["c1"].diff[...] = np.maximum(image(1, 4, 8, 8), 0)
    net.backward(start="r1", end="r1")
    masked = net.blobs["c1"].diff.copy()
    assert (masked[net.blobs["c1"].data == 0] == 0).all()
    net.backward(start="c1", end="c1")
    np.maximum(net.blobs["c0"].diff, 0, out=net.blobs["c0"].diff)
    guided = net.backward(start="r0", end="c0")["data"]
    assert guided.any()
    assert not np.allclose(guided, plain["data"])


def test_deep_dream_increases_its_objective(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    source, target = net.blobs["data"], net.blobs["pool1"]
    source.reshape(1, 3, 24, 24)
    source.data[0] = image(3, 24, 24)
    norms = []
    for _ in range(10):
        net.forward(end="pool1")
        norms.append(float((target.data**2).sum()))
        target.diff[:] = target.data
        net.backward(start="pool1")
        gradient = source.diff[0]
        source.data[:] += 0.5 / np.abs(gradient).mean() * gradient * 0.1
    assert norms == sorted(norms)


def test_net_surgery(net_of: Callable[..., caffe.Net], write: Callable[..., str]) -> None:
    """The weights of an InnerProduct, copied to a Convolution, give the same scores at each position."""
    dense = net_of(
        INPUT + 'layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc" inner_product_param '
        '{ num_output: 5 weight_filler { type: "xavier" } bias_filler { type: "uniform" } } }'
    )
    write(
        INPUT + 'layer { name: "fc-conv" type: "Convolution" bottom: "data" top: "fc-conv" convolution_param '
        "{ num_output: 5 kernel_size: 12 } }",
        "conv.prototxt",
    )
    conv = caffe.Net("conv.prototxt", caffe.TEST)
    conv.params["fc-conv"][0].data.flat = dense.params["fc"][0].data.flat  # pyright: ignore[reportAttributeAccessIssue]
    conv.params["fc-conv"][1].data[...] = dense.params["fc"][1].data
    data = image(1, 3, 12, 12)
    expected = dense.forward(data=data)["fc"]
    np.testing.assert_allclose(conv.forward(data=data)["fc-conv"][..., 0, 0], expected, rtol=1e-4, atol=1e-5)
    conv.blobs["data"].reshape(1, 3, 20, 20)
    assert conv.forward(data=image(1, 3, 20, 20))["fc-conv"].shape == (1, 5, 9, 9)
    conv.save("surgery.caffemodel")
    again = caffe.Net("conv.prototxt", caffe.TEST, weights="surgery.caffemodel")
    assert np.array_equal(again.params["fc-conv"][0].data, conv.params["fc-conv"][0].data)


def test_shared_parameters_share_memory(net_of: Callable[..., caffe.Net]) -> None:
    layer = (
        'layer {{ name: "{0}" type: "InnerProduct" bottom: "data" top: "{0}" param {{ name: "w" }} '
        'inner_product_param {{ num_output: 2 bias_term: false weight_filler {{ type: "xavier" }} }} }}'
    )
    net = net_of(INPUT + layer.format("a") + layer.format("b"))
    assert np.shares_memory(net.params["a"][0].data, net.params["b"][0].data)
    net.params["b"][0].data[...] = 1
    net.params["a"][0].diff[...] = 2
    assert (net.params["a"][0].data == 1).all()
    assert (net.params["b"][0].diff == 2).all()


def test_views_of_parameters_show_loaded_weights(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    net.save("one.caffemodel")
    view = net.params["conv1"][0].data
    before = view.copy()
    view[...] = 0
    net.copy_from("one.caffemodel")
    assert np.array_equal(view, before)


def test_a_net_accepts_attributes(net_of: Callable[..., Any]) -> None:
    net = net_of(PYRAMID)
    net.transformer = net.mean = 5
    assert net.mean == 5


def test_hooks_get_each_layer(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    reported: list[tuple[str, int]] = []
    for which in ("before_forward", "after_forward", "before_backward", "after_backward"):
        getattr(net, which)(lambda layer, which=which: reported.append((which, layer)))
    net.forward(start="pool1", end="pool1_pool1_0_split")
    net.backward(start="pool1", end="pool1")
    assert reported == [
        ("before_forward", 3), ("after_forward", 3), ("before_forward", 4), ("after_forward", 4),
        ("before_backward", 3), ("after_backward", 3),
    ]  # fmt: skip


def test_forward_backward_all(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(PYRAMID)
    net.blobs["data"].reshape(2, 3, 12, 12)
    net.reshape()
    data = image(5, 3, 12, 12)
    tops: dict[str, Any] = {name: np.ones((5, *net.blobs[name].shape[1:])) for name in net.outputs}
    outputs, diffs = net.forward_backward_all(blobs=["pool1"], diffs=["conv1"], data=data, **tops)
    assert {name: array.shape for name, array in outputs.items()} == {
        "conv4-2": (5, 4, 5, 5), "prob1": (5, 2, 5, 5), "pool1": (5, 10, 5, 5)
    }  # fmt: skip
    assert {name: array.shape for name, array in diffs.items()} == {"data": (5, 3, 12, 12), "conv1": (5, 10, 10, 10)}
    net.blobs["data"].reshape(1, 3, 12, 12)
    for i in range(5):
        net.forward(data=data[i : i + 1])
        net.backward(**{name: top[:1] for name, top in tops.items()})
        np.testing.assert_allclose(diffs["data"][i], net.blobs["data"].diff[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("code", "kind", "message"),
    [
        ('net.blobs["dta"]', KeyError, 'no blob "dta" in this net; did you mean "data"?'),
        ('net.blobs["nothing"]', KeyError, "it has: data, conv1, pool1"),
        ('net.params["conv9"]', KeyError, "it has: conv1, PReLU1, conv4-1, conv4-2"),
        ('net.forward(end="pool9")', ValueError, 'no layer "pool9" in this net; did you mean "pool1"?'),
        ("net.forward(image=1)", ValueError, "Input blob arguments do not match net inputs. Found image, expected dat"),
        ("net.backward(pool1=1)", ValueError, "Top diff arguments do not match net outputs. Found pool1, expected co"),
        ("net.forward(data=np.ones((2, 3, 12, 12)))", ValueError, "Input is not batch sized: found shape (2, 3, 12, 1"),
        ("net.forward_all()", ValueError, "no arrays were given"),
        ("net.forward_all(data=np.ones((1, 3, 12, 12)), end='conv1')", ValueError, "be given; use forward(end=...)"),
        ("caffe.Net('n', caffe.TEST, 'w.caffemodel')", TypeError, "name the weights: Net(file, phase, weights="),
        ("net.forward(data=np.ones((1, 3, 9, 12)))", ValueError, "from shape (1,3,9,12) into shape (1,3,12,12)"),
        ("net.blobs['data'].data[...] = np.ones((1, 4, 12, 12))", ValueError, "(1,4,12,12) into shape (1,3,12,12)"),
        ("net.blobs['data'].reshape(1, -3)", ValueError, "found shape (1, -3), expected no negative size"),
        ("net.blobs['data'].reshape(1, 2.5)", TypeError, "float"),
        ("net.set_input_arrays(np.ones(1), np.ones(1))", RuntimeError, "if the first layer is a MemoryDataLayer"),
        ("net.copy_from('nowhere.caffemodel')", RuntimeError, "Could not open file nowhere.caffemodel"),
        ("caffe.Net('nowhere.prototxt', caffe.TEST)", RuntimeError, "Could not open file nowhere.prototxt"),
        ("net.blobs['data'].reshape(1, 3, 1, 1); net.forward()", ValueError, 'net.prototxt:4:3: layer "conv1" (Con'),
        ("net.blobs['data'].reshape(1, 4, 9, 9); net.forward()", ValueError, "(1, 4, 9, 9) does not fit the filters"),
        ("net.params['conv1'][0].reshape(99, 99)", ValueError, "this blob has 270 numbers and cannot be reshaped to 9"),
        ("net.blobs['data'].reshape(1, 1, 1, 1, 1); net.blobs['data'].num", ValueError, "num_axes() <= 4"),
    ],
)
def test_errors_do_not_damage_the_net(
    net_of: Callable[..., caffe.Net], code: str, kind: type[Exception], message: str
) -> None:
    net = net_of(PYRAMID)
    with pytest.raises(kind) as fault:
        exec(code, {"net": net, "np": np, "caffe": caffe})
    assert message in str(fault.value)
    net.blobs["data"].reshape(1, 3, 12, 12)
    assert net.forward()["prob1"].sum() == pytest.approx(25, rel=1e-4)


X = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 2 dim: 3 dim: 8 dim: 8 } } }\n'
FOUR = 'layer { name: "ip" type: "InnerProduct" bottom: "x" top: "ip" inner_product_param { num_output: 4 } }\n'


CHECKS = read_cases("netspec/compat/pycaffe/cases/checks.txt")


@pytest.mark.parametrize("case", CHECKS.values(), ids=CHECKS)
def test_a_failed_check_has_caffes_message_and_the_location(
    net_of: Callable[..., caffe.Net], case: dict[str, str]
) -> None:
    with pytest.raises(ValueError, match=rf"net\.prototxt:{case['place']}: ") as fault:
        net_of(X + case["layers"])
    assert case["check"] in str(fault.value)


def test_an_interrupted_pass_leaves_its_records_to_the_next(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(
        """layer { name: "m" type: "MemoryData" top: "d" top: "l"
             memory_data_param { batch_size: 1 channels: 1 height: 1 width: 1 } }
           layer { name: "p" type: "Power" bottom: "d" top: "p" }"""
    )
    net.set_input_arrays(np.zeros((9, 1, 1, 1), np.float32), np.arange(9, dtype=np.float32))
    interrupt: list[int] = []

    def stop(layer: int) -> None:
        if layer in interrupt:
            raise KeyboardInterrupt

    assert net.forward()["l"] == 0
    net.before_forward(stop)
    interrupt[:] = [1]
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            net.forward()
    interrupt.clear()
    assert net.forward()["l"] == 1


def test_a_failed_check_of_a_pass_has_caffes_message(net_of: Callable[..., caffe.Net], tmp_path: Path) -> None:
    net = net_of(X + FOUR)
    net.blobs["x"].reshape(2, 3, 9, 9)
    for run in (net.forward, net.reshape):
        with pytest.raises(ValueError, match="InnerProduct") as fault:
            run()
        assert "(Check failed: K_ == new_K (192 vs. 243) Input size incompatible with inner" in str(fault.value)
    (tmp_path / "bad.caffemodel").write_text("words")
    with pytest.raises(ValueError, match=r"bad\.caffemodel: .*Failed to parse NetParameter file: .*bad\.caffemodel"):
        net.copy_from(tmp_path / "bad.caffemodel")


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the process's size from /proc")
def test_memory_does_not_grow(write: Callable[..., str], tmp_path: Path) -> None:
    write(PYRAMID)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GLOG_minloglevel": "2", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", ROUNDS], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 4e6, f"{int(done.stdout)} bytes more after 2000 rounds"
