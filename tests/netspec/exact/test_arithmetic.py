"""Both arithmetics have all operations, and compute the same results and gradients except for rounding."""

import ast
import inspect

import pytest
import torch

from netspec.exact import ALL, NONE, libm
from netspec.exact.arithmetic import AsCaffe, AsTorch, arithmetic
from netspec.exact.lrn import Settings
from netspec.exact.pointwise import tanh_gradient
from netspec.exact.products import Filter
from paths import ROOT

OF_BOTH = {"floored"}  # nothing of its own that rounds: one way to compute it
FILTER = Filter((3, 2), (2, 1), (1, 1), (1, 2))
LRN = Settings(3, 0.5, 0.75, 2.0)


def drawn(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape))).requires_grad_()


def positive(*shape: int) -> torch.Tensor:
    return (drawn(*shape).detach().abs() + 0.1).requires_grad_()


MAPS, ROWS = drawn(2, 4, 7, 6), drawn(3, 5)
CASES = {
    "inner_product": (drawn(2, 3, 5), drawn(4, 5), drawn(4)),
    "product_of_step": (ROWS, drawn(4, 5), drawn(4)),
    "chosen_rows": (torch.tensor([[3, 0], [3, 3]]), drawn(4, 5), drawn(5)),
    "convolution": (MAPS, drawn(6, 2, 3, 2), drawn(6), FILTER, 2),
    "deconvolution": (MAPS, drawn(4, 3, 3, 2), drawn(6), (FILTER, 2), (13, 6)),
    "columns": (MAPS, FILTER),
    "scaled": (MAPS, 1, drawn(4), drawn(4)),
    "sloped": (MAPS, drawn(4)),
    "normalized_batch": (MAPS, 1e-5, drawn(4), drawn(4)),
    "normalizes": (drawn(4).detach(), positive(4).detach(), 1e-5),
    "standardized": (ROWS, 1e-3),
    "standardized_gradient": (ROWS, drawn(3, 5), drawn(3, 5), 1e-3),
    "across_channels": (MAPS, LRN),
    "across_channels_gradient": (MAPS, drawn(2, 4, 7, 6), drawn(2, 4, 7, 6), LRN),
    "within_channel": (MAPS, LRN),
    "softmax": (MAPS, 1),
    "softmax_gradient": (MAPS, drawn(2, 4, 7, 6), 1),
    "function": (MAPS, torch.tanh, libm.tanh, tanh_gradient),
    "log": (positive(3, 5),),
    "lstm_unit": (drawn(3, 5), drawn(3, 20), torch.tensor([[1.0], [0.0], [1.0]])),
    "weighted_sum": ((ROWS, drawn(3, 5), drawn(3, 5)), (1.0, 0.3, -2.0)),
    "product": ((ROWS, drawn(3, 5), drawn(3, 5)), False),
    "sigmoid_cross_entropy": (ROWS, positive(3, 5).detach()),
    "sums": (MAPS, 2, 0.7),
    "sums_of_magnitudes": (MAPS, 1),
    "sums_of_squares": (MAPS,),
    "total": (ROWS,),
    "infogain": (drawn(2, 4, 3), positive(2, 3, 4).detach(), 1e-20),
    "copies": (ROWS, 3),
    "tiles": (MAPS, 1, 3),
}


def tensors(values: object) -> list[torch.Tensor]:
    if isinstance(values, torch.Tensor):
        return [values]
    return [tensor for value in values for tensor in tensors(value)] if isinstance(values, tuple) else []


def computed(how: AsTorch, name: str) -> list[torch.Tensor]:
    """Return what an operation makes, each summed with weights, and the gradients of its arguments."""
    made = getattr(how, name)(*CASES[name])
    found = tensors(made(MAPS) if callable(made) else made)
    if name == "infogain":
        found[0] = found[0].sum(2)  # of each class, or their sums
    if name == "normalized_batch":
        assert isinstance(made, tuple)
        found[2] = found[2] * made[3]
    terms = [(x * torch.linspace(-1, 2, x.numel()).view(x.shape)).sum() for x in found if x.requires_grad]
    learned = [x for x in tensors(CASES[name]) if x.requires_grad]
    if not name.endswith("gradient") and learned:
        found += [x for x in torch.autograd.grad(torch.stack(terms).sum(), learned, allow_unused=True) if x is not None]
    return found


@pytest.mark.parametrize("name", CASES)
def test_caffes_and_torchs_numbers_agree(name: str) -> None:
    found, expected = computed(AsCaffe(), name), computed(AsTorch(), name)
    assert [x.shape for x in found] == [x.shape for x in expected]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-5, atol=2e-5)


def test_each_operation_has_both_ways_and_a_case() -> None:
    operations = {name for name in vars(AsTorch) if not name.startswith("_") and name != "is_caffes"}
    assert operations == set(CASES) | OF_BOTH
    assert operations - OF_BOTH == {name for name in vars(AsCaffe) if not name.startswith("_") and name != "is_caffes"}
    for name in operations - OF_BOTH:
        assert inspect.signature(getattr(AsTorch, name)) == inspect.signature(getattr(AsCaffe, name))


def test_the_option_chooses() -> None:
    x = torch.ones(2)
    assert [arithmetic(exact, x).is_caffes for exact in (NONE, "small", ALL)] == [False, False, True]
    assert arithmetic("small", x, small=True).is_caffes
    assert arithmetic(ALL, x, in_place=True).in_place


def test_no_forward_depends_on_the_kind_of_arithmetic() -> None:
    """It is asked once, where a layer gets its arithmetic."""
    asking = {
        f"{path.name}:{function.name}"
        for path in sorted((ROOT / "netspec" / "layers").rglob("*.py"))
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Attribute) and node.attr in ("is_caffes", "exact")
    }
    assert asking == {"base.py:arithmetic", "normalization.py:joined_with"}
