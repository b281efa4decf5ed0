"""Compares whole programs: ``tools/bench programs``. The programs are in benchmarks/programs.py."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.case import DECAY, MOMENTUM, RATE, Case, calm, randomize, training_case, write_torch
from benchmarks.compare import python_of, rows_of_times
from benchmarks.detectors import HEADS, SOURCES, mtcnn, ssd300
from benchmarks.report import Row
from benchmarks.rounds import Command, Contestant, Pass, Worker
from benchmarks.zoo import deploy
from netspec.errors import SpecError

FILES, ITERATIONS, BATCH = 100, 1000, 64  # images; iterations and batch size of the training
PEERS = {
    "mtcnn": ("netspec", "opencv4", "pytorch"),
    "ssd300": ("netspec", "opencv4"),
    "files": ("netspec", "opencv4", "pytorch"),
    "classifier": ("netspec", "opencv4", "pytorch"),
    "training": ("netspec", "pytorch"),
    "start": ("netspec", "opencv4", "pytorch"),
}
BACKGROUND, SCORES, OFFSETS = 8.0, 1.5, 0.5  # SSD's bias of the background; deviation of scores and of offsets


@dataclass(frozen=True)
class How:
    """What is measured: numbers of threads and of rounds, and the Python that has OpenCV 4."""

    threads: Sequence[int]
    rounds: int
    separate_python: str | None


def measure(names: Sequence[str], how: How) -> Iterator[list[Row]]:
    """Yield the rows of each program for each number of threads. Raises SpecError for an unknown name."""
    unknown = next((name for name in names if name not in PEERS), None)
    if unknown is not None:
        raise SpecError(f'no program "{unknown}"; there are: {", ".join(PEERS)}')
    for name in names:
        with _prepared(name) as task:
            for threads in how.threads:
                yield _rows(name, {**task, "threads": threads}, how)


def _rows(name: str, task: dict[str, Any], how: How) -> list[Row]:
    case = Case(name, task.get("batch", 1), Path(task["folder"]))
    contestants = [_contestant(name, peer, task, how.separate_python) for peer in PEERS[name]]
    able = [one for one in contestants if not one.fault]
    times: dict[str, list[Pass]] = {one.name: [] for one in able}
    try:
        for k in range(how.rounds):
            for one in able if k % 2 == 0 else reversed(able):
                times[one.name] += one.turn(1)
    finally:
        for one in contestants:
            one.close()
    return rows_of_times(case, task["threads"], contestants, times, "program")


def _contestant(name: str, peer: str, task: dict[str, Any], separate_python: str | None) -> Contestant:
    python = python_of(peer, separate_python)
    program = f"{'files' if name == 'start' else name}/{peer}"
    variables = {"OMP_NUM_THREADS": str(task["threads"]), "GLOG_minloglevel": "2"}
    if program == "training/netspec":
        words = ["train", "--solver", task["solver"], "--weights", task["caffemodel"]]
        return Command(peer, [python, "-m", "netspec", *words], variables)
    if name in ("training", "start"):
        words = ["-m", "benchmarks.programs", "once", json.dumps({**task, "program": program})]
        return Command(peer, [python, *words], variables)
    return Worker(peer, python, {**task, "program": program}, variables, "benchmarks.programs")


@contextmanager
def _prepared(name: str) -> Iterator[dict[str, Any]]:
    """Write the files of a program; its task without the number of threads."""
    with ExitStack() as stack:
        if name == "training":
            yield _training(stack.enter_context(training_case("lenet", BATCH)))
            return
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="programs-")))
        files = _pictures(folder, 1 if name == "start" else FILES if name in ("files", "classifier") else 1)
        task: dict[str, Any] = {"folder": str(folder), "files": files, "image": files[0]}
        if name == "mtcnn":
            heads = {net: [f"head{k}" for k in range(2, 2 + len(widths))] for net, widths in HEADS.items()}
            yield {**task, "heads": heads, "nets": {net: net_files(folder, net, mtcnn(net)) for net in HEADS}}
        elif name == "ssd300":
            yield {**task, "nets": {name: net_files(folder, name, ssd300(), like_trained)}}
        else:
            from netspec.proto.text import write_text

            text = write_text(deploy("squeezenet"))
            yield {**task, "nets": {"squeezenet": net_files(folder, "squeezenet", text)}}


def _training(case: Case) -> dict[str, Any]:
    text = case.solver.read_text()
    text = re.sub(r"max_iter: \d+", f"max_iter: {ITERATIONS}\ndisplay: 100\nsnapshot_after_train: false", text)
    case.solver.write_text(text)
    files = {name: str(getattr(case, name)) for name in ("folder", "solver", "caffemodel", "torch")}
    rates = {"rate": RATE, "momentum": MOMENTUM, "decay": DECAY}
    return {**files, **rates, "source": str(case.folder / "records"), "batch": BATCH, "iterations": ITERATIONS}


def _pictures(folder: Path, count: int) -> list[str]:
    import cv2

    random = np.random.default_rng(0)
    files = [str(folder / f"{k}.jpg") for k in range(count)]
    for path in files:  # smooth noise: as many bytes as a photograph of 640x480
        coarse = random.integers(0, 256, (60, 80, 3), np.uint8)
        cv2.imwrite(path, cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC))
    return files


def net_files(
    folder: Path, name: str, text: str, finish: Callable[[Any, dict[str, Any]], None] = calm
) -> tuple[str, str]:
    """Write a net with random weights; return the paths of the prototxt and of the weights."""
    import netspec

    prototxt, caffemodel = folder / f"{name}.prototxt", folder / f"{name}.caffemodel"
    prototxt.write_text(text)
    net = netspec.load_net(prototxt, "TEST", seed=0)
    randomize(net)
    random = np.random.default_rng(0)
    finish(net, {blob: random.standard_normal(net.shapes[blob], np.float32) / 2 for blob in net.inputs})
    netspec.save_weights(net, caffemodel)
    write_torch(net, prototxt.with_suffix(".py"))
    return str(prototxt), str(caffemodel)


def like_trained(net: Any, inputs: dict[str, Any]) -> None:
    """Scale the heads of SSD so that most places show the background, and about a hundredth of the scores count."""
    import torch

    kinds = {f"{source}_{kind}": size for source, *_ in SOURCES for kind, size in (("loc", OFFSETS), ("conf", SCORES))}
    net.keep = list(kinds)
    with torch.inference_mode():
        net(**inputs)
    with torch.no_grad():
        for layer in net.layers:
            if layer.param.name in kinds:
                weights, bias = layer.blobs
                weights *= kinds[layer.param.name] / net.blobs[layer.param.name].std()
                bias.zero_()
                if layer.param.name.endswith("_conf"):
                    bias[::21] = BACKGROUND
    net.keep = ()
