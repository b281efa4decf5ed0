"""The chain that compares nets: train, choose a snapshot, take the distances of the pairs, print the table."""

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from netspec.check.training_log import read_test_scores
from netspec.errors import SpecError
from paths import GOLDEN, ROOT


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    (tmp_path / "sgd_step").mkdir()
    for name in ("solver.prototxt", "train_val.prototxt", "init.caffemodel"):
        (tmp_path / "sgd_step" / name).write_bytes((GOLDEN / "snapshot" / name).read_bytes())
    return tmp_path


def compare(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "tools" / "compare.py"), "sgd_step/solver.prototxt", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)


def test_it_trains_chooses_the_snapshot_that_validates_best_and_judges_it(folder: Path) -> None:
    solver = folder / "sgd_step" / "solver.prototxt"
    text = solver.read_text().replace("snapshot: 40", "snapshot: 5").replace("test_interval: 25", "test_interval: 5")
    solver.write_text(text.replace("max_iter: 60", "max_iter: 10") + '\nweights: "sgd_step/init.caffemodel"\n')
    older = (GOLDEN / "snapshot" / "straight_iter_60.caffemodel").read_bytes()
    (folder / "sgd_step" / "ref_iter_60.caffemodel").write_bytes(older)  # better, but another training's
    done = compare(folder, "--out", "out")
    assert done.returncode == 0, done.stderr
    scores = dict(read_test_scores(folder / "out" / "sgd_step.log", "loss"))
    assert sorted(scores) == [0, 5, 10]
    with (folder / "out" / "table.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["net"] == "sgd_step"
    assert int(row["iteration"]) == min((5, 10), key=scores.__getitem__)
    assert float(row["ROC AUC"]) > 0.8  # Caffe's own weights tell the made-up places apart
    # conv1 6x1x5x5 + 6, conv2 8x6x5x5 + 8, ip1 32x128 + 32, feat 8x32 + 8
    assert int(row["parameters"]) == 156 + 1208 + 4128 + 264
    assert "sgd_step" in done.stdout
    assert "The paper's Table I" in done.stdout
    assert (folder / "out" / "losses.png").stat().st_size > 1000
    assert (folder / "out" / "distances.png").stat().st_size > 1000


def test_without_training_it_scores_the_snapshots_that_there_are(folder: Path) -> None:
    for iteration, name in ((40, "ref_iter_40"), (60, "straight_iter_60")):
        model = (GOLDEN / "snapshot" / f"{name}.caffemodel").read_bytes()
        (folder / "sgd_step" / f"ref_iter_{iteration}.caffemodel").write_bytes(model)
    done = compare(folder, "--no-train")
    assert done.returncode == 0, done.stderr
    with (folder / "out" / "compare" / "table.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["iteration"] in ("40", "60")


def test_without_snapshots_it_says_so_in_one_line(folder: Path) -> None:
    done = compare(folder, "--no-train")
    assert done.returncode == 1
    assert done.stderr == "sgd_step/ref: no snapshot of this net; train it first (without --no-train)\n"


def test_a_log_that_is_not_there() -> None:
    with pytest.raises(SpecError, match=r"^nowhere\.log: cannot be read"):
        read_test_scores("nowhere.log", "loss")
