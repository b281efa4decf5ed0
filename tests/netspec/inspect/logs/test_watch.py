"""``netspec watch``: what it shows of a log, and how it ends."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netspec.inspect.logs.screen import bar, duration, is_alive, memory_of, plot_lines, screen, seconds_left
from netspec.inspect.logs.training_log import Curve, TrainingLog, read_log
from paths import GOLDEN

CAFFES = GOLDEN / "log" / "caffe_train.log"
Run_ = Callable[..., Any]
NONE = (np.zeros(0), np.zeros(0))


def lines_of(run: TrainingLog, **options: Any) -> list[str]:
    given = {"memory": None, "lost": False, "width": 80, "height": 30, "now": 0.0, **options}
    return screen(run, **given)


def half_done() -> TrainingLog:
    run = TrainingLog("x.log", Curve([0, 10, 20], [3, 2, 1]), settings={"max_iter": "40"})
    run.times = Curve([0, 10, 20], [0, 5, 10])
    return run


def test_it_tells_progress_speed_time_left_waiting_and_memory() -> None:
    run = half_done()
    run.waiting.add(20, 12.5)
    lines = lines_of(run, memory=(3 << 29, 1 << 31))
    assert lines[0] == "x.log: running"
    assert lines[1].startswith("iteration 20 of 40  ███")
    assert lines[1].endswith(" 50 %")
    assert lines[2].startswith("2 iter/s, 10 s left, until ")
    assert lines[3] == "loss 1"
    assert lines[4] == "waiting for data 12.5 % of the time, memory 1.5 GiB, at most 2 GiB"


def test_a_training_whose_process_is_gone_is_not_running() -> None:
    lines = lines_of(half_done(), lost=True)
    assert lines[0] == "x.log: not running"
    assert lines[2] == "2 iter/s, took 10 s"


def test_the_speed_is_that_of_late() -> None:
    run = half_done()
    run.times = Curve(list(range(21)), [*np.arange(11) * 100.0, *(1000 + np.arange(1, 11) * 1.0)])
    assert seconds_left(run) == pytest.approx(20)


@pytest.mark.parametrize(("width", "height"), [(80, 24), (40, 10), (200, 60), (20, 5)])
def test_it_fits_the_terminal(width: int, height: int) -> None:
    lines = lines_of(read_log(CAFFES), width=width, height=height)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width


def test_control_characters_of_a_log_do_not_reach_the_terminal() -> None:
    run = half_done()
    run.name, run.fault = "a\x1b[2Jb", "c\x07d"
    assert "\x1b" not in "".join(lines_of(run))
    assert "\x07" not in "".join(lines_of(run))


def test_a_curve_goes_where_its_values_are() -> None:
    lines = plot_lines((np.arange(4.0), np.array([0, 1, 2, 3.0])), NONE, 19, 6)
    assert len(lines) == 6
    assert lines[0].rstrip()[-1] != "│"  # the greatest value is at the top right
    assert lines[0].index(lines[0].rstrip()[-1]) > lines[4].index(lines[4].split("│")[1].strip()[0])
    assert lines[5].split() == ["0", "3"]


def test_marks_and_values_that_are_no_numbers() -> None:
    lines = plot_lines((np.arange(3.0), np.array([1, np.nan, 1])), (np.array([1.0]), np.array([2.0])), 30, 5)
    assert "o" in lines[0]
    assert plot_lines((np.arange(2.0), np.full(2, np.nan)), NONE, 30, 5) == []


def test_bars_and_durations() -> None:
    assert bar(0.5, 4) == "██░░"
    assert bar(7, 2) == "██"
    assert [duration(s) for s in (0, 7, 307, 11100, 183600)] == ["0 s", "7 s", "5 min 7 s", "3 h 5 min", "2 d 3 h"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
def test_processes() -> None:
    found = memory_of(os.getpid())
    assert found is not None
    assert 0 < found[0] <= found[1]
    assert memory_of(2**22 + 5) is None
    assert is_alive(2**22 + 5) is False


def test_without_a_terminal_it_shows_the_state_once(run: Run_) -> None:
    result = run("watch", CAFFES)
    assert (result.status, result.err) == (0, "")
    assert "iteration 60 of 60" in result.out
    assert "\x1b" not in result.out


def test_a_log_that_still_grows_is_of_a_training_that_runs_elsewhere(run: Run_) -> None:
    log = Path("train.log")
    text = CAFFES.read_text()
    log.write_text(text[: text.index("Iteration 60, loss")].replace(" 12526 ", f" {2**22 + 5} "))
    assert run("watch", log).out.startswith("train.log: running\n")
    os.utime(log, (0, time.time() - 3600))
    assert run("watch", log).out.startswith("train.log: not running\n")


def test_it_wants_one_log_or_one_solver(run: Run_) -> None:
    assert run("watch").status == 2
    assert run("watch", CAFFES, "--solver", "x").status == 2
    for seconds in ("0", "nan", "inf"):
        assert run("watch", CAFFES, "--every", seconds).status == 2
    assert run("watch", "no.log").fault == "no.log: cannot be read: No such file or directory"
    assert run("watch", "--solver", "no.prototxt").fault.startswith("no.prototxt: ")


@pytest.mark.slow
def test_it_trains_a_solver_and_shows_its_end(run: Run_, edited: Callable[..., str]) -> None:
    solver = edited("sgd_step/solver.prototxt", "max_iter: 60", "max_iter: 20")
    result = run("watch", "--solver", solver, "--every", "0.1")
    assert result.status == 0
    assert "iteration 20 of 20" in result.out
    log = Path(result.out.splitlines()[-1])
    assert log.parent == Path("sgd_step")
    assert "Optimization Done." in log.read_text()


@pytest.mark.slow
def test_a_training_that_fails_is_told_with_its_status(run: Run_, edited: Callable[..., str]) -> None:
    solver = edited("sgd_step/solver.prototxt", "sgd_step/train_val.prototxt", "sgd_step/none.prototxt")
    result = run("watch", "--solver", solver, "--every", "0.1")
    assert result.status == 1
    assert 'net "sgd_step/none.prototxt" is not a file' in result.fault


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo terminal")
def test_on_a_terminal_it_draws_until_the_training_ends(tmp_path: Path) -> None:
    import pty

    log = tmp_path / "train.log"
    text = CAFFES.read_text()
    log.write_text(text[: text.index("Iteration 60, loss")])
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, "-m", "netspec", "watch", str(log), "--every", "0.05"])
    shown = b""
    end = time.monotonic() + 300
    try:
        while time.monotonic() < end:
            shown += os.read(terminal, 4096)
            if b"iteration 50 of 60" in shown:
                log.write_text(text)
    except OSError:  # the end, on Linux
        pass
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0
    assert b"\x1b[?1049h" in shown
    after = shown.rpartition(b"\x1b[?1049l")[2].decode()
    assert "iteration 60 of 60" in after
