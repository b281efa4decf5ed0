"""MergeCrop of dialect layout: its values and gradients."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.layers import Layer

Build = Callable[..., Layer]


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top.detach().numpy()


def test_merge_crop_concatenates_or_adds_the_cropped_bottom(build: Build) -> None:
    small, large = torch.randn(2, 3, 4, 2), torch.randn(2, 3, 7, 4)
    cut = large[:, :, 1:5, 1:3]
    layer = build("layout", "type: 'MergeCrop'", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([small, cut], 1))
    layer = build("layout", "type: 'MergeCrop' mergecrop_param { operation: ADD }", small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), small + cut)
    only = "type: 'MergeCrop' mergecrop_param { forward: [0, 1] }"
    layer = build("layout", only, small.shape, large.shape)
    np.testing.assert_array_equal(run(layer, small, large), torch.cat([torch.zeros_like(small), cut], 1))


@pytest.mark.parametrize(
    ("param", "learns"), [("", (True, False)), ("backward: 0 backward: 1", (False, True))], ids=["first", "second"]
)
def test_merge_crop_computes_the_requested_gradients(build: Build, param: str, learns: tuple[bool, bool]) -> None:
    bottoms = [torch.randn(1, 2, 2, 2, requires_grad=True), torch.randn(1, 2, 4, 4, requires_grad=True)]
    layer = build("layout", f"type: 'MergeCrop' mergecrop_param {{ {param} }}", (1, 2, 2, 2), (1, 2, 4, 4))
    layer.run(*bottoms)[0].sum().backward()
    assert tuple(bottom.grad is not None for bottom in bottoms) == learns
    if learns[1]:
        assert bottoms[1].grad is not None
        assert bottoms[1].grad[0, 0].tolist() == [[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
