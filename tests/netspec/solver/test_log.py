"""What of the log depends on the clock or on settings; tests/netspec/terminal/test_log.py compares whole logs."""

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from netspec import load_net, log
from netspec.load import load_solver
from netspec.solver.testing import Tally, score_lines
from netspec.terminal import output


@pytest.fixture
def lines(tmp_path: Path) -> Iterator[Callable[[], list[str]]]:
    """Return a function that returns what was logged so far, in the form of the command line."""
    path = tmp_path / "netspec.log"
    handler = logging.FileHandler(path)
    handler.setFormatter(output.GlogFormatter())
    log.logger.addHandler(handler)
    level = log.logger.level
    log.logger.setLevel(logging.INFO)
    yield lambda: path.read_text().splitlines()
    log.logger.removeHandler(handler)
    log.logger.setLevel(level)


@pytest.mark.slow
def test_the_speed_comes_from_the_clock_and_is_0_at_first(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel")
    times = iter([100.0, 100.5, 102.5])
    solver.options = replace(solver.options, clock=lambda: next(times))
    solver.step(11)
    solver.close()
    paces = re.findall(r"\((\S+ iter/s, \S+ iters)\)", "\n".join(lines()))
    assert paces == ["0 iter/s, 0.5s/10 iters", "5 iter/s, 2s/10 iters"]


def test_the_share_of_time_spent_waiting_for_data_is_logged(
    work_in: Callable[..., Path], lines: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch
):
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel")
    times, waited = iter([100.0, 100.5, 102.5]), iter([1.0, 1.25, 1.3])
    solver.options = replace(solver.options, clock=lambda: next(times))
    monkeypatch.setattr(solver._display, "_seconds_waited", lambda: next(waited))
    solver.step(11)
    solver.close()
    assert re.findall(r"Waiting for data: (\S+) % of the time", "\n".join(lines())) == ["50.0", "2.5"]


def test_clipping_and_multistep_are_logged(work_in: Callable[..., Path], lines: Callable[[], list[str]]):
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


def test_a_tally_is_the_mean_of_each_element_over_the_batches():
    tally = Tally()
    assert tally.add(torch.tensor(1.0), {"loss": torch.tensor(1.0), "acc": torch.tensor([[1.0, 2.0]])}) == {
        "loss": [1.0],
        "acc": [1.0, 2.0],
    }
    tally.add(torch.tensor(2.0), {"loss": torch.tensor(2.0), "acc": torch.tensor([[3.0, 2.0]])})
    assert tally.loss == pytest.approx(1.5)
    assert tally.scores == {"loss": [1.5], "acc": [2.0, 2.0]}


def test_an_output_whose_size_changes_has_no_mean(lines: Callable[[], list[str]]):
    """As that of a detector: the other outputs keep theirs. Caffe adds to the elements of other outputs."""
    tally = Tally()
    for size in (2, 3, 2):
        tally.add(torch.tensor(1.0), {"acc": torch.tensor([1.0]), "found": torch.ones(size), "none": torch.ones(0)})
    assert tally.scores == {"acc": [1.0], "none": []}
    assert [line.partition("] ")[2] for line in lines() if "found" in line] == [
        'output "found" has 3 values in batch 2, and 2 before; its mean is not computed'
    ]


def test_scores_are_printed_with_their_contribution_to_the_loss():
    lines = score_lines({"acc": [0.5, 1 / 3], "loss": [2.0]}, {"acc": 0.0, "loss": 0.3})
    assert list(lines) == ["acc = 0.5", "acc = 0.333333", "loss = 2 (* 0.3 = 0.6 loss)"]


def test_a_loss_without_a_top_gets_caffes_name(tmp_path: Path, lines: Callable[[], list[str]]):
    path = tmp_path / "net.prototxt"
    path.write_text(
        'input: "a" input_shape { dim: 2 } input: "b" input_shape { dim: 2 }\n'
        'layer { name: "loss" type: "EuclideanLoss" bottom: "a" bottom: "b" }'
    )
    net = load_net(path)
    assert "net.cpp:382] loss -> (automatic)" in " ".join(lines())
    assert net.outputs == []
