"""InnerProduct, Dropout and Embed, and negative sizes."""

import math

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.fast.fused import vector_product
from netspec.proto.schema import TRAIN

FILL = 'weight_filler { type: "gaussian" } bias_filler { type: "gaussian" }'


@pytest.mark.parametrize("axis", [0, 1, 2, 3, -1, -2])
@pytest.mark.parametrize("transpose", [False, True], ids=["plain", "transposed"])
def test_inner_product_flattens_axis_and_all_later_axes(build, axis: int, transpose: bool) -> None:
    settings = f"num_output: 6 axis: {axis} transpose: {str(transpose).lower()} {FILL}"
    data = torch.randn(2, 3, 4, 5)
    layer = build(f'type: "InnerProduct" inner_product_param {{ {settings} }}', data.shape)
    outer, length = data.shape[:axis], math.prod(data.shape[axis:])
    assert layer.blob_shapes == [(length, 6) if transpose else (6, length), (6,)]
    weight, bias = (blob.detach().numpy() for blob in layer.blobs)
    rows = data.numpy().reshape(-1, length)
    expected = rows @ (weight if transpose else weight.T) + bias
    (top,) = layer.run(data)
    assert layer.top_shapes == [(*outer, 6)] == [tuple(top.shape)]
    np.testing.assert_allclose(top.detach().numpy().reshape(-1, 6), expected, atol=1e-4)
    assert layer.multiply_adds() == math.prod(outer) * 6 * length


def test_inner_product_accepts_another_batch_size_but_no_other_length(build) -> None:
    layer = build('type: "InnerProduct" inner_product_param { num_output: 3 }', (2, 3, 4))
    assert layer.run(torch.randn(7, 4, 3))[0].shape == (7, 3)  # only the count matters
    with pytest.raises(SpecError, match=r"^bottom: .* has 15 values from axis 1 on, expected 12"):
        layer.run(torch.randn(2, 3, 5))


@pytest.mark.parametrize(("rows", "length", "bias"), [(500, 4243, True), (1003, 1050, True), (130, 8070, False)])
def test_the_product_of_one_vector_is_right_on_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch, rows: int, length: int, bias: bool
) -> None:
    draw = torch.Generator().manual_seed(1)
    vector, weight = (torch.randn(n, length, generator=draw) for n in (1, rows))
    biases = torch.randn(rows, generator=draw) if bias else None
    expected = torch.nn.functional.linear(vector.double(), weight.double(), None if biases is None else biases.double())
    divisions, divide = [], torch.bmm
    monkeypatch.setattr(torch, "bmm", lambda *given: divisions.append(1) or divide(*given))
    multiply = vector_product(weight, biases)
    for threads in (1, 2, 3, 7):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        torch.testing.assert_close(multiply(vector).double(), expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert bool(divisions) == torch.backends.mkl.is_available()


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.8])
def test_dropout_zeroes_a_share_and_scales_the_rest_in_training(build, ratio: float) -> None:
    layer = build(f'type: "Dropout" dropout_param {{ dropout_ratio: {ratio} }}', (40, 1000), phase=TRAIN)
    data = (torch.rand(40, 1000) + 1).requires_grad_()
    (top,) = layer.run(data)
    kept = top != 0
    assert float(kept.float().mean()) == pytest.approx(1 - ratio, abs=6 * 0.5 / math.sqrt(40000))
    torch.testing.assert_close(top, torch.where(kept, data / (1 - ratio), 0))
    top.sum().backward()
    torch.testing.assert_close(data.grad, kept / (1 - ratio))  # the same mask backward
    assert not torch.equal(kept, layer.run(data)[0] != 0)  # another one next time


def test_dropout_masks_are_determined_by_the_seed(build) -> None:
    text, data = 'type: "Dropout"', torch.ones(50, 50)
    first = build(text, (50, 50), phase=TRAIN, seed=3).run(data)[0]
    assert torch.equal(first, build(text, (50, 50), phase=TRAIN, seed=3).run(data)[0])
    assert not torch.equal(first, build(text, (50, 50), phase=TRAIN, seed=4).run(data)[0])
    assert set(first.flatten().tolist()) == {0.0, 2.0}  # 0.5 is the default ratio


def test_dropout_masks_do_not_depend_on_the_layout(build) -> None:
    data = torch.ones(2, 8, 5, 5)
    laid_out = data.contiguous(memory_format=torch.channels_last)
    one, other = (build('type: "Dropout"', data.shape, phase=TRAIN).run(x)[0] for x in (data, laid_out))
    assert torch.equal(one, other)


def test_the_phase_of_a_layer_overrides_the_nets(build) -> None:
    data = torch.ones(10, 100)
    assert torch.equal(build('type: "Dropout" phase: TEST', data.shape, phase=TRAIN).run(data)[0], data)


def test_embed_without_bias_accepts_another_shape(build) -> None:
    layer = build(f'type: "Embed" embed_param {{ num_output: 3 input_dim: 5 bias_term: false {FILL} }}', (2,))
    assert len(layer.blobs) == 1
    torch.testing.assert_close(layer.run(torch.tensor([[3.0]]))[0], layer.blobs[0][3].reshape(1, 1, 3))


@pytest.mark.parametrize("index", [-1.0, 5.0, 1.5, math.nan])
def test_embed_refuses_invalid_indices(build, index: float) -> None:
    layer = build('type: "Embed" embed_param { num_output: 3 input_dim: 5 }', (2,))
    with pytest.raises(SpecError, match=rf"^bottom: found index {index:g}, expected integers from 0 to 4"):
        layer.run(torch.tensor([1.0, index]))
