"""Times one training alone and two side by side, with different settings for waiting OpenMP threads."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence

from benchmarks.case import training_case
from benchmarks.compare import task_of
from benchmarks.rounds import TURN_S, Pass, Worker, ratio

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # set how threads of OpenMP runtimes wait


def compare(name: str, waits: Sequence[str], batch: int, threads: int, rounds: int) -> None:
    """Print the time of one training alone, and of each of two at the same time, for each setting in ``waits``.

    A setting is VARIABLE=VALUE; an empty one means the defaults of the runtime.
    """
    with training_case(name, batch) as case:
        task = {**task_of(case, threads), "program": "netspec_training", "torch_first": True}
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
        print(f"{name}, {wait or 'defaults of the runtime'}:")
        share = ratio(alone[wait], alone[waits[0]])
        print(f"  alone: {_times_text(alone[wait])}; {share:.2f} of the time with the first setting")
        print(
            f"  each of two: {_times_text(paired[wait])}; {ratio(paired[wait], alone[wait]):.2f} of the time alone",
            flush=True,
        )


def _measure(pairs: dict[str, list[Worker]], rounds: int) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    alone: dict[str, list[float]] = {wait: [] for wait in pairs}
    paired: dict[str, list[float]] = {wait: [] for wait in pairs}
    passes = max(1, int(4 * TURN_S / next(iter(pairs.values()))[0].turn(1)[0][0]))
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


def _times_text(seconds: Sequence[float]) -> str:
    return f"{1e3 * statistics.median(seconds):.0f} ms per iteration, at best {1e3 * min(seconds):.0f}"
