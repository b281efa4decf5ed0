"""The log is Caffe's, line by line: what people's log parsers read."""

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from netspec import log
from netspec.solver.solver import load_solver

GOLDEN = Path(__file__).parents[2] / "golden"
SOLVER = (
    'net: "sgd_step/train_val.prototxt" test_iter: 4 test_interval: 25 test_initialization: true base_lr: 0.05\n'
    'lr_policy: "step" gamma: 0.1 stepsize: 20 momentum: 0.9 weight_decay: 0.0005 max_iter: 60 display: 10\n'
    'snapshot_prefix: "sgd_step/ref" snapshot: 40 solver_mode: CPU random_seed: 7\n'
)
PREFIX = re.compile(r"[IWE]\d{4} \d\d:\d\d:\d\d\.\d{6} +\d+ (\S+\.[ch]pp:\d+)\] (.*)")


@pytest.fixture
def lines(tmp_path: Path) -> Iterator[Callable[[], list[str]]]:
    """Return a function that returns what was logged so far, in the form of the command line."""
    path = tmp_path / "netspec.log"
    handler = logging.FileHandler(path)
    handler.setFormatter(log.GlogFormatter())
    log.logger.addHandler(handler)
    level = log.logger.level
    log.logger.setLevel(logging.INFO)
    yield lambda: path.read_text().splitlines()
    log.logger.removeHandler(handler)
    log.logger.setLevel(level)


def caffes_lines(name: str) -> list[str]:
    """Caffe's log, its newer prefix in the form of its own time."""
    text = (GOLDEN / "log" / name).read_text()
    return re.sub(r"^([IWE])\d{4}(\d{4} )", r"\1\2", text, flags=re.MULTILINE).splitlines()


def masked(lines: list[str]) -> list[str]:
    """Site and sentence, without what a clock says, nor the lines of the command line and of Caffe's data threads."""
    out = []
    for line in lines:
        match = PREFIX.fullmatch(line)
        site, text = match.groups() if match else ("", line)
        if site.startswith(("caffe.cpp", "data_layer.cpp:73")) or not line:
            continue
        out.append((site + " " + re.sub(r"\(\S+ iter/s, \S+s/10 iters\)", "(_ iter/s, _s/10 iters)", text)).strip())
    return out


def numbers_apart(line: str) -> tuple[str, list[float]]:
    """The words of a line, and the numbers of its losses, which rounding may move by one in the last place."""
    if "loss = " not in line:
        return line, []
    return re.sub(r"= [\d.e-]+", "= _", line), [float(n) for n in re.findall(r"= ([\d.e-]+)", line)]


def assert_same(ours: list[str], theirs: list[str]) -> None:
    """The solver says the same in the same order; while the nets are built the same is said."""
    assert sorted(line for line in ours if not _solvers(line)) == sorted(line for line in theirs if not _solvers(line))
    for mine, expected in zip(filter(_solvers, ours), filter(_solvers, theirs), strict=True):
        words, found = numbers_apart(mine)
        expected_words, values = numbers_apart(expected)
        assert words == expected_words
        assert found == pytest.approx(values, rel=1e-4)


def _solvers(line: str) -> bool:
    return line.startswith(("solver.cpp", "sgd_solver.cpp"))


def test_a_training_logs_what_caffes_did(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
    work_in("snapshot", "sgd_step")
    Path("solver.prototxt").write_text(SOLVER)
    solver = load_solver("solver.prototxt", weights="sgd_step/init.caffemodel", level=0, stages=("",))
    solver.solve()
    solver.close()
    assert_same(masked(lines()), masked(caffes_lines("caffe_train.log")))


def test_a_resumed_training_logs_what_caffes_did(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
    work_in("snapshot", "sgd_step")
    Path("solver.prototxt").write_text(SOLVER)
    solver = load_solver("solver.prototxt", snapshot="sgd_step/ref_iter_40.solverstate", level=0, stages=("",))
    solver.solve()
    solver.close()
    theirs = masked(caffes_lines("caffe_resume.log"))
    ours = masked(lines())
    assert "solver.cpp:239 Iteration 40 (_ iter/s, _s/10 iters), loss = 0.0523755" in theirs
    assert_same(ours, theirs)


def test_the_speed_comes_from_the_clock_and_is_0_at_first(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel")
    times = iter([100.0, 100.5, 102.5])
    solver.clock = lambda: next(times)
    solver.step(11)
    solver.close()
    paces = re.findall(r"\((\S+ iter/s, \S+ iters)\)", "\n".join(lines()))
    assert paces == ["0 iter/s, 0.5s/10 iters", "5 iter/s, 2s/10 iters"]


def test_clipping_and_multistep_say_so(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
    work_in("train/sgd_step")
    Path("solver.prototxt").write_text(
        'net: "sgd_step/train_val.prototxt" base_lr: 0.05 lr_policy: "multistep" gamma: 0.5 stepvalue: 1 max_iter: 2\n'
        "clip_gradients: 0.05 snapshot_after_train: false solver_mode: CPU\n"
    )
    solver = load_solver("solver.prototxt", weights="sgd_step/init.caffemodel")
    solver.solve()
    solver.close()
    text = "\n".join(lines())
    clipping = r"Gradient clipping: scaling down gradients \(L2 norm 0\.75\d+ > 0\.05\) by scale factor 0\.066\d+\n"
    assert re.search(r"sgd_solver.cpp:99\] " + clipping, text)
    assert "sgd_solver.cpp:50] MultiStep Status: Iteration 1, step = 1\n" in text


def test_debug_info_shows_every_blob_on_the_iterations_that_display(
    work_in: Callable[..., Path], lines: Callable[[], list[str]]
):
    work_in("train/sgd_step")
    Path("solver.prototxt").write_text(
        'net: "sgd_step/train_val.prototxt" base_lr: 0.05 lr_policy: "fixed" max_iter: 4 display: 2 debug_info: true\n'
        "solver_mode: CPU"
    )
    solver = load_solver("solver.prototxt", weights="sgd_step/init.caffemodel")
    solver.step(2)
    solver.close()
    text = "\n".join(lines())
    assert text.count("[Forward] Layer loss, top blob loss data: 0.153106") == 1
    assert text.count("[Forward] Layer conv1_p, param blob conv1_w data: ") == 1
    assert text.count("[Backward] Layer relu1, bottom blob ip1 diff: ") == 1
    assert text.count("[Backward] Layer conv1, param blob 1 diff: ") == 1
    assert "[Backward] Layer conv1, bottom" not in text
    assert re.search(
        r"\nE.*\[Backward\] All net params \(data, diff\): L1 norm = \(459\.\d+, 29\.\d+\); L2 norm = \(", text
    )
