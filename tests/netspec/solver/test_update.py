import math
import re

import pytest
import torch

from netspec.errors import Where
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Position
from netspec.solver import update
from netspec.solver.update import RULES, Piece, Tensors, cut, move, rule_faults

NOWHERE = Position(Where("s.prototxt"))
SHAPES = [(3, 2), (4,)]


def run(
    param, gradients: list[list[torch.Tensor]], rates: list[float]
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Start from zero weights; return the weights and the history after one update for each rate."""
    rule = RULES[param.type]
    weights = [torch.zeros(shape) for shape in SHAPES]
    history = [torch.zeros(shape) for shape in SHAPES * rule.sets]
    for iteration, (diffs, rate) in enumerate(zip(gradients, rates, strict=True)):
        diffs = [d.clone() for d in diffs]
        rule.compute(param, diffs, [rate, 2 * rate], history, iteration)
        for w, d in zip(weights, diffs, strict=True):
            w -= d
    return weights, history


@pytest.fixture
def gradients() -> list[Tensors]:
    generator = torch.Generator().manual_seed(1)
    return [[torch.randn(shape, generator=generator) for shape in SHAPES] for _ in range(6)]


def test_adam_adds_delta_before_the_bias_correction():
    ones = [[torch.ones(shape) for shape in SHAPES]]
    weights, _ = run(SolverParameter(type="Adam", momentum=0.9, momentum2=0.99, delta=0.1), ones, [1.0])
    expected = math.sqrt(1 - 0.99) / (1 - 0.9) * 0.1 / (math.sqrt(0.01) + 0.1)
    assert weights[0][0, 0].item() == pytest.approx(-expected, rel=1e-5)


@pytest.mark.parametrize("momenta", [(1, 0.999), (0.9, 1.5), (2, 1.5)], ids=str)
def test_adam_with_momenta_of_1_or_more_gives_what_ieee_gives(momenta: tuple[float, float]):
    ones = [[torch.ones(shape) for shape in SHAPES]]
    weights, _ = run(SolverParameter(type="Adam", momentum=momenta[0], momentum2=momenta[1]), ones, [1.0])
    assert not weights[0].isfinite().any()


def test_a_rate_of_0_updates_only_the_history(gradients):
    param = SolverParameter(momentum=0.9)
    history = [torch.ones(shape) for shape in SHAPES]
    diffs = [torch.zeros(shape) for shape in SHAPES]
    RULES["SGD"].compute(param, diffs, [0.0, 0.0], history, 0)
    assert torch.all(history[0] == torch.tensor(0.9))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"type": "Adan"}, 'unknown solver type "Adan", expected one of SGD, .*; did you mean "Adam"'),
        ({"type": "adam"}, 'unknown solver type "adam", expected one of SGD, .*; did you mean "Adam"'),
        ({"type": "RMSPROP"}, 'unknown solver type "RMSPROP", expected one of SGD, .*; did you mean "RMSProp"'),
        ({"type": "AdaGrad", "momentum": 0.9}, "momentum cannot be used with AdaGrad"),
        ({"type": "RMSProp", "momentum": 0.9}, "momentum cannot be used with RMSProp"),
        ({"type": "RMSProp", "rms_decay": 1}, "rms_decay 1, expected at least 0 and less than 1"),
    ],
)
def test_settings_that_caffe_refuses_are_refused(fields: dict, message: str):
    (fault,) = rule_faults(SolverParameter(**fields), NOWHERE)
    assert re.search(message, str(fault))


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("size", [1, 3, 5, 7])
def test_an_update_in_blocks_equals_a_whole_update(name, size, gradients, monkeypatch):
    """Bit for bit, however tensors are cut or lie together in a block."""
    param = SolverParameter(type=name, momentum=0.9 if RULES[name].momentum else 0, iter_size=3, rms_decay=0.9)

    def moved() -> list[list[torch.Tensor]]:
        weights = [torch.linspace(-1, 1, math.prod(shape)).view(shape) for shape in SHAPES]
        history = [torch.zeros(shape) for shape in SHAPES * RULES[name].sets]
        for iteration, diffs in enumerate(gradients):
            diffs = [diff.clone() for diff in diffs]
            for piece in cut(Piece(weights, diffs, history, [0.1, 0.2], [0.01, 0])):
                move(RULES[name], param, piece, iteration)
        return [weights, history, diffs]

    whole = moved()
    monkeypatch.setattr(update, "BLOCK", size)
    for mine, theirs in zip(moved(), whole, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))
