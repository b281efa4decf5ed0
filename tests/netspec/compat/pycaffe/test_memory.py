"""Blobs are memory, as in Caffe, bug for bug: what scripts see between, during and after passes."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import netspec
import netspec.pycaffe as caffe
from paths import ROOT
from pycaffe_nets import INPUT, PYRAMID, image

ROUNDS = (Path(__file__).parent / "programs" / "rounds.py").read_text()


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


@pytest.mark.parametrize(
    ("assignment", "kind"),
    [
        ("net.params['conv1'][0] = array", TypeError),
        ("net.layers[1].blobs[0] = array", TypeError),
        ("net.params['conv1'] = [array]", TypeError),
        ("net.blobs['data'] = array", TypeError),
        ("net.blobs['data'].data = array", AttributeError),
        ("net.params['conv1'][0].diff = array", AttributeError),
        ("net.blobs['data'].shape = array.shape", AttributeError),
        ("net.layers[1].blobs = [array]", AttributeError),
        ("net.layers[1].type = 'ReLU'", AttributeError),
        ("net.params['conv1'].append(array)", AttributeError),
    ],
)
def test_assignments_without_effect_are_refused(
    net_of: Callable[..., caffe.Net], assignment: str, kind: type[Exception]
) -> None:
    net = net_of(PYRAMID)
    before = net.params["conv1"][0].data.copy()
    with pytest.raises(kind):
        exec(assignment, {"net": net, "array": np.zeros_like(before)})
    np.testing.assert_array_equal(net.params["conv1"][0].data, before)


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


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the process's size from /proc")
def test_memory_does_not_grow(write: Callable[..., str], tmp_path: Path) -> None:
    write(PYRAMID)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "GLOG_minloglevel": "2", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", ROUNDS], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 4e6, f"{int(done.stdout)} bytes more after 2000 rounds"
