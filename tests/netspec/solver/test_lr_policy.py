import re

import pytest

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


@pytest.mark.parametrize(
    ("text", "iterations", "expected"),
    [
        pytest.param("lr_policy: 'fixed' base_lr: 0.5", [0, 9], [0.5, 0.5], id="fixed"),
        pytest.param(
            "lr_policy: 'step' base_lr: 0.5 gamma: 0.5 stepsize: 10",
            [0, 9, 10, 19, 20],
            [0.5, 0.5, 0.25, 0.25, 0.125],
            id="step",
        ),
        pytest.param("lr_policy: 'exp' base_lr: 2 gamma: 0.5", [0, 1, 3], [2, 1, 0.25], id="exp"),
        pytest.param("lr_policy: 'inv' base_lr: 1 gamma: 1 power: 0.5", [0, 3, 8], [1, 0.5, 0.33333333], id="inv"),
        pytest.param(
            "lr_policy: 'inv' base_lr: 0.01 gamma: 0.0001 power: 0.75", [5000], [0.00737788], id="inv of a small gamma"
        ),
        pytest.param("lr_policy: 'poly' base_lr: 1 power: 2 max_iter: 10", [0, 5, 10], [1, 0.25, 0], id="poly"),
        pytest.param(
            "lr_policy: 'sigmoid' base_lr: 1 gamma: 0.5 stepsize: 10",
            [6, 10, 14],
            [0.11920292, 0.5, 0.88079708],
            id="sigmoid",
        ),
        pytest.param(
            "lr_policy: 'multistep' base_lr: 1 gamma: 0.5 stepvalue: [2, 4]",
            [0, 1, 2, 3, 4, 5],
            [1, 1, 0.5, 0.5, 0.25, 0.25],
            id="multistep",
        ),
        pytest.param(
            "lr_policy: 'multistep' base_lr: 1 gamma: 0.5 stepvalue: [2, 4, 5]",
            [10, 11, 12, 13],
            [0.5, 0.25, 0.125, 0.125],
            id="multistep goes up at most once an iteration, as Caffe's when resumed with its step lost",
        ),
        pytest.param(
            "lr_policy: 'fixed' base_lr: 1 warmup_iter: 4 warmup_start_lr: 0.5",
            [0, 1, 4, 9],
            [0.5, 0.625, 1, 1],
            id="Intel's warm-up",
        ),
        pytest.param(
            "lr_policy: 'poly' power: 1 max_iter: 8 base_lr: 2 rampup_interval: 4 rampup_lr: 1",
            [0, 2, 4],
            [1, 1.25, 1],
            id="NVIDIA's ramp",
        ),
        pytest.param(
            "lr_policy: 'poly' power: 1 max_iter: 4 base_lr: 1 min_lr: 0.5",
            [0, 2, 4],
            [1, 0.75, 0.5],
            id="NVIDIA's poly with a least rate",
        ),
        pytest.param(
            "lr_policy: 'exp' gamma: 0.5 base_lr: 1 min_lr: 0.25", [0, 1, 5], [1, 0.5, 0.25], id="a least rate"
        ),
        pytest.param(
            "lr_policy: 'multifixed' stagelr: 1 stagelr: 4 stageiter: 2 stageiter: 5",
            [0, 2, 3, 5, 9],
            [1, 1, 4, 4, 4],
            id="multifixed, Intel's and eric612's",
        ),
    ],
)
def test_rates(text: str, iterations: list[int], expected: list[float]):
    """The iterations are run through in order."""
    param, node = parse_solver_text(f"net: 'n' {text}", "s.prototxt")
    assert not list(policy_faults(param, node))
    found, step = [], 0
    for i in iterations:
        step = next_step(param, i, step)
        found.append(learning_rate(param, i, step))
    assert found == pytest.approx(expected, rel=1e-6)


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
