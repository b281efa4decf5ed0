from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.load import load_solver
from netspec.net.weights import load_weights
from netspec.proto.schema import BlobProto, BlobShape, SolverState
from netspec.solver.snapshot import State, find_learned_net, read_state, write_state
from netspec.solver.solver import Solver
from paths import GOLDEN

pytestmark = pytest.mark.slow

STATES = sorted(path.relative_to(GOLDEN / "train") for path in GOLDEN.glob("train/*/*.solverstate"))


@pytest.mark.parametrize("path", STATES, ids=lambda path: path.parent.name)
def test_rewriting_caffes_state_gives_identical_bytes(path: Path, tmp_path: Path):
    write_state(tmp_path / "again.solverstate", read_state(GOLDEN / "train" / path))
    assert (tmp_path / "again.solverstate").read_bytes() == (GOLDEN / "train" / path).read_bytes()


def test_the_hdf5_form_has_caffes_structure(tmp_path: Path):
    theirs = GOLDEN / "snapshot/h5_iter_10.solverstate.h5"
    state = read_state(theirs)
    assert (state.iteration, state.current_step) == (10, 0)
    assert state.learned_net == "sgd_step/h5_iter_10.caffemodel.h5"
    assert [array.shape for array in state.history][:3] == [(6, 1, 5, 5), (6,), (8, 6, 5, 5)]
    write_state(tmp_path / "again.solverstate.h5", state)
    assert _contents(tmp_path / "again.solverstate.h5") == _contents(theirs)


def _contents(path: Path) -> dict[str, tuple]:
    found = {}
    with h5py.File(path) as file:
        file.visititems(
            lambda name, item: found.__setitem__(
                name, (item.shape, item.dtype, item[()].tobytes()) if isinstance(item, h5py.Dataset) else ()
            )
        )
    return found


def test_weights_are_searched_next_to_the_state_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("moved").mkdir()
    state, path = State(1, "run/x.caffemodel", 0, []), Path("moved/x.solverstate")
    with pytest.raises(SpecError, match=r"its weights are neither moved/x\.caffemodel nor run/x\.caffemodel"):
        find_learned_net(state, path)
    Path("run").mkdir()
    Path("run/x.caffemodel").touch()
    assert find_learned_net(state, path) == Path("run/x.caffemodel")
    Path("moved/x.caffemodel").touch()
    assert find_learned_net(state, path) == Path("moved/x.caffemodel")
    with pytest.raises(SpecError, match="names no weights"):
        find_learned_net(State(1, "", 0, []), path)


def test_files_without_a_state_are_refused(tmp_path: Path):
    with pytest.raises(SpecError, match=r"nowhere\.solverstate: cannot be read"):
        read_state(tmp_path / "nowhere.solverstate")
    (tmp_path / "text.solverstate").write_text("a text, not a state\n" * 10)
    with pytest.raises(SpecError, match="expected a binary SolverState"):
        read_state(tmp_path / "text.solverstate")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file.create_dataset("iter", data=[1])
    with pytest.raises(SpecError, match="the HDF5 file has no /current_step"):
        read_state(tmp_path / "other.h5")
    torn = SolverState(iter=1, history=[BlobProto(shape=BlobShape(dim=[2]), data=[1])])
    (tmp_path / "torn.solverstate").write_bytes(torn.SerializeToString())
    with pytest.raises(SpecError, match="history blob 0: found 1 numbers in data, expected 2"):
        read_state(tmp_path / "torn.solverstate")


# Caffe's own run with a snapshot at 40


def _assert_weights(solver: Solver, path: str, rounding: float) -> None:
    mine = {name: [blob.detach().clone() for blob in blobs] for name, blobs in solver.net.params.items()}
    load_weights(solver.net, path)
    for name, blobs in solver.net.params.items():
        for found, expected in zip(mine[name], blobs, strict=True):
            scale = expected.detach().abs().max().item()
            torch.testing.assert_close(found, expected.detach(), rtol=0, atol=1e-3 * scale + rounding)


def test_resume_from_caffes_state_ends_at_caffes_weights(work_in: Callable[..., Path], rounding: float):
    work_in("snapshot", "sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", snapshot="sgd_step/ref_iter_40.solverstate")
    assert solver.iteration == 40
    solver.step(20)
    _assert_weights(solver, "sgd_step/resumed_from_40_iter_60.caffemodel", rounding)
    theirs = read_state("sgd_step/resumed_from_40_iter_60.solverstate")
    for mine, expected in zip(solver.history, theirs.history, strict=True):
        atol = 1e-2 * float(np.abs(expected).max()) + rounding
        torch.testing.assert_close(mine, torch.tensor(expected), rtol=0, atol=atol)
    solver.close()


