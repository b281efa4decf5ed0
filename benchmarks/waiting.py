"""Times one training alone and two side by side, with different settings for waiting OpenMP threads."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence

from benchmarks.case import training_case
from benchmarks.compare import task_of
from benchmarks.rounds import TURN, Pass, Worker, ratio

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # set how threads of OpenMP runtimes wait


def compare(name: str, waits: Sequence[str], batch: int, threads: int, rounds: int) -> None:
    """Print for each setting (VARIABLE=VALUE; empty: the default) the time alone and of each of two trainings."""
    with training_case(name, batch) as case:
        task = {**task_of(case, threads), "runs": "netspec_training", "torch_first": True}
        pairs = {}
        for wait in waits:
            variables = dict([wait.split("=", 1)] if wait else [])
            unset = dict.fromkeys(VARIABLES)
            pairs[wait] = [Worker(f"{k}{wait}", sys.executable, task, {**unset, **variables}) for k in (1, 2)]
        try:
            alone, paired = _measure(pairs, rounds)
        finally:
            for pair in pairs.values():
                for worker in pair:
                    worker.close()
    for wait in waits:
        print(f"{name}, {wait or 'as the runtime waits by itself'}:")
        print(f"  alone: {_told(alone[wait])}; {ratio(alone[wait], alone[waits[0]]):.2f} of the first way's time")
        print(
            f"  each of two: {_told(paired[wait])}; {ratio(paired[wait], alone[wait]):.2f} of the time alone",
            flush=True,
        )


def _measure(pairs: dict[str, list[Worker]], rounds: int) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    alone: dict[str, list[float]] = {wait: [] for wait in pairs}
    paired: dict[str, list[float]] = {wait: [] for wait in pairs}
    passes = max(1, int(4 * TURN / next(iter(pairs.values()))[0].turn(1)[0][0]))
    for _ in range(rounds):
        for wait, (worker, _) in pairs.items():
            alone[wait].append(_mean(worker.turn(passes)))
        for wait, pair in pairs.items():
            for worker in pair:
                worker.tell(passes)
            paired[wait].append(statistics.mean(_mean(worker.answer()) for worker in pair))
    return alone, paired


def _mean(passes: Sequence[Pass]) -> float:
    return statistics.mean(clock for clock, _ in passes)


def _told(seconds: Sequence[float]) -> str:
    return f"{1e3 * statistics.median(seconds):.0f} ms per iteration, at best {1e3 * min(seconds):.0f}"
