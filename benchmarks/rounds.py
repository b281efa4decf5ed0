"""Runs all contestants in turn, round after round, so that other load on the machine affects all of them equally."""

from __future__ import annotations

import json
import math
import os
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Protocol

import numpy as np

from netspec.errors import SpecError

ROOT = Path(__file__).resolve().parents[1]
TURN_S, MOST_PASSES = 0.4, 50  # seconds of a turn, and its largest number of passes
FEWEST_ROUNDS = 3  # minimum number of rounds
PAUSE_S = 0.03  # seconds before a turn, in which threads of the previous contestant stop spinning
Pass = tuple[float, float]  # wall-clock seconds, and CPU seconds of all threads


class Contestant(Protocol):
    """A program that runs a case.

    fault    why it cannot run; empty if it can
    outputs  outputs of its first pass
    peak     peak memory in MB, set by ``close``; None if unknown
    """

    name: str
    fault: str
    peak: float | None
    outputs: dict[str, np.ndarray]

    def turn(self, passes: int) -> list[Pass]:
        """Run ``passes`` passes and return their times."""
        ...

    def close(self) -> None:
        """End the process, if there is one."""
        ...


class Worker:
    """A process of benchmarks/worker.py, or of another module like it, with the Python that has its library."""

    def __init__(
        self,
        name: str,
        python: str,
        task: Mapping[str, Any],
        variables: Mapping[str, str | None] | None = None,
        module: str = "benchmarks.worker",
    ):
        self.name = name
        result = Path(task["folder"]) / f"{name.replace('/', '_')}.npz"
        command = [python, "-m", module, json.dumps({**task, "result": str(result)})]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **(variables or {})}
        environment = {key: value for key, value in environment.items() if value is not None}
        self.errors = result.with_suffix(".log").open("w+")
        self.process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, text=True
        )
        self.fault = self._read_line().get("fault", "")
        self.peak: float | None = None
        self.outputs: dict[str, np.ndarray] = {}
        if not self.fault:
            with np.load(result) as arrays:
                self.outputs = {key: arrays[key] for key in arrays.files}

    def turn(self, passes: int) -> list[Pass]:
        """See :class:`Contestant`."""
        assert self.process.stdin is not None
        print(passes, file=self.process.stdin, flush=True)
        answer = self._read_line()
        if isinstance(answer, dict):
            raise SpecError(f"{self.name}: {answer['fault']}")
        return [(clock, computing) for clock, computing in answer]

    def close(self) -> None:
        """See :class:`Contestant`."""
        self.peak = _peak(self.process.pid)
        self.process.communicate()
        self.errors.close()

    def _read_line(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if line:
            return json.loads(line)
        status = self.process.wait()
        self.errors.seek(0)
        lines = self.errors.read().strip().splitlines()
        return {"fault": lines[-1] if lines else f"ended with status {status}"}


def _peak(process: int) -> float | None:
    """Return the peak memory of a process in MB; None if the system does not report it."""
    path = Path(f"/proc/{process}/status")
    found = re.search(r"VmHWM:\s+(\d+) kB", path.read_text()) if path.is_file() else None
    return int(found[1]) / 1e3 * 1.024 if found else None


class Command:
    """A whole process, started again for each pass; the times are those from its start to its end."""

    peak: float | None = None

    def __init__(self, name: str, words: Sequence[str], variables: Mapping[str, str]) -> None:
        self.name, self.fault, self.outputs = name, "", {}
        self._words, self._variables = list(words), {**os.environ, "PYTHONPATH": str(ROOT), **variables}

    def turn(self, passes: int) -> list[Pass]:
        """See :class:`Contestant`."""
        return [self._run() for _ in range(passes)]

    def _run(self) -> Pass:
        with TemporaryFile("w+") as errors:
            began = time.perf_counter()
            process = subprocess.Popen(self._words, env=self._variables, stdout=errors, stderr=errors)
            _, status, used = os.wait4(process.pid, 0)
            seconds = time.perf_counter() - began
            process.returncode = os.waitstatus_to_exitcode(status)
            if process.returncode:
                errors.seek(0)
                raise SpecError(f"{self.name}: {(errors.read().strip().splitlines() or ['it failed'])[-1]}")
        return seconds, used.ru_utime + used.ru_stime

    def close(self) -> None:
        """See :class:`Contestant`."""


def measure(
    contestants: Sequence[Contestant], rounds: int, tell: Callable[[int], object], limit: float = math.inf
) -> dict[str, list[Pass]]:
    """Return the times of a pass by name, one per round: the median of its turn.

    ``tell`` is called with the number of each round before it starts. After three rounds, no round starts that would
    end more than ``limit`` seconds after the start of the first.
    """
    times: dict[str, list[Pass]] = {one.name: [] for one in contestants}
    passes = {one.name: max(1, min(MOST_PASSES, int(TURN_S / one.turn(1)[0][0]))) for one in contestants}
    began = time.monotonic()
    for k in range(rounds):
        passed = time.monotonic() - began
        if k >= FEWEST_ROUNDS and passed * (k + 1) / k > limit:
            break
        tell(k)
        for one in contestants if k % 2 == 0 else reversed(contestants):
            time.sleep(PAUSE_S)
            clock, computing = zip(*one.turn(passes[one.name]), strict=True)
            times[one.name].append((statistics.median(clock), statistics.median(computing)))
    return times


def ratio(seconds: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the ratios of times in the same round."""
    return statistics.median(a / b for a, b in zip(seconds, others, strict=True))


def difference(outputs: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> float | None:
    """Return the largest difference of any output, relative to its largest element; None if shapes differ."""
    worst = 0.0
    for name, value in expected.items():
        found = outputs.get(name)
        if found is None or found.size != value.size:
            return None
        largest = float(np.abs(value).max(initial=0)) or 1.0
        worst = max(worst, float(np.abs(found.reshape(-1) - value.reshape(-1)).max(initial=0)) / largest)
    return worst
