"""The log is Caffe's, line by line: what it printed for the same runs, and what people's log parsers make of it."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from netspec import log
from netspec.cli import main
from paths import GOLDEN

pytestmark = pytest.mark.slow

TRAIN = ["train", "--solver=sgd_step/solver.prototxt", "--weights=sgd_step/init.caffemodel"]
RESUME = ["train", "--solver=sgd_step/solver.prototxt", "--snapshot=sgd_step/ref_iter_40.solverstate"]
TEST = ["test", "--model=sgd_step/train_val.prototxt", "--weights=sgd_step/init.caffemodel", "--iterations=4"]
TIME = ["time", "--model=sgd_step/train_val.prototxt", "--iterations=5"]

#: A clock's, or of the threads that read ahead: where in the log they come is chance.
OURS = " resuming.py:"  # how a training resumes, which Caffe does in one way only
OF_THE_MOMENT = re.compile(r"Restarting data prefetching from start\.$|blocking_queue\.cpp:49\] Waiting for data")


@pytest.fixture
def run(work_in: Callable[..., Path], capfd: pytest.CaptureFixture[str]) -> Callable[[list[str]], list[str]]:
    """``run(arguments)``: what a command prints to stderr, line by line, beside the golden snapshots."""
    work_in("snapshot", "sgd_step")

    def run_command(arguments: list[str]) -> list[str]:
        capfd.readouterr()
        assert main(arguments) == 0
        return capfd.readouterr().err.splitlines()

    return run_command


def sentences(lines: list[str]) -> list[str]:
    """Return the lines without what differs from run to run: glog's prefix, seconds, the lines of other threads."""
    plain = [re.sub(r"^([IWE])\d{4,8} \S+ +\d+ ", r"\1 ", line) for line in lines]
    plain = [line for line in plain if not OF_THE_MOMENT.search(line) and OURS not in line]
    plain = [re.sub(r"\(\S+ iter/s, \S+s/10 iters\)", "(_ iter/s, _s/10 iters)", line) for line in plain]
    return [re.sub(r"[\d.e+-]+ ms\.$", "_ ms.", line) for line in plain]


def split_loss(line: str) -> tuple[str, list[float]]:
    """Return the words of a line, and the values of the losses in it."""
    if not re.search(r"[Ll]oss[:=]? ", line) or " with loss weight " in line:
        return line, []
    number = r"(?<=[ =])\d+\.\d+(?:e-\d+)?"
    return re.sub(number, "_", line), [float(found) for found in re.findall(number, line)]


def losses(lines: list[tuple[str, list[float]]]) -> list[float]:
    return [value for _, values in lines for value in values]


@pytest.mark.parametrize(
    ("arguments", "golden"),
    [(TRAIN, "caffe_train.log"), (RESUME, "caffe_resume.log"), (TEST, "caffe_test.log")],
    ids=["train", "resume", "test"],
)
def test_a_training_has_caffes_log(run: Callable[[list[str]], list[str]], arguments: list[str], golden: str) -> None:
    found = [split_loss(line) for line in sentences(run(arguments))]
    expected = [split_loss(line) for line in sentences((GOLDEN / "log" / golden).read_text().splitlines())]
    assert [words for words, _ in found] == [words for words, _ in expected]
    np.testing.assert_allclose(losses(found), losses(expected), rtol=1e-4)


def test_a_timing_has_caffes_log(run: Callable[[list[str]], list[str]]) -> None:
    found = [split_loss(line)[0] for line in sentences(run(TIME))]
    expected = (GOLDEN / "log" / "caffe_time.log").read_text().splitlines()
    assert found == [split_loss(line)[0] for line in sentences(expected)]


@pytest.mark.parametrize("arguments", [TRAIN, TEST, TIME], ids=lambda arguments: arguments[0])
def test_every_line_has_glogs_four_fields(run: Callable[[list[str]], list[str]], arguments: list[str]) -> None:
    inside_proto = False
    lines = run(arguments)
    assert len(lines) > 100
    for line in lines:
        match = re.match(r"[IWEF]\d{4} \d\d:\d\d:\d\d\.\d{6} +\d+ \w+\.[ch]pp:\d+\] ", line)
        if match:
            assert len(match[0].split()) == 4
            inside_proto = line.endswith("from parameters: ")
        else:
            assert inside_proto, line


def test_the_end_of_the_data_is_logged_each_time(run: Callable[[list[str]], list[str]]) -> None:
    """60 batches of 32 end the 640 records three times, and each test's four of 50 the 200 records once."""
    ends = [line for line in run(TRAIN) if line.endswith("Restarting data prefetching from start.")]
    assert len(ends) == 3 + 3


# Numbers


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.153106, "0.153106"), (1.0, "1"), (1e-5, "1e-05"), (123456.7, "123457"), (1234567.0, "1.23457e+06"), (0.0, "0")],
)
def test_numbers_are_printed_like_cpp_streams(value: float, text: str) -> None:
    assert log.number(value) == text
