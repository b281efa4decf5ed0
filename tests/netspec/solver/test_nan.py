"""A loss of NaN or infinity stops a training, and says where it came from."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.mean import write_mean
from netspec.cli import main
from netspec.data.mean import read_mean, read_mean_option
from netspec.errors import SpecError
from netspec.load import load_solver

NET = """
layer { name: "data" type: "DummyData" top: "data" top: "label" dummy_data_param {
  shape { dim: 4 dim: 3 } shape { dim: 4 dim: 2 } data_filler { type: "gaussian" } data_filler { type: "gaussian" } } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip"
  inner_product_param { num_output: 2 weight_filler { type: "xavier" } } }
%s
layer { name: "loss" type: "EuclideanLoss" bottom: "%s" bottom: "label" top: "loss" }
"""
LOG = 'layer { name: "log" type: "Log" bottom: "ip" top: "log" }'  # of negative numbers: NaN
SOLVER = (
    'net: "net.prototxt" base_lr: %g lr_policy: "fixed" max_iter: 60 snapshot: 1 snapshot_prefix: "x" random_seed: 1'
)


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    monkeypatch.chdir(tmp_path)

    def to_files(rate: float, layer: str = "", bottom: str = "ip") -> None:
        Path("net.prototxt").write_text(NET % (layer, bottom))
        Path("solver.prototxt").write_text(SOLVER % rate)

    return to_files


def test_a_training_that_diverges_keeps_its_last_good_snapshot(
    write: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    write(1e9)
    assert main(["train", "solver.prototxt"]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    states = sorted(Path().glob("*.solverstate"), key=lambda path: int(path.stem.rpartition("_")[2]))
    assert line.startswith("solver.prototxt: Iteration ")
    assert f"; the last good snapshot is {states[-1]}; lower base_lr, or continue with --nan warn" in line
    solver = load_solver("solver.prototxt", snapshot=states[-1])
    assert all(item.parameter.isfinite().all() for item in solver.net.learnable)


def test_the_first_bad_blob_is_named(write: Callable[..., None]) -> None:
    write(0.1, LOG, "log")
    message = r'Iteration 0: the loss is nan; the first NaN or infinity is in top "log" of layer "log"; lower base_lr'
    with pytest.raises(SpecError, match=message):
        load_solver("solver.prototxt").solve()
    assert not list(Path().glob("x_iter*"))


def test_the_first_bad_parameter_is_named(write: Callable[..., None]) -> None:
    write(0.1)
    solver = load_solver("solver.prototxt")
    solver.net.learnable[1].parameter.data[1] = float("inf")
    with pytest.raises(SpecError, match=r'the first NaN or infinity is in blob 1 of layer "ip"'):
        solver.step(1)
    with pytest.raises(SpecError, match=r"Iteration 0: the weights cannot be saved; the first .* is in blob 1"):
        solver.snapshot()


@pytest.mark.slow
def test_a_training_with_nan_continues_on_request(
    write: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    write(0.1, LOG, "log")
    assert main(["train", "solver.prototxt", "--nan", "warn"]) == 0
    said = capsys.readouterr().err
    assert said.count("the training continues") == 1
    assert "Optimization Done." in said


def test_a_mean_with_nan_is_refused(tmp_path: Path) -> None:
    mean = np.zeros((3, 2, 2), np.float32)
    mean[1, 1, 1] = np.nan
    write_mean(str(tmp_path / "m.binaryproto"), mean)
    np.save(tmp_path / "m.npy", mean)
    with pytest.raises(SpecError, match="contains a NaN or an infinity"):
        read_mean(str(tmp_path / "m.binaryproto"))
    with pytest.raises(SpecError, match="contains a NaN or an infinity"):
        read_mean_option(str(tmp_path / "m.npy"))
