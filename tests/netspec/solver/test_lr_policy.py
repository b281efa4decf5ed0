import re

import pytest

from case_files import read_table
from netspec.errors import SpecError, Where
from netspec.proto.schema import SolverParameter
from netspec.proto.source_map import Position
from netspec.proto.text import parse_solver_text
from netspec.solver.lr_policy import learning_rate, next_step, policy_faults

NODE = Position(
    Where("s.prototxt"),
    {
        "lr_policy": (Position(Where("s.prototxt", 3, 1)),),
        "stepsize": (Position(Where("s.prototxt", 4, 1)),),
        "gamma": (Position(Where("s.prototxt", 5, 1)),),
    },
)


RATES = {row.pop("name"): row for row in read_table("netspec/solver/cases/rates.txt")}


@pytest.mark.parametrize("case", RATES.values(), ids=RATES)
def test_rates(case: dict[str, str]) -> None:
    param, node = parse_solver_text(f"net: 'n' {case['settings']}", "s.prototxt")
    assert not list(policy_faults(param, node))
    found, step = [], 0
    for i in map(int, case["iterations"].split()):
        step = next_step(param, i, step)
        found.append(learning_rate(param, i, step))
    assert found == pytest.approx([float(rate) for rate in case["rates"].split()], rel=1e-6)


def test_the_rate_is_rounded_to_float32():
    param = SolverParameter(lr_policy="fixed", base_lr=0.1)
    assert learning_rate(param, 0, 0) == pytest.approx(0.1, rel=1e-7)
    assert learning_rate(param, 0, 0) != 0.1


def test_an_infinite_rate_is_refused():
    param = SolverParameter(lr_policy="exp", base_lr=1, gamma=10)
    with pytest.raises(SpecError, match='lr_policy "exp" gives the learning rate inf at iteration 500'):
        learning_rate(param, 500, 0)


def test_poly_is_undefined_after_max_iter():
    param = SolverParameter(lr_policy="poly", base_lr=1, power=0.5, max_iter=10)
    with pytest.raises(SpecError, match=r"nan at iteration 11 \(max_iter 10\)"):
        learning_rate(param, 11, 0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lr_policy": "stp"}, r's.prototxt:3:1: unknown lr_policy "stp".*; did you mean "step"\?'),
        ({}, "s.prototxt:3:1: no lr_policy, expected one of fixed, step, exp, inv, multistep, poly, sigmoid"),
        ({"lr_policy": "step", "gamma": 0.1}, 's.prototxt:3:1: lr_policy "step" needs stepsize, found none'),
        ({"lr_policy": "step", "stepsize": 10}, 's.prototxt:3:1: lr_policy "step" needs gamma, found none'),
        ({"lr_policy": "step", "gamma": 0.1, "stepsize": 0}, "s.prototxt:4:1: .* stepsize of more than 0, found 0"),
        ({"lr_policy": "inv", "gamma": -1}, "s.prototxt:5:1: .* gamma of at least 0, found -1"),
        ({"lr_policy": "poly"}, "needs max_iter, found none"),
        ({"lr_policy": "sigmoid", "gamma": 1}, "needs stepsize, found none"),
        ({"lr_policy": "multifixed"}, "needs as many stagelr as stageiter, found 0 and 0"),
    ],
)
def test_invalid_policies_are_refused_before_the_first_iteration(fields: dict, message: str):
    (fault,) = policy_faults(SolverParameter(**fields), NODE)
    assert re.search(message, str(fault))


def test_a_gamma_of_0_is_accepted():
    assert not list(policy_faults(SolverParameter(lr_policy="step", gamma=0, stepsize=1), NODE))
