"""Coordinates of one blob in another. Caffe: python/caffe/test/test_coord_map.py."""

from typing import Any

import numpy as np
import pytest

from netspec.compat.pycaffe.coord_map import AxisMismatchException, compose, coord_map_from_to, crop, inverse
from netspec.compat.pycaffe.net_spec import NetSpec
from netspec.compat.pycaffe.net_spec import layers as L
from netspec.compat.pycaffe.net_spec import params as P


def spec(kernel: Any = 3, stride: Any = 1, pad: Any = 0, pool: int = 2, up: int = 2, up_pad: int = 0) -> NetSpec:
    """Convolution, pooling, and a deconvolution that brings the map back to the image's scale."""
    n = NetSpec()
    n.data = L.Input(shape={"dim": [2, 1, 100, 100]})
    n.aux = L.Input(shape={"dim": [2, 1, 20, 20]})
    n.conv = L.Convolution(n.data, num_output=10, kernel_size=kernel, stride=stride, pad=pad)
    n.pool = L.Pooling(n.conv, pool=P.Pooling.MAX, kernel_size=pool, stride=pool, pad=0)
    n.deconv = L.Deconvolution(n.pool, num_output=10, kernel_size=2 * up, stride=up, pad=up_pad)
    return n


def mapped(n: NetSpec) -> Any:
    return coord_map_from_to(n.deconv, n.data)


@pytest.mark.parametrize(("factor", "shift"), [(2, 0), (4, -1)])
def test_downsampling_and_upsampling_give_a_shift(factor: int, shift: int) -> None:
    assert mapped(spec(pool=factor, up=factor)) == (1, 1, shift)


def test_pointwise_layers_and_1x1_convolutions_keep_coordinates() -> None:
    n = spec()
    n.relu = L.ReLU(n.deconv)
    n.conv1x1 = L.Convolution(n.relu, num_output=10, kernel_size=1, stride=1, pad=0)
    assert coord_map_from_to(n.relu, n.data) == coord_map_from_to(n.conv1x1, n.data) == mapped(n)


@pytest.mark.parametrize("pad", [1, 7])
def test_padding_shifts_in_opposite_directions_for_deconvolutions(pad: int) -> None:
    axis, scale, shift = mapped(spec())
    assert mapped(spec(pad=pad)) == (axis, scale, shift - pad)
    assert mapped(spec(up_pad=pad)) == (axis, scale, shift + pad)
    assert mapped(spec(pad=pad, up_pad=pad)) == (axis, scale, shift)


def test_several_bottoms_have_the_same_mapping() -> None:
    n = spec()
    n.a, n.b = L.Convolution(n.data, n.aux, ntop=2, num_output=10, kernel_size=5, stride=2, pad=0)
    assert coord_map_from_to(n.a, n.data) == coord_map_from_to(n.b, n.aux)


def test_axes_can_have_different_windows() -> None:
    (axis_a, scale_a, shift_a), (axis_b, scale_b, shift_b) = mapped(spec(3, 1, 0)), mapped(spec(5, 2, 10))
    axis, scale, shift = mapped(spec([3, 5], [1, 2], [0, 10]))
    assert axis == axis_a == axis_b
    np.testing.assert_array_equal(scale, np.concatenate([scale_a, scale_b]))
    np.testing.assert_array_equal(shift, np.concatenate([shift_a, shift_b]))


def test_more_dimensions() -> None:
    n = NetSpec()
    n.data = L.Input(shape={"dim": [2, 3, 100, 100, 100]})
    n.conv = L.Convolution(n.data, num_output=10, kernel_size=[3, 3, 3], stride=[1, 1, 1], pad=[0, 1, 2])
    n.pool = L.Pooling(n.conv, pool=P.Pooling.MAX, kernel_size=2, stride=2, pad=0)
    n.deconv = L.Deconvolution(n.pool, num_output=10, kernel_size=4, stride=2, pad=0)
    axis, scale, shift = mapped(n)
    assert axis == 1
    np.testing.assert_array_equal(scale, 1)
    np.testing.assert_array_equal(np.diff(shift), [-1, -1])


def test_dilation_widens_the_window() -> None:
    n = NetSpec()
    n.data = L.Input()
    n.conv = L.Convolution(n.data, num_output=1, kernel_size=3, dilation=2, pad=0)
    assert coord_map_from_to(n.conv, n.data) == (1, 1, 2)


def test_a_crop_of_a_crop() -> None:
    n = spec()
    axis, scale, shift = mapped(n)
    n.crop = L.Crop(n.deconv, n.data, axis=2, offset=3)
    assert coord_map_from_to(n.crop, n.data) == (axis, scale, shift + 3)


def test_a_crop_of_other_axes_than_a_convolution_is_refused() -> None:
    n = spec()
    n.crop = L.Crop(n.deconv, n.data, axis=3, offset=3)
    with pytest.raises(AxisMismatchException, match="after 2, the other for the axes after 1"):
        coord_map_from_to(n.crop, n.data)


def test_crop_makes_a_crop_layer() -> None:
    n = spec(pool=4, up=4)
    n.score = crop(n.deconv, n.data)
    assert n.score.fn.type_name == "Crop"
    assert n.score.fn.inputs == (n.deconv, n.data)
    assert n.score.fn.params["crop_param"] == {"axis": 2, "offset": [1]}


def test_layers_without_a_mapping_disconnect() -> None:
    n = spec()
    n.ip = L.InnerProduct(n.deconv, num_output=10)
    with pytest.raises(RuntimeError, match="Could not compute map between tops"):
        coord_map_from_to(n.ip, n.data)


@pytest.mark.parametrize(
    ("n", "message"),
    [(spec(pool=3, up=2), "scale mismatch"), (spec(up_pad=10), "negative width"), (spec(kernel=2), "noninteger")],
)
def test_impossible_crops_are_refused(n: NetSpec, message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        crop(n.deconv, n.data)


def test_fields_of_two_dimensions_are_refused() -> None:
    n = NetSpec()
    n.data = L.Input()
    n.conv = L.Convolution(n.data, kernel_size=1, pad_h=1)
    with pytest.raises(AssertionError, match="_h/_w"):
        coord_map_from_to(n.conv, n.data)


def test_a_mapping_and_its_inverse_are_the_identity() -> None:
    assert compose((1, 4, 3), inverse((1, 4, 3))) == (1, 1, 0)
