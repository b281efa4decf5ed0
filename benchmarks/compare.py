"""All ways to run one case, in rounds."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.case import DECAY, MOMENTUM, RATE, Case
from benchmarks.report import REFERENCES, Row
from benchmarks.rounds import CaffeProgram, Contestant, Worker, difference, measure, ratio


def rows_of(
    case: Case, threads: int, ways: Sequence[str], suffix: str, yardsticks: str | None, caffe: str | None, rounds: int
) -> list[Row]:
    """Return a row for each way; ``suffix`` is that of the worker's functions, ``yardsticks`` the Python of some."""
    task = task_of(case, threads)
    contestants = [_worker(case, way, task, suffix, yardsticks) for way in ways]
    if caffe:
        contestants.append(CaffeProgram(caffe, task, training=bool(suffix)))
    able = [one for one in contestants if not one.fault]
    try:
        seconds = measure(able, rounds, lambda k: _tell(case, threads, k, rounds))
    finally:
        for one in contestants:
            one.close()
    _tell(case, threads, rounds, rounds)
    expected = next((one.outputs for one in able if one.name == "netspec"), None)
    rows = []
    for one in contestants:
        own = seconds.get(one.name, [])
        ratios = {
            name: ratio(own, seconds[name]) for name in REFERENCES if own and name in seconds and name != one.name
        }
        off = difference(one.outputs, expected) if expected and one.name != "netspec" and one.outputs else None
        rows.append(Row(case.name, case.batch, threads, one.name, own, ratios, off, one.fault))
    return rows


def task_of(case: Case, threads: int) -> dict[str, Any]:
    """Return what benchmarks/worker.py needs to know of a case."""
    from netspec.proto.text import read_net

    message = read_net(case.prototxt)
    read = {blob for layer in message.layer for blob in layer.bottom}
    outputs = sorted({blob for layer in message.layer for blob in layer.top} - read)
    return {
        **{name: str(getattr(case, name)) for name in ("prototxt", "caffemodel", "onnx", "inputs", "solver", "folder")},
        **{"twin": case.twin, "outputs": outputs, "threads": threads},
        **{"rate": RATE, "momentum": MOMENTUM, "decay": DECAY},
    }


def _worker(case: Case, way: str, task: dict[str, Any], suffix: str, yardsticks: str | None) -> Contestant:
    if way == "pytorch" and case.twin is None:
        return _Absent(way, "there is no twin of this net; --twin names one that fits")
    name, _, precision = way.partition("-")
    python = yardsticks if yardsticks and name in ("opencv4", "onnxruntime", "openvino") else sys.executable
    return Worker(way, python, {**task, "runs": name + suffix, "precision": precision or "fp32"})


class _Absent:
    """A way that there is not for this net."""

    def __init__(self, name: str, fault: str) -> None:
        self.name, self.fault, self.outputs = name, fault, {}

    def turn(self, passes: int) -> list[float]:
        """Never called."""
        raise AssertionError(self.fault)

    def close(self) -> None:
        """Nothing is open."""


def _tell(case: Case, threads: int, done: int, rounds: int) -> None:
    if sys.stderr.isatty():
        text = f"{case.name}, batch {case.batch}, threads {threads}: round {done + 1} of {rounds}"
        print(f"\r\033[K{text if done < rounds else ''}", end="", file=sys.stderr, flush=True)
