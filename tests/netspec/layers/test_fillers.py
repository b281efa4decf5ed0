"""Fillers: the distributions of Caffe's seven fillers, and their errors.

The samples have a fixed seed and at least 40,000 values; the tolerances are at least six standard errors.
"""

import math

import numpy as np
import pytest
import torch
from google.protobuf import text_format

from netspec.layers.contract import fillers
from netspec.proto.schema import FillerParameter

SHAPE = (200, 50, 2, 2)  # fan_in 200, fan_out 800


def draw(text: str, shape: tuple[int, ...] = SHAPE, seed: int = 1) -> np.ndarray:
    filler = FillerParameter()
    text_format.Parse(text, filler)
    fillers.check(filler, shape)
    values = fillers.draw(filler, shape, torch.Generator().manual_seed(seed))
    assert values.dtype == torch.float32
    assert tuple(values.shape) == shape
    return values.numpy()


def test_constant_is_zero_unless_a_value_is_given() -> None:
    assert (draw("") == 0).all()
    assert (draw("value: 0.5") == 0.5).all()
    assert draw("value: 3", shape=()) == 3


def test_uniform_fills_its_range() -> None:
    values = draw('type: "uniform" min: -1 max: 3')
    assert -1 <= values.min() < -0.99
    assert 2.99 < values.max() <= 3
    assert values.mean() == pytest.approx(1, abs=0.04)
    assert values.std() == pytest.approx(4 / math.sqrt(12), rel=0.02)
    assert (draw('type: "uniform" min: 2 max: 2') == 2).all()


def test_gaussian_has_its_mean_and_deviation() -> None:
    values = draw('type: "gaussian" mean: 5 std: 0.1')
    assert values.mean() == pytest.approx(5, abs=0.004)
    assert values.std() == pytest.approx(0.1, rel=0.03)
    assert np.mean(np.abs(values - 5) < 0.1) == pytest.approx(0.6827, abs=0.015)


def test_gaussian_sparse_keeps_each_value_with_probability_sparse_over_shape_0() -> None:
    values = draw('type: "gaussian" std: 2 sparse: 20', shape=(100, 800))
    kept = values[values != 0]
    assert kept.size / values.size == pytest.approx(0.2, abs=0.01)
    assert kept.std() == pytest.approx(2, rel=0.04)
    assert (draw('type: "gaussian" sparse: 0') == 0).all()
    assert (draw('type: "gaussian" sparse: 200') != 0).all()


def test_positive_unitball_rows_are_positive_and_sum_to_one() -> None:
    values = draw('type: "positive_unitball"')
    assert values.min() >= 0
    np.testing.assert_allclose(values.sum(axis=(1, 2, 3)), 1, rtol=1e-5)
    assert np.unique(values).size > 1000


@pytest.mark.parametrize(("norm", "n"), [("FAN_IN", 200), ("FAN_OUT", 800), ("AVERAGE", 500)])
def test_xavier_and_msra_scale_by_the_chosen_fan(norm: str, n: float) -> None:
    bound = math.sqrt(3 / n)
    uniform = draw(f'type: "xavier" variance_norm: {norm}')
    assert 0.999 * bound < np.abs(uniform).max() <= bound * (1 + 1e-6)
    assert uniform.std() == pytest.approx(bound / math.sqrt(3), rel=0.02)
    normal = draw(f'type: "msra" variance_norm: {norm}')
    assert normal.std() == pytest.approx(math.sqrt(2 / n), rel=0.03)
    assert normal.mean() == pytest.approx(0, abs=0.05 * math.sqrt(2 / n))


@pytest.mark.parametrize("kind", ["xavier", "msra"])
def test_default_fan_is_fan_in(kind: str) -> None:
    assert (draw(f'type: "{kind}"') == draw(f'type: "{kind}" variance_norm: FAN_IN')).all()


@pytest.mark.parametrize(
    ("shape", "fan_out"),
    [
        ((500, 100), 500),  # an InnerProduct: fan_out is num_output
        ((64, 8, 9, 9), 64 * 81),  # a convolution of 64 filters in 4 groups, 32 channels: shape[1] is 32 / 4
        ((40000,), 40000),  # a bias: no second axis, so the whole count
    ],
    ids=["inner_product", "grouped_convolution", "bias"],
)
def test_fan_out_is_count_over_shape_1(shape: tuple[int, ...], fan_out: int) -> None:
    values = draw('type: "xavier" variance_norm: FAN_OUT', shape)
    assert np.abs(values).max() == pytest.approx(math.sqrt(3 / fan_out), rel=0.002)


def test_bilinear_interpolates_when_a_deconvolution_upsamples_by_its_factor() -> None:
    np.testing.assert_allclose(
        draw('type: "bilinear"', (1, 1, 4, 4))[0, 0], np.outer([0.25, 0.75, 0.75, 0.25], [0.25, 0.75, 0.75, 0.25])
    )
    odd = np.array([1, 2, 3, 2, 1]) / 3
    values = draw('type: "bilinear"', (3, 2, 5, 5))
    assert (values == values[:1, :1]).all()
    np.testing.assert_allclose(values[2, 1], np.outer(odd, odd), rtol=1e-6)


def test_equal_seeds_give_equal_values_and_other_seeds_other_values() -> None:
    for kind in ("uniform", "gaussian", "positive_unitball", "xavier", "msra"):
        first = draw(f'type: "{kind}"', seed=3)
        assert (first == draw(f'type: "{kind}"', seed=3)).all()
        assert (first != draw(f'type: "{kind}"', seed=4)).any()


INVALID = {
    "unknown": ('type: "xaviar"', SHAPE, 'unknown filler "xaviar"; did you mean "xavier"?'),
    "gaussian_std_0": ('type: "gaussian" std: 0', SHAPE, "std > 0, found 0"),
    "gaussian_std_negative": ('type: "gaussian" std: -1', SHAPE, "std > 0, found -1"),
    "gaussian_sparse_negative": ('type: "gaussian" sparse: -2', SHAPE, "sparse >= 0"),
    "gaussian_sparse_too_large": ('type: "gaussian" sparse: 201', SHAPE, "sparse <= shape[0] = 200, found 201"),
    "xavier_sparse": ('type: "xavier" sparse: 3', SHAPE, 'filler "xavier" does not support sparse'),
    "uniform_min_above_max": ('type: "uniform" min: 1 max: 0', SHAPE, "min <= max"),
    "bilinear_not_square": ('type: "bilinear"', (4, 1, 3, 4), "square filters, found shape (4, 1, 3, 4)"),
    "bilinear_two_axes": ('type: "bilinear"', (4, 9), "4-D blob"),
    "msra_scalar": ('type: "msra"', (), "at least one axis"),
    "positive_unitball_scalar": ('type: "positive_unitball"', (), "at least one axis"),
    "constant_empty": ("value: 1", (3, 0), "empty blob"),
}


@pytest.mark.parametrize(("text", "shape", "words"), INVALID.values(), ids=INVALID)
def test_invalid_fillers_are_refused_with_the_reason(text: str, shape: tuple[int, ...], words: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        draw(text, shape)
    assert words in str(error.value)
