"""Layers that only move numbers, beside plain loops over their indices."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top.detach().numpy()


def test_transpose(build: Build, gradcheck: Gradcheck) -> None:
    data = torch.randn(2, 3, 4, 5)
    layer = build("layout", "type: 'Transpose' transpose_param { dim: 3 dim: 0 dim: 2 dim: 1 }", data.shape)
    np.testing.assert_array_equal(run(layer, data), data.numpy().transpose(3, 0, 2, 1))
    gradcheck(layer, torch.randn(1, 2, 2, 3))


@pytest.mark.parametrize("dim", ["dim: [0, 1, 2]", "dim: [0, 1, 1, 3]", "dim: [1, 2, 3, 4]", ""])
def test_transpose_wants_every_axis_once(build: Build, dim: str) -> None:
    with pytest.raises(SpecError, match="expected each of the 4 axes 0 to 3 once"):
        build("layout", f"type: 'Transpose' transpose_param {{ {dim} }}", (2, 3, 4, 5))


def darknet(x: np.ndarray, stride: int, reverse: bool, shape: tuple[int, ...]) -> np.ndarray:
    """Darknet's loops over the bottom's indices, on flat arrays."""
    _, c, h, w = x.shape
    flat, out = x.ravel(), np.zeros(x.size, x.dtype)
    few = c // stride**2
    for b, k, j, i in np.ndindex(x.shape):
        here = i + w * (j + h * (k + c * b))
        offset, c2 = divmod(k, few)
        there = (
            i * stride + offset % stride + w * stride * (j * stride + offset // stride + h * stride * (c2 + few * b))
        )
        if reverse:
            out[there] = flat[here]
        else:
            out[here] = flat[there]
    return out.reshape(shape)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_reorg(build: Build, gradcheck: Gradcheck, stride: int) -> None:
    data = torch.randn(2, 2 * stride**2, 2 * stride, 3 * stride)
    text = f"type: 'Reorg' reorg_param {{ stride: {stride} %s }}"
    layer = build("layout", text % "", data.shape)
    shape = (2, 2 * stride**4, 2, 3)
    np.testing.assert_array_equal(run(layer, data), darknet(data.numpy(), stride, False, shape))
    back = build("layout", text % "reverse: true", shape)
    top = torch.from_numpy(run(layer, data))
    np.testing.assert_array_equal(run(back, top), darknet(top.numpy(), stride, True, tuple(data.shape)))
    gradcheck(build("layout", text % "", (1, stride**2, stride, stride)), torch.randn(1, stride**2, stride, stride))


@pytest.mark.parametrize(
    ("param", "shape", "fault"),
    [
        ("", (1, 4, 4, 4), "stride must be given"),
        ("stride: 2", (1, 6, 4, 4), "C a multiple of 4, and sides that are multiples of 2"),
        ("stride: 2", (1, 4, 5, 4), "sides that are multiples of 2"),
        ("stride: 2 reverse: true", (1, 6, 4, 4), "C a multiple of 4$"),
        ("stride: 2", (4, 4), "expected"),
    ],
)
def test_reorg_wants_sizes_that_divide(build: Build, param: str, shape: tuple[int, ...], fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        build("layout", f"type: 'Reorg' reorg_param {{ {param} }}", shape)


def test_merge_crop_stacks_and_adds(build: Build) -> None:
    small, large = torch.randn(2, 3, 4, 2), torch.randn(2, 3, 7, 4)
    cut = large[:, :, 1:5, 1:3]
    layer = build("layout", "type: 'MergeCrop'", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([small, cut], 1))
    layer = build("layout", "type: 'MergeCrop' mergecrop_param { operation: ADD }", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), small + cut)
    only = "type: 'MergeCrop' mergecrop_param { forward: [0, 1] }"
    layer = build("layout", only, small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([torch.zeros_like(small), cut], 1))


@pytest.mark.parametrize(("param", "learns"), [("", (True, False)), ("backward: 0 backward: 1", (False, True))])
def test_merge_crop_gives_gradients_as_asked_for(build: Build, param: str, learns: tuple[bool, bool]) -> None:
    bottoms = [torch.randn(1, 2, 2, 2, requires_grad=True), torch.randn(1, 2, 4, 4, requires_grad=True)]
    layer = build("layout", f"type: 'MergeCrop' mergecrop_param {{ {param} }}", (1, 2, 2, 2), (1, 2, 4, 4))
    layer.run(*bottoms)[0].sum().backward()
    assert tuple(bottom.grad is not None for bottom in bottoms) == learns
    if learns[1]:
        assert bottoms[1].grad is not None
        assert bottoms[1].grad[0, 0].tolist() == [[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]


@pytest.mark.parametrize(
    ("param", "large"),
    [("", (2, 3, 3, 9)), ("", (1, 3, 9, 9)), ("", (2, 3, 9)), ("operation: ADD", (2, 5, 9, 9))],
)
def test_merge_crop_refuses_what_does_not_fit(build: Build, param: str, large: tuple[int, ...]) -> None:
    with pytest.raises(SpecError, match="expected a smaller one and one to cut to its size"):
        build("layout", f"type: 'MergeCrop' mergecrop_param {{ {param} }}", (2, 3, 4, 4), large)
    with pytest.raises(SpecError, match="found 3 forward, expected one per bottom"):
        build("layout", "type: 'MergeCrop' mergecrop_param { forward: [1, 1, 1] }", (2, 3, 4, 4), (2, 3, 4, 4))


def test_crop_center(build: Build, gradcheck: Gradcheck) -> None:
    data = torch.randn(1, 2, 7, 6)
    layer = build("layout", "type: 'CropCenter' crop_center_param { crop_size: [0, 0, 2, 1] }", data.shape)
    np.testing.assert_array_equal(run(layer, data), data.numpy()[:, :, 2:-2, 1:-1])
    gradcheck(layer, data)


@pytest.mark.parametrize("sizes", ["[0, 0, 2]", "[0, 0, 4, 0]", "[1, 0, 0, 0]"])
def test_crop_center_leaves_something(build: Build, sizes: str) -> None:
    with pytest.raises(SpecError, match=r"expected one for each axis of .1, 2, 7, 6., less than half of it"):
        build("layout", f"type: 'CropCenter' crop_center_param {{ crop_size: {sizes} }}", (1, 2, 7, 6))
