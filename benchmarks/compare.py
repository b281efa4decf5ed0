"""Runs a case with all programs, in rounds."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.case import DECAY, MOMENTUM, RATE, Case
from benchmarks.report import REFERENCES, Row
from benchmarks.rounds import Contestant, Pass, Worker, difference, measure, ratio

IN_SEPARATE_ENVIRONMENT = ("opencv4", "onnxruntime", "openvino", "openvino-bf16")


@dataclass(frozen=True)
class Comparison:
    """The programs that run a case, and the limits of the measurement.

    programs         the programs and engines to compare, such as netspec-onnxruntime
    training         whether a pass is a training iteration, and not a forward pass
    separate_python  the Python of a separate environment, for the programs that need it
    limit            the rounds take at most this many seconds, but there are at least three
    device           the torch device for trainings by netspec and by PyTorch alone
    """

    programs: Sequence[str]
    training: bool
    rounds: int
    separate_python: str | None = None
    limit: float = math.inf
    device: str = "cpu"


def rows_of(case: Case, threads: int, how: Comparison) -> list[Row]:
    """Return a row for each program."""
    task = {**task_of(case, threads), "device": how.device}
    suffix = "_training" if how.training else ""
    contestants = [_worker(case, program, task, suffix, how.separate_python) for program in how.programs]
    able = [one for one in contestants if not one.fault]
    try:
        times = measure(able, how.rounds, lambda k: _show_progress(case, threads, k, how.rounds), how.limit)
    finally:
        for one in contestants:
            one.close()
    _show_progress(case, threads, how.rounds, how.rounds)
    return rows_of_times(case, threads, contestants, times, "training" if how.training else "forward")


def rows_of_times(
    case: Case, threads: int, contestants: Sequence[Contestant], times: Mapping[str, Sequence[Pass]], what: str
) -> list[Row]:
    """Return a row for each contestant; ``times``: those that were measured, by name."""
    able = [one for one in contestants if not one.fault]
    expected = next((one.outputs for one in able if one.name == "netspec"), None)
    seconds = {name: [clock for clock, _ in passes] for name, passes in times.items()}
    rows = []
    for one in contestants:
        own = seconds.get(one.name, [])
        computing = [spent for _, spent in times.get(one.name, [])]
        ratios = {
            name: ratio(own, seconds[name]) for name in REFERENCES if own and name in seconds and name != one.name
        }
        spent = {name: ratio(computing, [used for _, used in times[name]]) for name in ratios}
        off = difference(one.outputs, expected) if expected and one.name != "netspec" and one.outputs else None
        rows.append(
            Row(case.name, case.batch, threads, one.name, own, computing, ratios, off, one.fault, spent, one.peak, what)
        )
    return rows


def task_of(case: Case, threads: int) -> dict[str, Any]:
    """Return the task for benchmarks/worker.py."""
    from netspec.proto.text import read_net

    message = read_net(case.prototxt)
    read = {blob for layer in message.layer for blob in layer.bottom}
    outputs = sorted({blob for layer in message.layer for blob in layer.top} - read)
    return {
        **{
            name: str(getattr(case, name))
            for name in ("prototxt", "caffemodel", "torch", "onnx", "inputs", "solver", "folder")
        },
        "cache": str(case.folder / "cache"),
        **{"outputs": outputs, "threads": threads, "device": "cpu"},
        **{"rate": RATE, "momentum": MOMENTUM, "decay": DECAY},
    }


def _worker(case: Case, program: str, task: dict[str, Any], suffix: str, separate_python: str | None) -> Contestant:
    name, options = parts(program)
    if name == "pytorch" and not case.torch.is_file():
        return _Absent(program, "netspec export --to torch cannot write this net")
    return Worker(program, python_of(program, separate_python), {**task, **options, "program": name + suffix})


def parts(program: str) -> tuple[str, dict[str, str]]:
    """Split a name such as ``netspec-openvino-bf16`` into program, engine and precision."""
    name, *rest = program.split("-")
    precision = rest.pop() if rest[-1:] == ["bf16"] else "fp32"
    return name, {"engine": rest[0] if rest else "torch", "precision": precision}


def python_of(program: str, separate_python: str | None) -> str:
    """Return the path of the Python that has the library that a program needs."""
    return separate_python if separate_python and program in IN_SEPARATE_ENVIRONMENT else sys.executable


class _Absent:
    """A program that cannot run this net."""

    peak: float | None = None

    def __init__(self, name: str, fault: str) -> None:
        self.name, self.fault, self.outputs = name, fault, {}

    def turn(self, passes: int) -> list[Pass]:
        """Never called."""
        raise AssertionError(self.fault)

    def close(self) -> None:
        """Do nothing."""


def _show_progress(case: Case, threads: int, done: int, rounds: int) -> None:
    if sys.stderr.isatty():
        text = f"{case.name}, batch {case.batch}, threads {threads}: round {done + 1} of {rounds}"
        print(f"\r\033[K{text if done < rounds else ''}", end="", file=sys.stderr, flush=True)
