"""Measures how cost grows with layers or frames of a sequence.

Each size is measured in a separate process, ``python -m benchmarks.growth KIND SIZE``, to get its peak memory. Times
are CPU times of one thread, which other load hardly changes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from netspec.errors import SpecError

Found = dict[str, float]  # a column of the table and its value

ROOT = Path(__file__).resolve().parents[1]
BLOCK = """
layer {{ name: "conv{i}" type: "Convolution" bottom: "x{i}" top: "c{i}"
  convolution_param {{ num_output: 4 kernel_size: 3 pad: 1 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "bn{i}" type: "BatchNorm" bottom: "c{i}" top: "c{i}" }}
layer {{ name: "scale{i}" type: "Scale" bottom: "c{i}" top: "c{i}" scale_param {{ bias_term: true }} }}
layer {{ name: "sum{i}" type: "Eltwise" bottom: "x{i}" bottom: "c{i}" top: "x{k}" }}
layer {{ name: "relu{i}" type: "ReLU" bottom: "x{k}" top: "x{k}" }}"""
DATA = 'layer { name: "data" type: "Input" top: "x0" input_param { shape { dim: 1 dim: 4 dim: 8 dim: 8 } } }'
LOSS = """
layer {{ name: "loss" type: "Reduction" bottom: "x{i}" top: "loss" loss_weight: 1 }}"""
WALK = 300  # frames; more descriptors are made by perturbing theirs
COMPONENTS = 256  # of a descriptor
QUERIES, AT_ONCE = 50, 4096  # frames searched for, and added at a time
SAME_PLACE = 0.3  # distance of two descriptors of one place, as a share of that of two places


def residual_net(layers: int) -> str:
    """Return the prototxt of a residual net with small feature maps and about this many layers, without splits."""
    blocks = max(1, (layers - 2) // 5)
    return DATA + "".join(BLOCK.format(i=i, k=i + 1) for i in range(blocks)) + LOSS.format(i=blocks)


def layers(size: int) -> Found:
    """Read and build a residual net of about ``size`` layers, and run it forward and backward."""
    import torch

    from netspec.graph.filter import with_state
    from netspec.graph.options import BuildOptions
    from netspec.net.build import build_net
    from netspec.proto.schema import TRAIN
    from netspec.proto.text import parse_net_text

    torch.set_num_threads(1)

    def build(size: int) -> Any:
        net, source = parse_net_text(residual_net(size), "growth.prototxt")
        return build_net(with_state(net, TRAIN), source, BuildOptions(seed=0, accumulate_in_place=True))

    def run(net: Any) -> None:
        net.forward_loss(x0=torch.ones(1, 4, 8, 8))[0].backward()

    run(build(7))  # warm-up: costs of the first net of a process
    start = time.process_time()
    net = build(size)
    built = time.process_time() - start
    count, passed = len(net.plan.nodes), _least(lambda: run(net), 3)
    return {
        "building, s": built,
        "building, ms per layer": 1e3 * built / count,
        "pass, s": passed,
        "pass, ms per layer": 1e3 * passed / count,
    }


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


@dataclass(frozen=True)
class Kind:
    """A quantity that grows: its unit, the usual sizes, and the function that measures one size."""

    unit: str
    sizes: tuple[int, ...]
    measure: Callable[[int], Found]


KINDS: Mapping[str, Kind] = {
    "layers": Kind("layers", (125, 250, 500, 1000, 2000), layers),
    "frames": Kind("frames", (1000, 10_000, 100_000, 1_000_000), frames),
}


def measure(name: str, sizes: Sequence[int]) -> list[Found]:
    """Measure a kind at these sizes, one after the other."""
    return [{KINDS[name].unit: size, **_in_a_process(name, size)} for size in sizes]


def table(rows: Sequence[Found]) -> str:
    """Return the measurements as a Markdown table."""
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([_number(row[column]) for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(path: str, rows: Sequence[Found]) -> None:
    """Draw each column against the size; the suffix of ``path`` is .png or .svg."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator

    unit, *columns = rows[0]
    across = min(3, len(columns))
    down = -(-len(columns) // across)
    figure = Figure(figsize=(3.4 * across, 2.6 * down), layout="constrained")
    for k, column in enumerate(columns):
        axes = figure.add_subplot(down, across, k + 1)
        sizes, values = [row[unit] for row in rows], [row[column] for row in rows]
        axes.plot(sizes, values, "o-")
        axes.set(xscale="log", xlabel=unit, title=column)
        axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes], rotation=30)
        axes.xaxis.set_minor_locator(NullLocator())
        if max(values) > 10 * min(values) > 0:
            axes.set_yscale("log")
        else:
            axes.set_ylim(0, 1.08 * max(values))
        axes.title.set_fontsize(8)
        axes.grid(alpha=0.3)
    figure.savefig(path)


def _in_a_process(name: str, size: int) -> Found:
    words = [sys.executable, "-m", "benchmarks.growth", name, str(size)]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # FAISS would use all cores
    finished = subprocess.run(words, cwd=ROOT, env=one_thread, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        raise SpecError(f"{name} {size}: {last}")
    return json.loads(finished.stdout.splitlines()[-1])


def _least(run: Callable[[], object], rounds: int) -> float:
    """Return the smallest CPU time of a run, in seconds."""
    spent = []
    for _ in range(rounds):
        start = time.process_time()
        run()
        spent.append(time.process_time() - start)
    return min(spent)


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
    name, size = sys.argv[1], int(sys.argv[2])
    print(json.dumps({**KINDS[name].measure(size), "memory, MB": _peak()}))


if __name__ == "__main__":
    main()
