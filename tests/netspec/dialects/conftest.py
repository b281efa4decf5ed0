"""Fixtures that build single layers of a dialect and check their gradients."""

from collections.abc import Callable

import pytest
import torch

from fake_gpu import NAME, POSSIBLE, fake_gpu
from netspec import use_dialect
from netspec.layers import Context, Layer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST


@pytest.fixture
def build() -> Callable[..., Layer]:
    """``build(dialect, text, *bottom_shapes, phase=TEST, tops=1)``: a layer from the text of a LayerParameter.

    Its faults have the places of that text, the file being "<layer>".
    """

    def build_layer(name: str, text: str, *shapes: tuple[int, ...], phase: int = TEST, tops: int = 1) -> Layer:
        use_dialect(name)
        return make_layer(text, shapes, Context(phase), tops)

    return build_layer


@pytest.fixture
def gradcheck(gradcheck: Callable[..., None]) -> Callable[..., None]:
    """Return the gradcheck of all tests, which here also compares a GPU with the CPU."""

    def check(layer: Layer, *bottoms: torch.Tensor, fixed: tuple[int, ...] = ()) -> None:
        gradcheck(layer, *bottoms, fixed=fixed)
        if POSSIBLE:
            _compare_on_the_gpu(layer.float(), [bottom.detach().float() for bottom in bottoms])

    return check


def _compare_on_the_gpu(layer: Layer, bottoms: list[torch.Tensor]) -> None:
    expected = layer.run(*bottoms)
    with fake_gpu():
        for tensors in (module._parameters for module in layer.modules()):
            tensors.update(
                {name: torch.nn.Parameter(p.detach().to(NAME)) for name, p in tensors.items() if p is not None}
            )
        for tensors in (module._buffers for module in layer.modules()):
            tensors.update({name: b.to(NAME) for name, b in tensors.items() if b is not None})
        found = layer.run(*[bottom.to(NAME).requires_grad_() for bottom in bottoms])
        learned = [top for top in found if top.requires_grad]
        torch.autograd.backward(learned, [torch.ones_like(top) for top in learned])
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.device.type == NAME
        torch.testing.assert_close(ours.detach().cpu(), theirs.detach(), rtol=1e-4, atol=1e-5)
