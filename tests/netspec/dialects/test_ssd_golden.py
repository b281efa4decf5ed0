"""Results of SSD's own branch (weiliu89/caffe, ssd, built for CPUs): layers, data, trainings, average precision.

Where the branch differs from its formulas, the layers do as it does: the gradient of Normalize leaves the scales out of
a sum (normalize_*_per_channel, training/norm_per_channel), labels of a logistic loss without mining are those of other
priors (multibox_logistic_none), and equal scores come in the order of std::sort
(test_equal_scores_come_in_the_order_of_std_sort).
"""

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

import netspec
from golden_cases import LayerCase, assert_same_layers, parameters, train
from netspec.cli import main
from netspec.dialects.boxes import highest
from netspec.load import load_net
from paths import GOLDEN

SSD = GOLDEN / "ssd"
CASES = sorted((SSD / "layers").iterdir())
DATA = sorted((SSD / "training" / "data").iterdir())
TRAININGS = ["corner_no_mining", "norm_per_channel"]


def _assert_close(found: np.ndarray, expected: np.ndarray, name: str, tolerance: float = 1e-5) -> None:
    assert found.shape == expected.shape, name
    scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
    assert float(np.abs(found - expected).max(initial=0)) <= tolerance * scale, name


@pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)
def test_layer_equals_the_results_of_ssds_branch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SSD)  # name_size.txt
    case = LayerCase(folder)
    found = case.compute()
    assert [key for key in found if key.startswith("out/")] == sorted(k for k in case.golden if k.startswith("out/"))
    for key, value in found.items():
        _assert_close(value, case.golden[key], key)


@pytest.mark.parametrize("folder", DATA, ids=lambda path: path.name)
def test_images_and_boxes_equal_those_of_ssds_branch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SSD / "training")
    golden = np.load(folder / "golden.npz")
    net = load_net(folder / "net.prototxt")
    for i in range(sum(key.startswith("out/label") for key in golden)):
        outputs = net()
        if i == 0 and "out/data" in golden:
            _assert_close(outputs["data"].numpy(), golden["out/data"], "data", 1e-5)
        _assert_close(outputs["label"].numpy(), golden[f"out/label/{i}"], f"label/{i}", 1e-5)
    net.close()


@pytest.mark.slow
@pytest.mark.parametrize("variant", TRAININGS)
def test_training_follows_ssds_branch(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _lay_out(variant, tmp_path)
    monkeypatch.chdir(tmp_path)
    golden = np.load(SSD / "training" / variant / "trajectory.npz")
    solver = netspec.load_solver(f"{variant}/solver.prototxt", weights=f"{variant}/init.caffemodel")
    losses = np.array(train(solver, 30))
    np.testing.assert_allclose(losses, golden["loss"], rtol=2e-5)
    assert_same_layers(parameters(solver.net, golden, "final/"), golden, 2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["11point", "Integral", "MaxIntegral"])
@pytest.mark.parametrize("variant", TRAININGS)
def test_mean_average_precision_is_logged_as_by_ssds_branch(
    variant: str, version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _lay_out(variant, tmp_path)
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.INFO):
        solver = netspec.load_solver(f"{variant}/eval_{version}.prototxt", weights=f"{variant}/longer.caffemodel")
        solver.solve()
    said = [record.getMessage().strip() for record in caplog.records]
    for line in (SSD / "training" / variant / f"eval_{version}.log").read_text().splitlines():
        assert line.strip() in said


@pytest.mark.slow
def test_commands_report_the_mean_average_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _lay_out("corner_no_mining", tmp_path)
    monkeypatch.chdir(tmp_path)
    weights = ["--weights", "corner_no_mining/longer.caffemodel", "--plugin", "ssd"]
    solver = "corner_no_mining/eval_Integral.prototxt"
    assert main(["train", "--solver", solver, *weights, "--scores", "scores.json"]) == 0
    (test,) = json.loads(Path("scores.json").read_text())["tests"]
    assert main(["test", "--model", "corner_no_mining/test.prototxt", *weights, "--iterations", "5"]) == 0
    said = capsys.readouterr().err
    assert f"caffe.cpp:321] detection_eval = {test['outputs']['detection_eval'][0]:.6g}\n" in said
    assert "Batch 0, detection_eval" not in said
    assert "has no effect" not in said


def test_equal_scores_come_in_the_order_of_std_sort() -> None:
    scores = "4 2 4 1 0 0 2 0 0 1 3 2 5 3 3 2 1 2 5 5 3 4 3 0 5 0 4 0 0 5 4 1 4 3 2 0 1 5 5 2"
    by_gcc_12 = "38 37 19 18 29 12 24 0 2 32 30 21 26 20 22 14 13 10 33 34 39 17 1 15 11 6 16 3 36 31 9 "
    by_gcc_12 += "8 7 28 5 35 27 4 25 23"
    values, order = np.array(scores.split(), np.float32), [int(index) for index in by_gcc_12.split()]
    assert highest(values, len(values)).tolist() == order
    assert highest(values, 3).tolist() == order[:3]


def test_scores_of_nan_are_sorted_without_an_error() -> None:
    assert len(highest(np.array([np.nan] * 20 + [1.0] * 20, np.float32), 40)) == 40


def _lay_out(variant: str, folder: Path) -> None:
    """Copy the files of a training to where its relative paths expect them."""
    for name in ("boxes_lmdb", variant):
        shutil.copytree(SSD / "training" / name, folder / name)