def test_a_training_with_a_snapshot_equals_caffes(work_in: Callable[..., Path], caffes_bits: bool, rounding: float):
    """Straight through to 60, with the snapshot at 40 on the way; then on from our snapshot as Caffe from its own."""
    work_in("snapshot", "sgd_step")
    state = read_state("sgd_step/ref_iter_40.solverstate")
    caffes = [Path(f"sgd_step/ref_iter_40.{kind}").rename(kind).read_bytes() for kind in ("caffemodel", "solverstate")]
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel")
    solver.step(60)
    _assert_weights(solver, "sgd_step/straight_iter_60.caffemodel", rounding)
    solver.restore("sgd_step/ref_iter_40.solverstate")
    _assert_weights(solver, "caffemodel", rounding)
    ours = read_state("sgd_step/ref_iter_40.solverstate")
    assert (ours.iteration, ours.learned_net, ours.current_step) == (40, state.learned_net, state.current_step)
    if caffes_bits:
        assert [Path(f"sgd_step/ref_iter_40.{kind}").read_bytes() for kind in ("caffemodel", "solverstate")] == caffes
    solver.step(20)
    _assert_weights(solver, "sgd_step/resumed_from_40_iter_60.caffemodel", rounding)
    solver.close()


def test_resume_from_caffes_hdf5_state(work_in: Callable[..., Path]):
    work_in("snapshot", "sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", snapshot="sgd_step/h5_iter_10.solverstate.h5")
    assert solver.iteration == 10
    with h5py.File("sgd_step/h5_iter_10.caffemodel.h5") as file:
        weights = file["data/conv2/0"]
        assert isinstance(weights, h5py.Dataset)
        np.testing.assert_array_equal(solver.net.params["conv2_p"][0].detach().numpy(), weights[()])
    np.testing.assert_array_equal(
        solver.history[2].numpy(), read_state("sgd_step/h5_iter_10.solverstate.h5").history[2]
    )
    solver.close()


def test_a_state_of_another_solver_or_net_is_refused_and_changes_nothing(work_in: Callable[..., Path]):
    work_in("train/adam")
    work_in("train/residual_bn_shared")
    work_in("snapshot", "sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel")
    before = [item.parameter.detach().clone() for item in solver.net.learnable]
    with pytest.raises(SpecError, match=r"found 16, expected 8 for this net and solver type SGD"):
        solver.restore("adam/ref_iter_60.solverstate")
    with pytest.raises(SpecError, match="incorrect length of history blobs"):
        solver.restore("residual_bn_shared/ref_iter_60.solverstate")
    state = read_state("sgd_step/ref_iter_40.solverstate")
    state.history[4] = state.history[4].T
    write_state("sgd_step/odd.solverstate", state)
    with pytest.raises(SpecError, match=r"history blob 4 has shape \(128, 32\), expected \(32, 128\)"):
        solver.restore("sgd_step/odd.solverstate")
    assert solver.iteration == 0
    for old, item in zip(before, solver.net.learnable, strict=True):
        assert torch.equal(old, item.parameter)
    solver.close()


def test_old_four_axis_history_fits(work_in: Callable[..., Path]):
    work_in("snapshot", "sgd_step")
    state = read_state("sgd_step/ref_iter_40.solverstate")
    old = [array.reshape((1,) * (4 - array.ndim) + array.shape) for array in state.history]
    write_state("sgd_step/old.solverstate", State(40, state.learned_net, state.current_step, old))
    solver = load_solver("sgd_step/solver.prototxt", snapshot="sgd_step/old.solverstate")
    np.testing.assert_array_equal(solver.history[5].numpy(), state.history[5])
    solver.close()


@pytest.mark.parametrize("copies", [True, False], ids=["copies", "parts"])
def test_histories_of_shared_parameters_are_added(
    work_in: Callable[..., Path], warnings: Callable[[], list[str]], copies: bool
):
    """Caffe of 2014-15: two towers of four layers each, so sixteen histories of eight parameters, with old shapes."""
    work_in("snapshot", "sgd_step")
    state = read_state("sgd_step/ref_iter_40.solverstate")
    assert len(state.history) == 8
    first, second = (1, 1) if copies else (0.25, 0.75)
    old = SolverState(iter=40, learned_net="sgd_step/ref_iter_40.caffemodel")
    for array in (*(first * h for h in state.history), *(second * h for h in state.history)):
        num, channels, height, width = (1,) * (4 - array.ndim) + array.shape
        blob = BlobProto(num=num, channels=channels, height=height, width=width, data=array.ravel().tolist())
        old.history.append(blob)
    Path("sgd_step/old.solverstate").write_bytes(old.SerializeToString())
    solver = load_solver("sgd_step/solver.prototxt", snapshot="sgd_step/old.solverstate")
    for mine, expected in zip(solver.history, state.history, strict=True):
        torch.testing.assert_close(mine, torch.tensor(expected))
    assert warnings() == [
        "sgd_step/old.solverstate: has a history for each layer, as before August 2015; "
        "the histories of shared parameters are added"
    ]
    old.history[9].num = 7
    old.history[9].data.extend([0] * 6 * len(old.history[9].data))
    Path("sgd_step/odd.solverstate").write_bytes(old.SerializeToString())
    with pytest.raises(SpecError, match=r"odd\.solverstate: history blob 9 has shape \(7, 1, 1, 6\), expected \(6,\)"):
        solver.restore("sgd_step/odd.solverstate")
    solver.close()
