#!/usr/bin/env python3
"""Time a training alone, and two side by side, as their OpenMP threads wait in different ways.

    tools/benchmark_side_by_side.py                                        # the runtime's own way, and netspec's
    tools/benchmark_side_by_side.py --waits "" GOMP_SPINCOUNT=1000 --nets siamese_8

Each round measures every way in turns, so that what else the machine does meets all alike; the figures are medians over
the rounds, and, where the machine is shared, those of the best moments. The data is synthetic, the nets are those of
prototxt/small. Each training has as many threads as torch takes by itself.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # by which OpenMP runtimes are told how to wait
RECORDS = 64


def main() -> int:
    """Print, for each net and way to wait, the speed of a lone training and of each of two."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nets", nargs="+", default=["siamese_8", "siamese_resnet27_256"], metavar="NET")
    parser.add_argument("--waits", nargs="+", default=["", "OMP_WAIT_POLICY=PASSIVE"], metavar="VARIABLE=VALUE")
    parser.add_argument("--rounds", type=int, default=7, help="default: 7")
    parser.add_argument("--seconds", type=float, default=4, help="of each measurement (default: 4)")
    parser.add_argument("--train", help=argparse.SUPPRESS)  # what a process of the benchmark is given
    arguments = parser.parse_args()
    if arguments.train:
        train(arguments.train, arguments.seconds)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "prototxt").symlink_to(ROOT / "prototxt")
        write_data(Path(folder) / "data")
        for net in arguments.nets:
            measure(net, arguments.waits, folder, arguments.rounds, arguments.seconds)
    return 0


def write_data(folder: Path) -> None:
    """Write databases of synthetic pairs of 64 x 64 images, under the names that the nets' data layers give."""
    import numpy as np

    from netspec.data.database import Writer
    from netspec.data.datum import array_to_datum

    random = np.random.default_rng(0)
    folder.mkdir()
    for part in ("train", "val"):
        with Writer(str(folder / f"pairs64_{part}_lmdb")) as writer:
            for i in range(RECORDS):
                pair = random.integers(0, 256, (6, 64, 64), np.uint8)
                writer.put(b"%08d" % i, array_to_datum(pair, i % 2).SerializeToString())


def measure(net: str, waits: list[str], folder: str, rounds: int, seconds: float) -> None:
    """Measure one net and print a line for each way to wait."""
    trainings = {wait: [Training(net, wait, folder, seconds) for _ in range(2)] for wait in waits}
    alone: dict[str, list[float]] = {wait: [] for wait in waits}
    paired: dict[str, list[float]] = {wait: [] for wait in waits}
    for _ in range(rounds):
        for wait, pair in trainings.items():
            alone[wait].append(run(pair[0])[0])
        for wait, pair in trainings.items():
            paired[wait].append(statistics.mean(run(*pair)))
    for pair in trainings.values():
        for training in pair:
            training.close()
    for wait in waits:
        print(f"{net}, {wait or 'as the runtime waits by itself'}:")
        print(f"  alone: {milliseconds(alone[wait])}; speed {ratio(alone[wait], alone[waits[0]])} of the first way's")
        print(
            f"  each of two: {milliseconds(paired[wait])}; speed {ratio(paired[wait], alone[wait])} of alone",
            flush=True,
        )


def milliseconds(speeds: list[float]) -> str:
    """Return the time of an iteration, given the iterations per second of each round."""
    return f"{1e3 / statistics.median(speeds):.0f} ms an iteration, at best {1e3 / max(speeds):.0f}"


def ratio(speeds: list[float], others: list[float]) -> str:
    """Return the median of the ratios of speeds measured in the same round, and the ratio of the best ones."""
    median = statistics.median(a / b for a, b in zip(speeds, others, strict=True))
    return f"{median:.2f} (the best ones: {max(speeds) / max(others):.2f})"


class Training:
    """A process that trains for some seconds whenever it is told to."""

    def __init__(self, net: str, wait: str, folder: str, seconds: float) -> None:
        environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
        environment |= dict([wait.split("=", 1)] if wait else [])
        solver = f"prototxt/small/{net}/solver.prototxt"
        words = [sys.executable, str(Path(__file__).resolve()), "--train", solver, "--seconds", str(seconds)]
        self.process = subprocess.Popen(
            words, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.said()  # it is ready

    def tell(self) -> None:
        """Let it train."""
        assert self.process.stdin is not None
        print(file=self.process.stdin, flush=True)

    def said(self) -> str:
        """Return what it answers: the iterations per second of its last training."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a training ended before its time; what it said is above")
        return line

    def close(self) -> None:
        """End it."""
        self.process.communicate()


def run(*trainings: Training) -> list[float]:
    """Let trainings run at the same time; return the iterations per second of each."""
    for training in trainings:
        training.tell()
    return [float(training.said()) for training in trainings]


def train(path: str, seconds: float) -> None:
    """Be such a process: train at each line of stdin, and print the iterations per second."""
    import torch  # before netspec, which then leaves the way to wait alone

    import netspec

    torch.manual_seed(0)
    solver = netspec.load_solver(path, device="cpu")
    solver.param.ClearField("test_interval")
    solver.param.ClearField("snapshot")
    solver.step(2)
    print("ready", flush=True)
    for _ in sys.stdin:
        begin, iterations = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds:
            solver.step(1)
            iterations += 1
        print(iterations / (time.perf_counter() - begin), flush=True)
    solver.close()


if __name__ == "__main__":
    sys.exit(main())
