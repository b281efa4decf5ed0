"""How cost grows: with layers, the batch, pairs in a database, frames of a sequence, places of FAB-MAP, workers.

Each size is measured in a process of its own, ``python -m benchmarks.growth KIND SIZE``, so that its peak of memory is
its own. Times are those that the process computed, in one thread, which other load hardly changes; only those of
workers are times of the clock.
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
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
TRAINED = "small/siamese_resnet27_256"
DIMENSIONS = 256
QUERIES, SINGLE = 500, 50  # frames searched at once, and one by one
WORDS, WORDS_SEEN = 2000, 150
PAIRS = 2000  # that each number of workers converts


def residual_net(layers: int) -> str:
    """Return the prototxt of a residual net of small maps that has about so many layers, splits not counted."""
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

    run(build(7))  # what only the first net of a process pays for
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


def batch(size: int) -> Found:
    """Train the paper's small ResNet with ``size`` pairs per iteration."""
    import torch

    import netspec
    from benchmarks.case import training_case

    torch.set_num_threads(1)
    with training_case(TRAINED, size) as case:
        _forget_peak()
        solver = netspec.load_solver(case.solver, case.caffemodel, device="cpu")
        solver.step(1)
        spent = _least(lambda: solver.step(1), 3)
        solver.close()
    return {"iteration, s": spent, "iteration, ms per pair": 1e3 * spent / size}


def pairs(size: int) -> Found:
    """Write and read an LMDB of ``size`` pairs of images of 16x16."""
    from netspec.data.database import Writer, open_reader
    from netspec.data.datum import array_to_datum

    datum = array_to_datum(np.random.default_rng(0).integers(0, 256, (6, 16, 16), np.uint8), 1).SerializeToString()
    with TemporaryDirectory(prefix="growth-") as folder:
        path = str(Path(folder) / "pairs")
        start = time.process_time()
        with Writer(path) as writer:
            for k in range(size):
                writer.put(b"%08d" % k, datum)
        written = time.process_time() - start
        stored = sum(file.stat().st_size for file in Path(path).iterdir())
        start = time.process_time()
        reader = open_reader(path)
        opened = time.process_time() - start
        start = time.process_time()
        for k in range(size):
            reader.record(k)
        read = time.process_time() - start
    return {
        "opening, ms": 1e3 * opened,
        "writing, us per pair": 1e6 * written / size,
        "reading, us per pair": 1e6 * read / size,
        "file, bytes per pair": stored / size,
    }


def frames(size: int) -> Found:
    """Search the 10 most similar of ``size`` descriptors, for many frames at once and for one as a detector does."""
    from loopclosure.descriptors.similarity import top_k
    from loopclosure.detector.detector import LoopDetector

    rows, queries = descriptors(size)
    start = time.process_time()
    top_k(queries, rows, 10)
    found = {"top 10 of many frames, ms per frame": 1e3 * (time.process_time() - start) / len(queries)}
    detector = LoopDetector()
    for row in rows:
        detector.add_descriptor(row)
    start = time.process_time()
    for row in queries[:SINGLE]:
        detector.add_descriptor(row)
    found["detector, ms per frame"] = 1e3 * (time.process_time() - start) / SINGLE
    return found


def faiss(size: int) -> Found:
    """Search the same with FAISS: exactly, and with its graph of neighbors, HNSW."""
    faiss = import_module("faiss")

    faiss.omp_set_num_threads(1)
    rows, queries = descriptors(size)
    exact, graph = faiss.IndexFlatL2(DIMENSIONS), faiss.IndexHNSWFlat(DIMENSIONS, 32)
    exact.add(rows)
    start = time.process_time()
    graph.add(rows)
    added = time.process_time() - start
    start = time.process_time()
    right = exact.search(queries, 10)[1]
    searched = time.process_time() - start
    single = _least(lambda: [exact.search(row[None], 10) for row in queries[:SINGLE]], 1) / SINGLE
    start = time.process_time()
    nearly = [graph.search(row[None], 10)[1][0, 0] for row in queries]
    walked = time.process_time() - start
    return {
        "FAISS, exact, many frames, ms per frame": 1e3 * searched / len(queries),
        "FAISS, exact, ms per frame": 1e3 * single,
        "FAISS, HNSW, adding and searching, ms per frame": 1e3 * (added / size + walked / len(queries)),
        "FAISS, HNSW, share of best matches found": float(np.mean(right[:, 0] == nearly)),
    }


