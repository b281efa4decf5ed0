"""Changes of learned blobs and of their memory are detected."""

from collections.abc import Callable

import pytest
import torch

from netspec.layers.contract.learned import Learned, Seen


def ones_with_gradient() -> Learned:
    made = Learned(torch.ones(3))
    made.grad = torch.zeros(3)
    return made


def _write(one: Learned) -> None:
    with torch.no_grad():
        one.add_(1)


def _move(one: Learned) -> None:
    one.data = torch.ones(3)


def _give_another_gradient(one: Learned) -> None:
    one.grad = torch.zeros(3)


@pytest.mark.parametrize(
    ("change", "memory", "values"),
    [
        (lambda one: None, True, True),
        (_write, True, False),
        (lambda one: one.data, True, False),
        (lambda one: one.detach().numpy(), True, False),
        (lambda one: one[0].data.zero_(), True, False),
        (lambda one: torch.flatten(one.view(3, 1)).detach().zero_(), True, False),
        (lambda one: [each.data.zero_() for each in one], True, False),
        (lambda one: one.sum() + one.shape[0], True, True),
        (_move, False, False),
        (_give_another_gradient, False, True),
    ],
    ids=["nothing", "write", "data", "array", "view", "view_of_view", "rows", "reading", "move", "gradient"],
)
def test_changes_of_values_and_of_memory_are_detected(
    change: Callable[[Learned], object], memory: bool, values: bool
) -> None:
    one = ones_with_gradient()
    seen = {kind: Seen([one], values=kind) for kind in (False, True)}
    change(one)
    assert (seen[False].are([one]), seen[True].are([one])) == (memory, values)


def test_other_blobs_are_detected_as_a_change() -> None:
    one, other = ones_with_gradient(), ones_with_gradient()
    for values in (False, True):
        assert not Seen([one], values).are([other])
        assert not Seen([one], values).are([one, other])
        assert Seen([one, other], values).are([one, other])
