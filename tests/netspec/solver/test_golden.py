"""Caffe's own trainings, iteration by iteration: all six solvers, the rate policies, shared and private BatchNorm."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from golden_cases import STEPS, assert_arrays, assert_same_layers, assert_training, parameters, promised, train
from netspec.exact import CHOICES
from netspec.load import load_solver
from netspec.proto.text import parse_solver
from netspec.solver.lr_policy import learning_rate
from netspec.solver.snapshot import read_state
from paths import GOLDEN

pytestmark = pytest.mark.slow

DRIFT = {"adadelta": 0.25, "rmsprop": 0.25}
CASES = sorted(folder.name for folder in (GOLDEN / "train").iterdir())


@pytest.mark.parametrize(("case", "exact"), [(case, promised(GOLDEN / "train" / case)[0]) for case in CASES])
def test_training_follows_caffe(case: str, exact: str, work_in: Callable[..., Path], caffes_bits: bool) -> None:
    """Its losses, weights, history and test losses, to the last bit.

    On other CPUs than Caffe's to 1e-2; to a quarter where ties in max poolings decide, which fall as the CPU rounds.
    """
    drift = DRIFT.get(case, 1e-2)
    work_in(f"train/{case}")
    golden = np.load(f"{case}/trajectory.npz")
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel", exact=exact)
    found = train(solver, solver.param.max_iter)
    solver.test_nets[0].share_weights_with(solver.net)
    with torch.no_grad():
        tested = [solver.test_nets[0].forward_loss()[0].item() for _ in golden["test/loss"]]
    solver.close()

    losses = {"loss": found, "test/loss": tested}
    if solver.param.iter_size > 1:  # the file has the mean of several passes, which Caffe did not take
        assert_training({"loss": losses.pop("loss")}, golden, False, drift)
    assert_training({**losses, **parameters(solver.net, golden, "final/")}, golden, caffes_bits, drift)
    state = read_state(next(Path(case).glob("ref_iter_*.solverstate")))
    assert state.iteration == solver.iteration
    assert state.current_step == solver.current_step
    kept = {f"final/history/{i}": np.asarray(values) for i, values in enumerate(state.history)}
    mine = {f"final/history/{i}": values.numpy() for i, values in enumerate(solver.history)}
    assert mine.keys() == kept.keys()
    assert_training(mine, kept, caffes_bits, 2 * drift)


@pytest.mark.parametrize("case", CASES)
def test_training_starts_like_caffe_on_every_cpu(case: str, work_in: Callable[..., Path]) -> None:
    """The weights after five iterations, to 1e-4.

    ``after_5.npz`` is of this project, from runs whose every loss and last weight were Caffe's, bit for bit.
    """
    work_in(f"train/{case}")
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel")
    solver.step(5)
    solver.close()
    expected = np.load(f"{case}/after_5.npz")
    assert_same_layers(parameters(solver.net, expected, ""), expected, 1e-4)


@pytest.mark.parametrize("case", STEPS)
@pytest.mark.parametrize("choice", CHOICES)
def test_each_step_equals_caffes(
    case: str, choice: str, work_in: Callable[..., Path], caffes_bits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Outputs and weights after each of three iterations to 1e-3; ``all`` to the last bit on a CPU as Caffe's."""
    monkeypatch.chdir(work_in(f"steps/{case}"))
    golden = np.load("caffe.npz")
    found = {}
    solver = load_solver("solver.prototxt", weights="init.caffemodel", exact=choice)
    for i in range(3):
        solver.step(1)
        for name in solver.net.outputs:
            found[f"{i} output {name}"] = solver.net.blobs[name].detach().numpy().copy()
        for layer, blobs in solver.net.params.items():
            for j, blob in enumerate(blobs):
                found[f"{i} weight {layer}[{j}]"] = blob.detach().numpy().copy()
    solver.close()
    assert found.keys() == set(golden.files)
    assert_arrays(found, golden, 0 if caffes_bits and choice == "all" else 1e-3)


def test_the_rates_of_sigmoid_are_bit_identical_to_caffes(
    work_in: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gradient of the bias is 0.6 in each iteration, whatever the CPU: its steps show the rate."""
    monkeypatch.chdir(work_in("steps/sigmoid"))
    param, _ = parse_solver(Path("solver.prototxt"))
    golden = np.load("caffe.npz")
    biases = [golden[f"{i} weight l4[1]"][0] for i in range(3)]
    gradient = np.float32(2) * np.float32(3) * np.float32(0.1)
    for i in (1, 2):
        assert biases[i - 1] - np.float32(learning_rate(param, i, 0)) * gradient == biases[i]
