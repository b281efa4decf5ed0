"""Caffe's own trainings, iteration by iteration: all six solvers, the rate policies, shared and private BatchNorm."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from netspec.solver.snapshot import read_state
from netspec.solver.solver import Solver, load_solver

Nudge = tuple[int, str, tuple[int, ...], float]

# Where Caffe's float32 rounding decided which of two pixels a max pooling picks, the trainings part: (iteration, layer
# before the pooling, pixel that Caffe picked, what it lacks). Everything after these follows Caffe's numbers.
TIES: dict[str, list[Nudge]] = {
    "nesterov": [(26, "conv2_p", (23, 0, 7, 6), 9e-7)],
    "adagrad": [(1, "conv2", (7, 3, 6, 1), 8e-7)],
    "adadelta": [(11, "conv1", (29, 1, 7, 22), 2e-7), (40, "conv1_p", (19, 3, 6, 10), 4e-7)],
}
CASES = [
    "adadelta",
    "adagrad",
    "adam",
    "nesterov",
    "residual_bn_private",
    "residual_bn_shared",
    "rmsprop",
    "sgd_clip",
    "sgd_fixed_nomomentum",
    "sgd_inv_l1",
    "sgd_iter_size",
    "sgd_multistep",
    "sgd_step",
]
TOLERANCE = {"residual_bn_private": 1e-2, "residual_bn_shared": 1e-2}  # of the loss; rounding is amplified there
WEIGHT_TOLERANCE = {**TOLERANCE, "sgd_inv_l1": 5e-3}  # of the largest weight of a blob; sign(w) is chaotic at 0,
HISTORY_TOLERANCE = dict.fromkeys(WEIGHT_TOLERANCE, 0.1)  # and a larger part of the history than of the weights


def losses(solver: Solver) -> list[float]:
    found = []
    solver.on_iteration = lambda: found.append(solver.loss)
    solver.step(solver.param.max_iter)
    return found


def assert_follows(solver: Solver, case: str, found: list[float]) -> None:
    """The losses, the weights at the end, the history, and the losses of four test batches are Caffe's."""
    golden = np.load(f"{case}/trajectory.npz")
    tolerance, weight_tolerance = TOLERANCE.get(case, 1e-3), WEIGHT_TOLERANCE.get(case, 1e-3)
    np.testing.assert_allclose(found, golden["loss"], rtol=tolerance)
    for key in golden.files:
        if key.startswith("final/"):
            _, layer, index = key.split("/")
            weights = solver.net.params[layer][int(index)].detach()
            assert_close(weights.numpy(), golden[key], weight_tolerance, key)
    solver.test_nets[0].share_weights_with(solver.net)
    with torch.no_grad():
        tested = [solver.test_nets[0].forward_loss()[0].item() for _ in golden["test/loss"]]
    np.testing.assert_allclose(tested, golden["test/loss"], rtol=tolerance)
    state = read_state(next(Path(case).glob("ref_iter_*.solverstate")))
    assert state.iteration == solver.iteration
    assert state.current_step == solver.current_step
    for i, (mine, theirs) in enumerate(zip(solver.history, state.history, strict=True)):
        assert_close(mine.numpy(), theirs, HISTORY_TOLERANCE.get(case, 1e-2), f"history {i}")


def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float, what: str) -> None:
    """Compare to ``tolerance`` of the largest element."""
    assert np.abs(found - expected).max() <= tolerance * np.abs(expected).max(), what


def in_double_precision(solver: Solver, nudges: list[Nudge]) -> None:
    """Let the nets compute in float64, so that no rounding of ours decides a tie; decide those of Caffe's as it did."""
    solver.history = [values.double() for values in solver.history]
    for net in (solver.net, *solver.test_nets):
        net.double()
        data, run = net.layers[0], net.layers[0].run
        data.run = lambda run=run: tuple(top.double() for top in run())

    def decide(layer: Any, bottoms: Any, tops: Any) -> torch.Tensor:
        (top,) = tops
        lift = torch.zeros_like(top)
        for iteration, name, pixel, lack in nudges:
            if (iteration, name) == (solver.iteration, layer.param.name):
                lift[pixel] = lack
        return top + lift

    for layer in solver.net.layers:
        if layer.param.name in {name for _, name, _, _ in nudges}:
            layer.register_forward_hook(decide)


@pytest.mark.parametrize("case", CASES)
def test_follows_caffe(case: str, work_in: Callable[..., Path]):
    work_in(f"train/{case}")
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel")
    in_double_precision(solver, TIES.get(case, []))
    assert_follows(solver, case, losses(solver))
    solver.close()


@pytest.mark.parametrize("case", [case for case in CASES if case != "adadelta"])
def test_follows_caffe_in_single_precision(case: str, work_in: Callable[..., Path]):
    """As users train. (AdaDelta's is decided by two ties in max poolings, see TIES, that fall the other way here.)"""
    work_in(f"train/{case}")
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel")
    assert_follows(solver, case, losses(solver))
    solver.close()
