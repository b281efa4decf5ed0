"""The chain that compares nets: train, choose a snapshot, take the distances of the pairs, print the table."""

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import forked
from lmdb_build.cli import main
from lmdb_build.compare import best_snapshot, read_entry
from netspec.cli.scores import read_scores
from netspec.errors import SpecError
from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

SOLVER = "sgd_step/solver.prototxt"
OLDER = (GOLDEN / "snapshot" / "straight_iter_60.caffemodel").read_bytes()


class Forked:
    """A command of netspec, as subprocess.Popen starts it; it has the imports already, and runs to its end at once."""

    def __init__(self, command: list[str], **_: object) -> None:
        done = forked.run(forked.program, ["netspec", *command[3:]], folder=Path.cwd())
        self.stderr, self.returncode = io.StringIO(done.stderr), done.returncode

    def __enter__(self) -> "Forked":
        return self

    def __exit__(self, *_: object) -> None: ...


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lmdb_build.compare.subprocess", SimpleNamespace(Popen=Forked, PIPE=subprocess.PIPE))
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    (tmp_path / "sgd_step").mkdir()
    for name in ("solver.prototxt", "train_val.prototxt", "init.caffemodel"):
        (tmp_path / "sgd_step" / name).write_bytes((GOLDEN / "snapshot" / name).read_bytes())
    return tmp_path


@pytest.fixture
def edited(folder: Path) -> Callable[..., None]:
    """``edited(old, new, ...)``: replaces texts in the solver."""

    def edit(*changes: str) -> None:
        text = Path(SOLVER).read_text()
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        Path(SOLVER).write_text(text)

    edit("max_iter: 60", 'max_iter: 10 weights: "sgd_step/init.caffemodel"', "snapshot: 40", "snapshot: 5")
    edit("test_interval: 25", "test_interval: 5")
    return edit


def row(out: str) -> dict[str, str]:
    with (Path(out) / "table.csv").open() as file:
        (found,) = csv.DictReader(file)
    return found


