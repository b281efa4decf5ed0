"""Layers that reshape, join, split or select values, and arithmetic between blobs and over axes."""

import math

import numpy as np
import pytest
import torch

from netspec.errors import SpecError


def counting(*shape: int) -> torch.Tensor:
    return torch.arange(float(math.prod(shape))).reshape(shape)


# Flatten and Reshape


@pytest.mark.parametrize(
    ("text", "bottom", "top"),
    [
        ("", (2, 3, 4, 5), (2, 60)),
        ("axis: 2", (2, 3, 4, 5), (2, 3, 20)),
        ("axis: 1 end_axis: 2", (2, 3, 4, 5), (2, 12, 5)),
        ("axis: -3 end_axis: -2", (2, 3, 4, 5), (2, 12, 5)),
        ("axis: 0", (2, 3), (6,)),
        ("axis: 1 end_axis: 1", (2, 3, 4), (2, 3, 4)),
    ],
    ids=["default", "axis", "end_axis", "negative", "all", "one_axis"],
)
def test_flatten_joins_axes(build, text: str, bottom: tuple, top: tuple) -> None:
    layer = build(f'type: "Flatten" flatten_param {{ {text} }}', bottom)
    assert layer.top_shapes == [top]
    assert torch.equal(layer.run(counting(*bottom))[0], counting(*top))


RESHAPED = {
    "sizes": ("shape { dim: 2 dim: 8 }", (2, 8, 1, 1), (2, 8)),
    "copied_and_inferred": ("shape { dim: 0 dim: -1 }", (2, 3, 4), (2, 12)),  # 0 copies, -1 is inferred
    "inferred_in_the_middle": ("shape { dim: 0 dim: 0 dim: -1 dim: 2 }", (2, 3, 4), (2, 3, 2, 2)),
    "one_axis": ("shape { dim: -1 }", (2, 3, 4), (24,)),
    "replaced_axis": ("shape { dim: 3 dim: 1 } axis: 1 num_axes: 1", (2, 3, 4), (2, 3, 1, 4)),
    "inserted_last": ("shape { dim: 1 } axis: -1 num_axes: 0", (2, 3), (2, 3, 1)),  # -1: after the last
    "inserted_first": ("shape { dim: 1 } axis: 0 num_axes: 0", (2, 3), (1, 2, 3)),
    "removed_axis": ("axis: 1 num_axes: 1", (2, 1, 3), (2, 3)),  # no shape: the axes go
    "copied_from_axis": ("shape { dim: -1 dim: 0 } axis: 1", (2, 6, 2), (2, 6, 2)),  # 0 copies its own axis
}


@pytest.mark.parametrize(("text", "bottom", "top"), RESHAPED.values(), ids=RESHAPED)
def test_reshape_replaces_axes(build, text: str, bottom: tuple, top: tuple) -> None:
    layer = build(f'type: "Reshape" reshape_param {{ {text} }}', bottom)
    assert layer.top_shapes == [top]
    assert torch.equal(layer.run(counting(*bottom))[0], counting(*top))


def test_reshape_accepts_another_batch_size(build) -> None:
    layer = build('type: "Reshape" reshape_param { shape { dim: 0 dim: -1 } }', (2, 3, 4))
    assert layer.run(counting(5, 3, 4))[0].shape == (5, 12)


# Concat and Slice


@pytest.mark.parametrize(
    ("text", "shapes", "axis"),
    [
        ("", [(2, 3, 4), (2, 1, 4)], 1),
        ("axis: -1", [(2, 3, 4), (2, 3, 2), (2, 3, 1)], 2),
        ("concat_dim: 0", [(2, 3), (1, 3)], 0),
        ("axis: 0", [(2, 3)], 0),
    ],
    ids=["default", "last_axis", "concat_dim", "one_bottom"],
)
def test_concat_joins_along_an_axis(build, text: str, shapes: list, axis: int) -> None:
    layer = build(f'type: "Concat" concat_param {{ {text} }}', *shapes)
    bottoms = [torch.randn(shape) for shape in shapes]
    top = layer.run(*bottoms)[0]
    expected = np.concatenate([b.numpy() for b in bottoms], axis)
    np.testing.assert_array_equal(top.numpy(), expected)
    assert layer.top_shapes == [expected.shape]


