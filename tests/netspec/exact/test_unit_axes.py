"""Batch normalization by torch: the stride of an axis of length 1 must not decide what a gradient is."""

import itertools

import pytest
import torch

from netspec.exact.by_torch import normalized_batch, normalizes, scales_channels

LAST = {4: torch.channels_last, 5: torch.channels_last_3d}
FUNCTIONS = {
    "by batch": lambda data: normalized_batch(data, torch.batch_norm, (None, None), 1e-5, False)[0],
    "by statistics": lambda data: normalizes(data.new_zeros(16), data.new_ones(16), 1e-5)(data),
    "scaled": lambda data: scales_channels(torch.linspace(1, 2, 16, dtype=data.dtype), None)(data),
}


def _laid_out(values: torch.Tensor, layout: str) -> torch.Tensor:
    """Return the values in a layout. A view gives an axis of length 1 another stride than channels_last has."""
    if layout == "Caffe's":
        return values.contiguous()
    last = values.clone(memory_format=LAST[values.dim()])
    if layout == "channels_last":
        return last
    return last.as_strided(last.shape, [16 if n == 1 else s for n, s in zip(last.shape, last.stride(), strict=True)])


@pytest.mark.parametrize(
    "shape", [(1, 16, 8, 8), (2, 16, 1, 8), (3, 16, 8, 1), (1, 16, 4, 4, 4), (2, 16, 4, 1, 4)], ids=str
)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_layout_of_maps_and_gradients_gives_the_gradient_in_double(name: str, shape: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    values, diff = (torch.randn(shape, generator=generator, dtype=torch.double) for _ in range(2))

    def gradient(data: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        data = data.detach().requires_grad_()
        FUNCTIONS[name](data).backward(diff)
        assert data.grad is not None
        return data.grad

    expected = gradient(values, diff).float()
    layouts = ["Caffe's", "channels_last", "a view's"]
    for of_data, of_diff in itertools.product(layouts, layouts):
        found = gradient(_laid_out(values.float(), of_data), _laid_out(diff.float(), of_diff))
        assert torch.allclose(found, expected, atol=1e-5), (of_data, of_diff)
