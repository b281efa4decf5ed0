"""Measures how the cost of a search grows with the frames of a drive.

Each size is measured in a separate process, ``python -m benchmarks.growth FRAMES``, to get its peak memory. Times
are CPU times of one thread, which other load hardly changes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from netspec.errors import SpecError

Found = dict[str, float]  # a column of the table and its value

ROOT = Path(__file__).resolve().parents[1]
WALK = 300  # frames; more descriptors are made by perturbing theirs
COMPONENTS = 256  # of a descriptor
QUERIES, AT_ONCE = 50, 4096  # frames searched for, and added at a time
SAME_PLACE = 0.3  # distance of two descriptors of one place, as a share of that of two places


def frames(size: int) -> Found:
    """Search ``size`` descriptors of the default net as a detector does, exactly and by FAISS."""
    from loopclosure.detector.detector import LoopDetector
    from loopclosure.index.index import open_index

    base = described_walk(min(WALK, max(2, size)))
    random = np.random.default_rng(0)
    rows = np.concatenate([perturbed(base, min(AT_ONCE, size - k), random) for k in range(0, size, AT_ONCE)])
    seen_again = rows[random.integers(0, size, QUERIES)] + SAME_PLACE * _differences(base, QUERIES, random)
    best: dict[str, list[list[int]]] = {}
    found: Found = {}
    for name in ("exact", "faiss") if find_spec("faiss") else ("exact",):
        detector = LoopDetector(None, check=None, index=open_index(name, "euclidean"))
        start = time.process_time()
        no_poses = {"stamps": np.full(size, np.nan), "poses": np.full((size, 7), np.nan)}
        detector.take_session((rows[k : k + AT_ONCE] for k in range(0, size, AT_ONCE)), no_poses, None)
        found[f"{name}, adding, us per frame"] = 1e6 * (time.process_time() - start) / size
        detector.begin_session()
        start = time.process_time()
        results = []
        for row in seen_again:
            detector.add_descriptor(row)
            results.append(detector.newest)
        found[f"{name}, ms per frame"] = 1e3 * (time.process_time() - start) / QUERIES
        best[name] = [[number for number, _ in result.candidates] for result in results]
    if "faiss" in best:
        pairs = list(zip(best["exact"], best["faiss"], strict=True))
        found["FAISS, share of best matches found"] = float(np.mean([a[0] == b[0] for a, b in pairs]))
        found["FAISS, share of best five found"] = float(np.mean([len({*a} & {*b}) / len(a) for a, b in pairs]))
    return found


def described_walk(frames: int) -> np.ndarray:
    """Return the small net's descriptors of a synthetic walk, minus their mean."""
    from lmdb_build.walk.sequence import Walk, write_walk
    from loopclosure.places.frames import read_bgr
    from netspec.inspect.features.shipped import small

    describe = small()
    with TemporaryDirectory(prefix="growth-") as folder:
        walk = Walk(frames=frames, width=160, height=120, laps=1)
        rows = np.array([describe(read_bgr(image)) for image in write_walk(Path(folder) / "walk", walk)])
    return rows - rows.mean(axis=0)


def perturbed(base: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return ``count`` descriptors between neighbors of ``base`` (N, D), moved by half the difference of any two."""
    share, at = random.random((count, 1), np.float32), random.integers(0, len(base) - 1, count)
    return (1 - share) * base[at] + share * base[at + 1] + 0.5 * _differences(base, count, random)


def _differences(base: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    i, j = random.integers(0, len(base), (2, count))
    return base[i] - base[j]


def measure(sizes: Sequence[int]) -> list[Found]:
    """Measure each number of frames, one after the other."""
    return [{"frames": size, **_in_a_process(size)} for size in sizes]


def table(rows: Sequence[Found]) -> str:
    """Return the measurements as a Markdown table."""
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([_number(row[column]) for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _in_a_process(size: int) -> Found:
    words = [sys.executable, "-m", "benchmarks.growth", str(size)]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # FAISS would use all cores
    finished = subprocess.run(words, cwd=ROOT, env=one_thread, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        raise SpecError(f"{size} frames: {last}")
    return json.loads(finished.stdout.splitlines()[-1])


def _peak() -> float:
    """Return the peak memory of this process in MB; NaN if the system does not report it."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1e3


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 or value == int(value) else f"{value:.3g}"


def main() -> None:
    """Measure one size and print the result as JSON."""
    print(json.dumps({**frames(int(sys.argv[1])), "memory, MB": _peak()}))


if __name__ == "__main__":
    main()
