"""Preprocessing of pixels in Caffe's order: swap, raw_scale, mean, scale."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lmdb_build.mean import write_mean
from netspec.errors import SpecError
from netspec.inspect.features.describer import Describer
from netspec.inspect.features.scaling import Steps, scaling_of
from netspec.proto.schema import LayerParameter, TransformationParameter

PIXEL = np.array([10, 20, 30], np.uint8).reshape(1, 3, 1, 1)  # blue, green, red
SHAPE = (3, 1, 1)


def scaled(steps: Steps, layer: LayerParameter | None = None) -> list[float]:
    return scaling_of(steps, layer, SHAPE, "net.prototxt")(PIXEL).ravel().tolist()


def test_steps_are_applied_in_caffes_order():
    assert scaled(Steps.of("1,2,3", 1, 1, False)) == [9, 18, 27]
    assert scaled(Steps.of("5", 0.5, 1, False)) == [2.5, 7.5, 12.5]
    assert scaled(Steps.of(None, 1, 1, True)) == [30, 20, 10]
    assert scaled(Steps.of([1, 2, 3], 2, 10, True)) == [(300 - 1) * 2, (200 - 2) * 2, (100 - 3) * 2]
    assert scaled(Steps.of(4.0, "0.5", "2", "true")) == [28, 18, 8]


def test_given_steps_replace_the_transform_param():
    layer = LayerParameter(name="d", transform_param=TransformationParameter(scale=3, mean_value=[1]))
    assert scaled(Steps(), layer) == [27, 57, 87]
    assert scaled(Steps(scale=2.0), layer) == [20, 40, 60]
    assert str(scaling_of(Steps(scale=2.0), layer, SHAPE, "f")) == "0 to 255, times 2 (from the options)"


def test_a_mean_image_is_cropped_at_its_center():
    mean = np.arange(27, dtype=np.float32).reshape(3, 3, 3)
    assert scaled(Steps(mean=mean)) == [10 - 4, 20 - 13, 30 - 22]
    assert scaled(Steps(mean=mean[None])) == [10 - 4, 20 - 13, 30 - 22]


@pytest.mark.parametrize(
    ("mean", "fault"),
    [
        (np.ones(2), "--mean: the mean has 2 values, expected 1 or 3"),
        (np.ones((1, 3, 3)), r"--mean: the mean has shape \(1, 3, 3\), expected at least \(3, 1, 1\)"),
        (np.ones((3, 0, 3)), "expected at least"),
    ],
    ids=["two_values", "one_channel", "empty"],
)
def test_a_mean_of_a_wrong_shape_is_refused(mean: np.ndarray, fault: str):
    with pytest.raises(SpecError, match=fault):
        scaled(Steps(mean=mean.astype(np.float32)))


def test_invalid_values_are_refused():
    with pytest.raises(SpecError, match="scale and raw_scale are numbers: could not convert"):
        Steps.of(None, "x", 1, False)
    with pytest.raises(SpecError, match='found swap "maybe", expected true or false'):
        Steps.of(None, 1, 1, "maybe")
    with pytest.raises(SpecError, match='mean file "1,x" cannot be read'):
        Steps.of("1,x", 1, 1, False)


@pytest.fixture
def colors(run: Callable[..., Any]) -> Path:
    """A folder with one image of one color, and a net that passes it through."""
    Path("net.prototxt").write_text(
        'layer { name: "in" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 2 dim: 2 } } }\n'
        'layer { name: "p" type: "Power" bottom: "data" top: "p" }'
    )
    Path("w.caffemodel").write_bytes(b"\x0a\x01n")  # a net named n
    Path("images").mkdir()
    cv2.imwrite("images/1.png", np.full((2, 2, 3), (10, 20, 30), np.uint8))
    return Path("images")


@pytest.mark.slow
def test_extract_and_describer_accept_the_steps(run: Callable[..., Any], colors: Path):
    words = ["extract", "--model", "net.prototxt", "--blob", "p", "--out", "f.npz"]
    steps = ["--mean", "1,2,3", "--scale", "0.5", "--raw-scale", "2", "--swap"]
    result = run(*words, "--images", colors, *steps)
    assert (
        result.out.splitlines()[1]
        == "data (3 x 2 x 2): RGB, 0 to 255, times 2, minus 1, 2, 3, times 0.5 (from the options)"
    )
    expected = np.repeat([29.5, 19, 8.5], 4)
    np.testing.assert_array_equal(np.load("f.npz")["features"], [expected])
    describe = Describer("net.prototxt", "w.caffemodel", "p", mean="1,2,3", scale="0.5", raw_scale=2, swap=True)
    np.testing.assert_array_equal(describe(np.full((5, 5, 3), (10, 20, 30), np.uint8)), expected)
    write_mean("mean.binaryproto", np.full((3, 4, 4), 5, np.float32))
    assert run(*words, "--images", colors, "--mean", "mean.binaryproto").status == 0
    np.testing.assert_array_equal(np.load("f.npz")["features"], [np.repeat([5, 15, 25], 4)])
    np.save("mean.npy", np.full((3, 2, 2), 6))
    assert run(*words, "--images", colors, "--mean", "mean.npy").status == 0
    np.testing.assert_array_equal(np.load("f.npz")["features"], [np.repeat([4, 14, 24], 4)])
    refused = run(*words, "--mean", "5")
    assert refused.status == 2
    assert "--mean is for --images" in refused.err
