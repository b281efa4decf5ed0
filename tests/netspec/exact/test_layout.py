"""The gradient of maps has the same memory layout as the maps."""

from collections.abc import Callable

import pytest
import torch

from netspec.exact.layout import channels_side_by_side, map_by_map

FORMATS = {"map by map": torch.contiguous_format, "side by side": torch.channels_last}


@pytest.mark.parametrize("given", FORMATS)
@pytest.mark.parametrize(
    ("lay_out", "wanted"),
    [(channels_side_by_side, "side by side"), (map_by_map, "map by map")],
    ids=["side by side wanted", "map by map wanted"],
)
def test_a_gradient_has_the_layout_of_its_maps(
    given: str, lay_out: Callable[[torch.Tensor], torch.Tensor], wanted: str
) -> None:
    """Kernels after it round otherwise for another layout."""
    maps = torch.randn(2, 4, 3, 5).contiguous(memory_format=FORMATS[given]).requires_grad_()
    made = lay_out(maps)
    assert made.is_contiguous(memory_format=FORMATS[wanted])
    assert torch.equal(made, maps)
    diff = torch.randn(2, 4, 3, 5).contiguous(memory_format=FORMATS[wanted])
    (found,) = torch.autograd.grad(made, maps, diff)
    assert torch.equal(found, diff)
    assert found.is_contiguous(memory_format=FORMATS[given])