@pytest.mark.parametrize(
    ("text", "tops", "sizes", "axis"),
    [
        ("", 3, [2, 2, 2], 1),
        ("slice_point: 1 slice_point: 4", 3, [1, 3, 2], 1),
        ("slice_dim: 2 slice_point: 3", 2, [3, 1], 2),
        ("axis: -3", 2, [1, 1], 0),
        ("", 1, [6], 1),
        ("slice_point: 6", 2, [6, 0], 1),
    ],
    ids=["equal_parts", "slice_points", "slice_dim", "negative_axis", "one_top", "empty_last_top"],
)
def test_slice_cuts_an_axis(build, text: str, tops: int, sizes: list, axis: int) -> None:
    layer = build(f'type: "Slice" slice_param {{ {text} }}', (2, 6, 4), tops=tops)
    bottom = torch.randn(2, 6, 4)
    parts = layer.run(bottom)
    assert [part.shape[axis] for part in parts] == sizes
    assert torch.equal(torch.cat(parts, axis), bottom)
    assert layer.top_shapes == [part.shape for part in parts]


# Split, Tile, Silence, Parameter


@pytest.mark.parametrize(
    ("text", "top"), [("tiles: 3", (2, 9, 2)), ("axis: -1 tiles: 2", (2, 3, 4))], ids=["default_axis", "last_axis"]
)
def test_tile_repeats_the_whole_axis(build, text: str, top: tuple) -> None:
    layer = build(f'type: "Tile" tile_param {{ {text} }}', (2, 3, 2))
    assert layer.top_shapes == [top]
    bottom = torch.randn(2, 3, 2)
    axis = 1 if top[1] == 9 else 2
    assert torch.equal(layer.run(bottom)[0], torch.cat([bottom] * (top[axis] // bottom.shape[axis]), axis))


def test_parameter_is_a_learnable_blob_of_zeros(build) -> None:
    layer = build('type: "Parameter" parameter_param { shape { dim: 2 dim: 3 } }')
    assert (layer.top_shapes, layer.blob_shapes) == ([(2, 3)], [(2, 3)])
    top = layer.run()[0]
    assert top.tolist() == [[0] * 3] * 2
    top.sum().backward()
    assert layer.blobs[0].grad.tolist() == [[1] * 3] * 2


# BatchReindex and Filter


@pytest.mark.parametrize("index", [-1, 3])
def test_batch_reindex_refuses_an_index_out_of_range(build, index: int) -> None:
    layer = build('type: "BatchReindex"', (3, 2), (2,))
    with pytest.raises(SpecError, match=rf"bottom.1: found index {index}, expected 0 to 2"):
        layer.run(torch.ones(3, 2), torch.tensor([0.0, index]))


def test_filter_can_select_no_item(build) -> None:
    layer = build('type: "Filter"', (3, 2), (3,))
    assert layer.run(torch.ones(3, 2), torch.zeros(3))[0].shape == (0, 2)


# Eltwise


def test_eltwise_max_resolves_ties_for_the_second_bottom_and_never_for_a_later_one(build) -> None:
    layer = build('type: "Eltwise" eltwise_param { operation: MAX }', (4,), (4,), (4,))
    bottoms = [
        torch.tensor(values, requires_grad=True)
        for values in ([1.0, 1.0, 2.0, 1.0], [1.0, 1.0, 1.0, 2.0], [0.0, 1.0, 2.0, 2.0])
    ]
    top = layer.run(*bottoms)[0]
    assert top.tolist() == [1, 1, 2, 2]
    gradients = torch.autograd.grad(top.sum(), bottoms)
    assert [gradient.tolist() for gradient in gradients] == [[0, 0, 1, 0], [1, 1, 0, 1], [0, 0, 0, 0]]


@pytest.mark.parametrize("stable", ["true", "false"])
def test_eltwise_prod_has_the_true_gradient_at_zeros(build, stable: str) -> None:
    # Caffe's for stable_prod_grad: false is top / bottom, 0 / 0 here.
    layer = build(f'type: "Eltwise" eltwise_param {{ operation: PROD stable_prod_grad: {stable} }}', (3,), (3,), (3,))
    bottoms = [
        torch.tensor(values, requires_grad=True) for values in ([0.0, 0.0, 2.0], [3.0, 0.0, 3.0], [5.0, 5.0, 5.0])
    ]
    gradients = torch.autograd.grad(layer.run(*bottoms)[0].sum(), bottoms)
    assert [gradient.tolist() for gradient in gradients] == [[15, 0, 15], [0, 0, 10], [0, 0, 6]]


# Reduction


@pytest.mark.parametrize("axis", [0, 1, -1])
@pytest.mark.parametrize(
    ("operation", "expected"),
    [
        ("SUM", lambda x, axes: x.sum(axes)),
        ("ASUM", lambda x, axes: np.abs(x).sum(axes)),
        ("SUMSQ", lambda x, axes: (x**2).sum(axes)),
        ("MEAN", lambda x, axes: x.mean(axes)),
    ],
    ids=["SUM", "ASUM", "SUMSQ", "MEAN"],
)
def test_reduction_reduces_axis_and_all_later_axes(build, operation: str, expected, axis: int) -> None:
    layer = build(f'type: "Reduction" reduction_param {{ operation: {operation} axis: {axis} coeff: 2 }}', (2, 3, 4))
    bottom = torch.randn(2, 3, 4)
    top = layer.run(bottom)[0].numpy()
    np.testing.assert_allclose(top, 2 * expected(bottom.numpy(), tuple(range(axis % 3, 3))), rtol=1e-5, atol=1e-5)
    assert layer.top_shapes == [top.shape]


def test_reduction_asum_has_gradient_zero_at_zero(build) -> None:
    bottom = torch.tensor([-2.0, 0.0, 3.0], requires_grad=True)
    build('type: "Reduction" reduction_param { operation: ASUM }', (3,)).run(bottom)[0].backward()
    assert bottom.grad is not None
    assert bottom.grad.tolist() == [-1, 0, 1]


# ArgMax


def top_pairs(values: list[float], top_k: int) -> list[tuple[float, int]]:
    """Return the greatest pairs of value and index, the greatest first, as Caffe sorts them."""
    return sorted(((v, i) for i, v in enumerate(values)), reverse=True)[:top_k]


def test_argmax_resolves_ties_for_the_larger_index(build) -> None:
    layer = build('type: "ArgMax" argmax_param { top_k: 3 }', (1, 5))
    assert layer.run(torch.tensor([[2.0, 7.0, 7.0, 1.0, 7.0]]))[0].tolist() == [[[4, 2, 1]]]


@pytest.mark.parametrize(
    ("text", "bottom", "top"),
    [
        ("", (2, 5), (2, 1, 1)),
        ("top_k: 2", (2, 3, 4), (2, 1, 2)),
        ("top_k: 2 out_max_val: true", (2, 3, 4, 5), (2, 2, 2, 1)),
        ("top_k: 3", (2, 3, 2, 2, 2), (2, 1, 3, 1, 1)),
        ("out_max_val: true", (3,), (3, 2, 1)),
    ],
    ids=["default", "top_2", "top_2_with_values", "top_3_of_five_axes", "one_axis_with_values"],
)
def test_argmax_without_axis_flattens_each_item(build, text: str, bottom: tuple, top: tuple) -> None:
    layer = build(f'type: "ArgMax" argmax_param {{ {text} }}', bottom)
    x = torch.randint(0, 4, bottom).float().requires_grad_()
    found = layer.run(x)[0]
    assert layer.top_shapes == [top] == [tuple(found.shape)]
    assert not found.requires_grad
    for item, row in zip(x.reshape(bottom[0], -1).tolist(), found.reshape(top[:3]).tolist(), strict=True):
        pairs = top_pairs(item, top[2])
        assert row[0] == [i for _, i in pairs]
        assert row[1:] == ([[v for v, _ in pairs]] if top[1] == 2 else [])


@pytest.mark.parametrize("out_max_val", ["false", "true"])
def test_argmax_along_an_axis_returns_indices_or_values(build, out_max_val: str) -> None:
    layer = build(f'type: "ArgMax" argmax_param {{ axis: -2 top_k: 2 out_max_val: {out_max_val} }}', (2, 4, 3))
    x = torch.randint(0, 3, (2, 4, 3)).float()
    found = layer.run(x)[0]
    assert layer.top_shapes == [(2, 2, 3)]
    for n, c in np.ndindex(2, 3):
        pairs = top_pairs(x[n, :, c].tolist(), 2)
        assert found[n, :, c].tolist() == [v if out_max_val == "true" else i for v, i in pairs]


# Softmax


def test_softmax_caffes_gradient_is_computed_from_the_given_top(build) -> None:
    layer = build('type: "Softmax"', (1, 3))
    top, diff = torch.tensor([[1.0, 2.0, -1.0]]), torch.tensor([[3.0, 0.5, 1.0]])
    assert layer.caffes_gradient(torch.zeros(1, 3), top, diff).tolist() == [[0, -5, 2]]