def test_compare_trains_and_evaluates_the_best_validated_snapshot(
    edited: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    # better snapshots, but another training's; a path that begins with ./ is spelled in two ways
    edited('"sgd_step/ref"', '"./sgd_step/ref"')
    for iteration in (5, 60):
        Path(f"sgd_step/ref_iter_{iteration}.caffemodel").write_bytes(OLDER)
    assert main(["compare", SOLVER, "--out", "out"]) == 0
    said = capfd.readouterr()
    scores = {score.iteration: score.outputs["loss"][0] for score in read_scores("out/sgd_step.scores.json").tests}
    assert set(scores) == {0, 5, 10}
    assert row("out")["net"] == "sgd_step"
    assert int(row("out")["iteration"]) == min((5, 10), key=scores.__getitem__)
    assert float(row("out")["ROC AUC"]) > 0.8  # Caffe's own weights tell the synthetic places apart
    # conv1 6x1x5x5 + 6, conv2 8x6x5x5 + 8, ip1 32x128 + 32, feat 8x32 + 8
    assert int(row("out")["parameters"]) == 156 + 1208 + 4128 + 264
    assert "sgd_step" in said.out
    assert "The paper's Table I" in said.out
    assert "Iteration 5, Testing net (#0)" in said.err
    assert "Creating Layer" not in said.err
    assert "Creating Layer" in Path("out/sgd_step.log").read_text()
    assert Path("out/losses.png").stat().st_size > 1000
    assert Path("out/distances.png").stat().st_size > 1000

    before = row("out")
    assert main(["compare", SOLVER, "--out", "out", "--no-train"]) == 0
    assert row("out")["iteration"] == before["iteration"]
    assert main(["compare", SOLVER, "--out", "out", "--no-train", "--snapshot", "last"]) == 0
    assert row("out")["iteration"] == "10"
    for path in Path("sgd_step").glob("ref_iter_*"):
        path.unlink()
    assert main(["compare", SOLVER, "--out", "out", "--no-train"]) == 1


def test_solvers_of_one_net_are_its_seeds(edited: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> None:
    second = Path(SOLVER).read_text().replace("sgd_step/ref", "sgd_step/second").replace("max_iter: 10", "max_iter: 5")
    second = second.replace("random_seed: 7", "random_seed: 8")
    Path("sgd_step/second.prototxt").write_text(second)
    found = []
    for solvers in ([SOLVER], ["sgd_step/second.prototxt"], [SOLVER, "sgd_step/second.prototxt"]):
        assert main(["compare", *solvers, "--snapshot", "last", "--out", "out"]) == 0
        found.append(row("out"))
    for column in ("precision", "ROC AUC"):
        first, other, both = (float(each[column]) for each in found)
        assert both == pytest.approx((first + other) / 2, abs=1.1e-3)
    assert found[2]["iteration"] == "10, 5"
    assert re.search(r"sgd_step: precision [\d.]+ \([\d.]+ to [\d.]+\), recall", capfd.readouterr().out)


def test_a_snapshot_without_a_test_is_tested(edited: Callable[..., None]) -> None:
    edited("snapshot: 5", "snapshot: 4", "max_iter: 10", "max_iter: 5")
    assert main(["compare", SOLVER, "--out", "out"]) == 0
    (run,) = json.loads(Path("out/runs.json").read_text())
    assert [iteration for iteration, _ in run["losses"]] == [0, 4, 5]
    (score,) = read_scores("out/sgd_step.4.scores.json").tests
    assert run["losses"][1] == [4, score.outputs["loss"][0]]
    assert run["iteration"] in (4, 5)


def test_test_pairs_have_their_own_table(edited: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> None:
    pairs = re.findall(r'source: "(.*?)"', Path("sgd_step/train_val.prototxt").read_text())
    assert main(["compare", SOLVER, "--out", "out", "--test", pairs[-1]]) == 0
    validation, test = capfd.readouterr().out.split("\n\nnet ")
    assert re.search(r"Judged on \d+ validation pairs", validation)
    assert re.search(r"Judged on \d+ test pairs", test)
    row_of = {part.split()[0]: part.split()[1:6] for part in (*validation.splitlines(), *test.splitlines()) if part}
    assert row_of["sgd_step"] == validation.splitlines()[1].split()[1:6]  # the same pairs: the same metrics
    assert main(["compare", SOLVER, "--out", "out", "--no-train", "--test", pairs[-1], "--test", pairs[-1]]) == 1
    assert "databases of test pairs: 2 for a net with 1 data layers" in capfd.readouterr().err


def test_a_training_resumes(edited: Callable[..., None]) -> None:
    assert main(["compare", SOLVER, "--out", "out"]) == 0
    before = row("out")
    for path in Path("sgd_step").glob("ref_iter_10*"):
        path.unlink()
    assert main(["compare", SOLVER, "--out", "out", "--resume"]) == 0
    assert "Resuming from" in Path("out/sgd_step.log").read_text()
    assert {**row("out"), "ms/image": ""} == {**before, "ms/image": ""}


def test_the_best_snapshot() -> None:
    assert best_snapshot([5, 10, 15], {0: 0.1, 5: 0.3, 10: 0.2, 15: 0.2}) == 10
    assert best_snapshot([5, 10], {5: float("nan"), 10: 3.0}) == 10
    assert best_snapshot([5, 10], {5: float("nan"), 10: float("nan")}) == 5


def fault(capfd: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["compare", SOLVER, *words]) == 1
    err = capfd.readouterr().err
    assert "Traceback" not in err
    return err.splitlines()[-1]


def test_errors_are_one_line(folder: Path, edited: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> None:
    absent = "sgd_step/ref: no snapshot of this net; train it first (without --no-train)"
    assert fault(capfd, "--no-train") == absent
    twice = 'found a second training with snapshot_prefix "sgd_step/ref"; give each training its own'
    assert fault(capfd, SOLVER) == f"{SOLVER}: {twice}"
    second = Path(SOLVER).read_text().replace("sgd_step/ref", "sgd_step/second").replace("train_val", "other")
    Path("sgd_step/second.prototxt").write_text(second)
    shutil.copy("sgd_step/train_val.prototxt", "sgd_step/other.prototxt")
    twice = 'sgd_step/other.prototxt: found a second net named "sgd_step"; give each net its own name'
    assert fault(capfd, "sgd_step/second.prototxt") == twice
    edited("base_lr", "base_rl")
    assert 'SolverParameter has no field "base_rl"' in fault(capfd)


def test_a_failed_command_ends_compare_with_its_message(
    edited: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    edited("sgd_step/init.caffemodel", "nowhere.caffemodel")
    assert fault(capfd).startswith("nowhere.caffemodel: cannot be read: No such file or directory; ")
    edited('weights: "nowhere.caffemodel"', "snapshot_after_train: false", "snapshot: 5", "")
    assert fault(capfd).startswith(f"{SOLVER}: none of the snapshots of its training was found")


def test_a_net_that_is_not_siamese_is_refused(folder: Path) -> None:
    net = Path("sgd_step/train_val.prototxt")
    text = net.read_text()
    net.write_text(text.replace('"ContrastiveLoss"', '"EuclideanLoss"'))
    with pytest.raises(SpecError, match="no ContrastiveLoss layer: expected a Siamese net"):
        read_entry(SOLVER)
    net.write_text(text.replace('top: "loss"', ""))
    with pytest.raises(SpecError, match='its ContrastiveLoss "loss" has no top'):
        read_entry(SOLVER)


def test_training_pairs_are_refused_for_validation(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    net = Path("sgd_step/train_val.prototxt")
    text = net.read_text()
    train, test = re.findall(r'source: "(.*?)"', text)
    line = text[: text.rindex("source:")].count("\n") + 1
    for same in (train, f"./{train}/"):
        net.write_text(text.replace(f'"{test}"', f'"{same}"'))
        for words in ([], ["--no-train"]):
            said = fault(capfd, *words)
            assert said.startswith(f"{net}:{line}:")
            assert f'phase TEST reads "{same}", which the net is trained on' in said
    first, second, rest = text.split('name: "pair_data"\n')
    both = second.replace("include { phase: TRAIN }", "").rpartition("layer {")[0]
    net.write_text(f'{first}name: "pair_data"\n{both}{rest[rest.index("layer {") :]}')
    assert f'phase TEST reads "{train}"' in fault(capfd)
    assert "NetState" not in capfd.readouterr().err


def test_an_interrupted_training_ends_with_a_snapshot(edited: Callable[..., None]) -> None:
    edited("max_iter: 10", "max_iter: 1000000", "snapshot: 5", "")
    command = [sys.executable, "-m", "lmdb_build", "compare", SOLVER, "--out", "out"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    ) as process:
        assert process.stderr is not None
        end = time.monotonic() + 300
        while "Iteration 5," not in process.stderr.readline():
            assert time.monotonic() < end
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        said = process.stderr.read()
    assert process.returncode == 130
    assert said.splitlines()[-1] == "interrupted"
    assert "Traceback" not in said
    (snapshot,) = read_scores("out/sgd_step.scores.json").snapshots
    assert Path(snapshot.path).is_file()
