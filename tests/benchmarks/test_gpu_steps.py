"""What is prepared for a machine with a GPU: timings on a fake one, and the steps, with programs that only note."""

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

import lmdb_build.cli
import netspec.cli
from benchmarks import worker
from benchmarks.case import training_case
from benchmarks.compare import parts, task_of
from fake_gpu import NAME, POSSIBLE, fake_gpu
from netspec.proto.text import read_net, read_solver
from paths import ROOT

SCRIPT = ROOT / "benchmarks" / "gpu_steps"
SMALL = {"GPU": "", "BATCH": "2", "ITERATIONS": "1", "TRAIN": "4", "VALIDATION": "4", "FRAMES": "20"}


@pytest.mark.slow
@pytest.mark.skipif(not POSSIBLE, reason="this torch cannot make a fake device")
def test_netspec_and_the_twin_train_on_the_device_that_is_named() -> None:
    with training_case("lenet", 2) as case:
        task = {**task_of(case, torch.get_num_threads()), **parts("pytorch")[1], "torch_first": True}
        losses = []
        with fake_gpu():
            for way in (worker.netspec_training, worker.pytorch_training):
                run = way({**task, "device": NAME})
                losses.append([float(run()["loss"]) for _ in range(3)])
        np.testing.assert_allclose(*losses, rtol=1e-4)


def step(name: str, folder: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    command = ["bash", str(SCRIPT), name, str(folder)]
    environment = {**os.environ, "NEEDS": "", **SMALL, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, check=False)


def test_a_step_that_there_is_not_is_wrong_usage(tmp_path: Path) -> None:
    finished = step("speed", tmp_path)
    assert finished.returncode == 2
    assert finished.stderr.startswith("usage: benchmarks/gpu_steps STEP FOLDER")


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_no_step_passes(tmp_path: Path) -> None:
    finished = step("layers", tmp_path, GPU="0")
    assert finished.returncode == 1
    assert "torch finds no GPU" in finished.stderr


def test_the_page_names_every_step() -> None:
    (steps,) = re.findall(r'^STEPS="(.*)"$', SCRIPT.read_text(), re.MULTILINE)
    page = (ROOT / "benchmarks" / "README.md").read_text()
    assert all(f"`{name}`" in page for name in steps.split())


# What stands for the programs: it notes its words; the first training is stopped, the second ends with a snapshot.
PROGRAM = """#!/usr/bin/env bash
echo "$(basename "$0") $*" >>started
case "$1" in
  pairs) mkdir pairs ;;
  train)
    while [ "$1" != --scores ]; do shift; done
    echo "{}" >"$2"
    [ -e stopped ] || { touch stopped; exit 124; }
    touch prototxt/normalized/siamese_resnet27_256/siamese_resnet27_256_iter_1.solverstate
    ;;
  compare) echo "| a table |" ;;
esac
"""


def test_the_steps_start_commands_that_there_are_on_files_that_fit(tmp_path: Path) -> None:
    programs, folder = tmp_path / "venv" / "bin", tmp_path / "steps"
    programs.mkdir(parents=True)
    parsers = {"netspec": netspec.cli.parser, "lmdb-build": lmdb_build.cli.parser}
    for name in parsers:
        (programs / name).write_text(PROGRAM)
        (programs / name).chmod(0o755)
    (tmp_path / "venv" / "installed").touch()
    said = []
    for name in ("data", "train", "train", "small", "table"):
        finished = step(name, folder, VENV=str(tmp_path / "venv"))
        assert finished.returncode == 0, finished.stderr
        said.append(finished.stdout)
    assert said[1:] == ["stopped; run the step again\n", "all 1 iterations are done\n", "", "| a table |\n"]
    assert (folder / "results" / "train.scores.json").read_text() == "{}\n"
    assert (folder / "results" / "table.txt").read_text() == said[-1]
    started = [line.split() for line in (folder / "started").read_text().splitlines()]
    for program, *words in started:
        parsers[program]().parse_args(words)
    written = {words[-1] for _, command, *words in started if command == "convert"}
    trained = {words[words.index("--solver") + 1] for _, *words in started if words[0] == "train"}
    assert trained == {f"prototxt/{part}/siamese_resnet27_256/solver.prototxt" for part in ("normalized", "small")}
    assert started[-1][1:5] == ["compare", "--no-train", *sorted(trained)]
    for path in trained:
        solver = read_solver(folder / path)
        assert (solver.max_iter, list(solver.test_iter)) == (1, [1])
        data = [layer for layer in read_net(folder / solver.net).layer if layer.type == "Data"]
        assert {layer.data_param.source for layer in data} <= written
        assert data[1].data_param.batch_size == 4
