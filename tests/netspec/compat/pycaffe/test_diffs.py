"""Backward passes as Caffe's, bug for bug: gradients in place, diffs of data, what scripts write between passes."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import netspec
import netspec.pycaffe as caffe
from pycaffe_nets import INPUT, PYRAMID, image


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


DRAWN = 'dummy_data_param { shape { dim: 1 dim: 2 } data_filler { type: "gaussian" } } }'
DRAWS = f'layer {{ name: "d" type: "DummyData" top: "x" {DRAWN}'
FC = 'layer {{ name: "ip" type: "InnerProduct" bottom: "x" top: "y" inner_product_param {{ num_output: {} }} }}'.format
READS = 'layer { name: "d" type: "HDF5Data" top: "x" hdf5_data_param { source: "list" batch_size: 1 } }'


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


FROM_X = """
force_backward: true
layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 4 dim: 3 dim: 2 dim: 2 } } }
layer { name: "twice" type: "Power" bottom: "x" top: "y" power_param { scale: 2 } }
"""
END = 'layer { name: "r" type: "Reduction" bottom: "z" top: "r" loss_weight: 1 reduction_param { operation: SUMSQ } }'
BIAS = 'type: "Bias" bias_param { axis: 0 num_axes: -1 filler { value: 0.5 } }'
LEARNING = {
    "BatchNorm": 'type: "BatchNorm"',
    "Scale": 'type: "Scale" scale_param { bias_term: true filler { value: 2 } }',
    "Bias": BIAS,
    "PReLU": 'type: "PReLU"',
    "Convolution": 'type: "Convolution" convolution_param { num_output: 3 kernel_size: 1 weight_filler { value: 1 } }',
    "InnerProduct": 'type: "InnerProduct" inner_product_param { num_output: 2 weight_filler { value: 1 } }',
}


@pytest.mark.parametrize(
    ("layer", "top"), [*((layer, "z") for layer in LEARNING), *((layer, "y") for layer in list(LEARNING)[:4])]
)
def test_a_backward_pass_after_an_update_reads_the_new_weights(write: Callable[..., str], layer: str, top: str) -> None:
    """Also if a script has looked at the gradients, and if the layer has overwritten what it has read."""
    it = f'layer {{ name: "it" {LEARNING[layer]} bottom: "y" top: "{top}" }}'
    write(FROM_X + it + END.replace('"z"', f'"{top}"'))
    solver = caffe.get_solver(write('net: "net.prototxt" base_lr: 0.125 lr_policy: "fixed"', "solver.prototxt"))
    net, other = solver.net, caffe.Net("net.prototxt", caffe.TRAIN)
    net.forward(x=image(4, 3, 2, 2))
    net.backward()
    looked = [blob.diff for blob in net.params["it"]]
    solver.apply_update()
    weights = [blob.data.copy() for blob in net.params["it"]]
    other.forward(x=image(4, 3, 2, 2))
    for blob, values in zip(other.params["it"], weights, strict=True):
        blob.data[...] = values
    for each in (net, other):
        each.blobs[top].diff[...] = 1
        each.clear_param_diffs()
        each.backward(start="it")
    for mine, others, values in zip(net.params["it"], other.params["it"], weights, strict=True):
        np.testing.assert_array_equal(mine.diff, others.diff)
        np.testing.assert_array_equal(mine.data, values)
    np.testing.assert_array_equal(net.blobs["x"].diff, other.blobs["x"].diff)
    assert len(looked) == len(weights)


def test_the_gradient_of_a_bias_as_large_as_its_bottom_is_cleared(net_of: Callable[..., caffe.Net]) -> None:
    fc = 'layer { name: "fc" type: "InnerProduct" bottom: "b" top: "z" inner_product_param { num_output: 2 } }'
    net = net_of(f'{FROM_X} layer {{ name: "b" {BIAS} bottom: "y" top: "b" }} {fc} {END}', caffe.TRAIN)
    net.params["fc"][0].data[...] = 1
    seen = []
    for _ in range(3):
        net.clear_param_diffs()
        net.forward(x=image(4, 3, 2, 2))
        net.backward()
        seen.append(net.params["b"][0].diff.copy())
    assert seen[0].any()
    for diff in seen[1:]:
        np.testing.assert_array_equal(diff, seen[0])
