"""What is prepared for a machine with a GPU, run in small: timings on a fake GPU, the script's steps on the CPU."""

import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import worker
from benchmarks.case import training_case
from benchmarks.compare import task_of
from fake_gpu import NAME, POSSIBLE, fake_gpu
from paths import ROOT

SCRIPT = ROOT / "benchmarks" / "gpu_steps"
SMALL = {"GPU": "", "BATCH": "2", "ITERATIONS": "1", "TRAIN": "4", "VALIDATION": "4", "FRAMES": "20"}


@pytest.mark.slow
@pytest.mark.skipif(not POSSIBLE, reason="this torch cannot make a fake device")
def test_netspec_and_the_twin_train_on_the_device_that_is_named() -> None:
    with training_case("lenet", 2) as case:
        task = {**task_of(case, torch.get_num_threads()), "torch_first": True}
        losses = []
        with fake_gpu():
            for way in (worker.netspec_training, worker.pytorch_training):
                run = way({**task, "device": NAME})
                losses.append([float(run()["loss"]) for _ in range(3)])
        np.testing.assert_allclose(*losses, rtol=1e-4)


def step(name: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, **SMALL}
    command = ["bash", str(SCRIPT), name, str(folder)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)


def test_a_step_that_there_is_not_is_wrong_usage(tmp_path: Path) -> None:
    finished = step("speed", tmp_path)
    assert finished.returncode == 2
    assert finished.stderr.startswith("usage: benchmarks/gpu_steps STEP FOLDER")


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_no_step_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SMALL, "GPU", "0")
    finished = step("layers", tmp_path)
    assert finished.returncode == 1
    assert "torch finds no GPU" in finished.stderr


def test_the_page_names_every_step() -> None:
    (steps,) = re.findall(r'^STEPS="(.*)"$', SCRIPT.read_text(), re.MULTILINE)
    page = (ROOT / "benchmarks" / "README.md").read_text()
    assert all(f"`{name}`" in page for name in steps.split())


@pytest.mark.slow
def test_the_training_goes_on_and_gets_its_row(tmp_path: Path) -> None:
    for name in ("data", "train", "train", "small", "table"):
        finished = step(name, tmp_path)
        assert finished.returncode == 0, finished.stderr
    results = tmp_path / "results"
    assert (results / "train.txt").read_text() == "all 1 iterations are done\n"
    assert "as if it had never stopped" in (results / "train.log").read_text()
    scores = json.loads((results / "train.scores.json").read_text())
    assert [snapshot["iteration"] for snapshot in scores["snapshots"]] == [1]
    table = (results / "table.txt").read_text()
    assert "siamese_resnet27_256 " in table
    assert "siamese_resnet27_256_small" in table