def descriptors(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit descriptors (size, 256) of places seen ten times each, and of some places seen again (500, 256)."""
    random = np.random.default_rng(0)
    places = random.standard_normal((max(1, size // 10), DIMENSIONS), np.float32)
    rows = np.repeat(places, 10, axis=0)[:size]
    rows = rows + 0.5 * random.standard_normal(rows.shape, np.float32)
    queries = places[random.integers(0, len(places), QUERIES)]
    queries = queries + 0.5 * random.standard_normal(queries.shape, np.float32)
    return tuple(x / np.linalg.norm(x, axis=1, keepdims=True) for x in (rows, queries))


def places(size: int) -> Found:
    """Locate images of 150 of 2,000 words among ``size`` places of FAB-MAP 2.0."""
    from loopclosure.words.chow_liu import learn_tree
    from loopclosure.words.fabmap import FabMap

    random = np.random.default_rng(0)

    def images(count: int) -> np.ndarray:
        return random.random((count, WORDS)) < WORDS_SEEN / WORDS

    training = images(500)
    online = FabMap(learn_tree(training, lower_bound=0), training)
    for seen in images(size):
        online.add(seen)
    queries = images(SINGLE)
    online.locate(queries[0])  # puts the last image on the map
    spent = _least(lambda: [online.locate(seen) for seen in queries], 1)
    return {"locating, ms per image": 1e3 * spent / len(queries)}


def workers(size: int) -> Found:
    """Convert pairs of PNG images of 640x480 to 224x224 with ``size`` processes."""
    import cv2

    from lmdb_build.databases import Options, pair_key, read_pairs, write_databases
    from lmdb_build.walk.sequence import Walk, write_walk

    with TemporaryDirectory(prefix="growth-") as root:
        folder = Path(root)
        names = []
        for number, image in enumerate(write_walk(folder / "walk", Walk(frames=20, width=640, height=480))):
            names.append(f"{number}.png")
            cv2.imwrite(str(folder / names[-1]), np.array(cv2.imread(str(image))))
        lines = [f"{names[k % len(names)]} {names[(k + 1) % len(names)]} 1" for k in range(PAIRS)]
        (folder / "pairs.txt").write_text("\n".join(lines) + "\n")
        entries = read_pairs(str(folder / "pairs.txt"))
        options = Options(size=(224, 224))
        start = time.perf_counter()
        write_databases(entries, root, [str(folder / "pairs")], options, pair_key, workers=size)
        spent = time.perf_counter() - start
        decoding = _least(lambda: [cv2.imread(str(folder / name)) for name in names], 3) / len(names)
    return {"pairs per second": PAIRS / spent, "decoding, ms per pair": 2e3 * decoding}


@dataclass(frozen=True)
class Kind:
    """Something that grows: what it is counted in, the usual sizes, and what measures one of them.

    ``beside`` measures the same with another program, in the environment of the yardsticks.
    """

    unit: str
    sizes: tuple[int, ...]
    measure: Callable[[int], Found]
    beside: str = ""


KINDS: Mapping[str, Kind] = {
    "layers": Kind("layers", (125, 250, 500, 1000, 2000), layers),
    "batch": Kind("pairs per iteration", (1, 2, 4, 8, 16, 32, 64), batch),
    "pairs": Kind("pairs in an LMDB", (1000, 10_000, 100_000, 1_000_000), pairs),
    "frames": Kind("frames", (1000, 10_000, 100_000), frames, "faiss"),
    "places": Kind("places", (1000, 3000, 10_000), places),
    "workers": Kind("workers", (1, 2), workers),
}
MEASURES = {**{name: kind.measure for name, kind in KINDS.items()}, "faiss": faiss}


def measure(name: str, sizes: Sequence[int], yardsticks: str | None) -> list[Found]:
    """Measure a kind at these sizes, one after the other; ``yardsticks`` is their Python, None leaves them out."""
    kind, found = KINDS[name], []
    for size in sizes:
        row = _in_a_process(sys.executable, name, size)
        if kind.beside and yardsticks:
            beside = _in_a_process(yardsticks, kind.beside, size)
            row |= {column: value for column, value in beside.items() if column not in row}
        found.append({kind.unit: size, **row})
    return found


def table(rows: Sequence[Found]) -> str:
    """Return what was measured as a table in Markdown."""
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([_number(row[column]) for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def draw(path: str, rows: Sequence[Found]) -> None:
    """Draw each column against the size; ``path`` ends with the kind of picture, .png or .svg."""
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


def _in_a_process(python: str, name: str, size: int) -> Found:
    words = [python, "-m", "benchmarks.growth", name, str(size)]
    finished = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = (finished.stderr.strip().splitlines() or ["no message"])[-1]
        raise SpecError(f"{name} {size}: {last}")
    return json.loads(finished.stdout.splitlines()[-1])


def _least(run: Callable[[], object], rounds: int) -> float:
    """Return the least seconds that the process computed for a run."""
    spent = []
    for _ in range(rounds):
        start = time.process_time()
        run()
        spent.append(time.process_time() - start)
    return min(spent)


def _peak() -> float:
    """Return the most memory that this process had at a time [MB]; NaN where the system does not tell."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1e3


def _forget_peak() -> None:
    """Give freed memory back to the system, and count its peak from now on, where the system can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 or value == int(value) else f"{value:.3g}"


def main() -> None:
    """Measure one size and print what was found, as JSON."""
    name, size = sys.argv[1], int(sys.argv[2])
    print(json.dumps({**MEASURES[name](size), "memory, MB": _peak()}))


if __name__ == "__main__":
    main()
