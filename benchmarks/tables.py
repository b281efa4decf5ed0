"""Measures loopclosure's methods on five data sets: ``tools/bench tables``.

The figures are written to ``results``, and ``tools/bench pages`` writes them into the pages. Figures that a run does
not measure stay as they are.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import results
from benchmarks.cache import Cache
from benchmarks.pages import RESULTS
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.evaluation import Outcome, judge
from loopclosure.methods.base import MethodContext
from loopclosure.methods.named import make_method
from loopclosure.places.datasets import DataSet, load_folder, load_place_pairs, load_sequence
from loopclosure.places.frames import Selection
from loopclosure.places.sequences import read_sequence
from loopclosure.places.truth import Exclusion

SETS = ("fr1_rpy", "corridor_loop", "walk", "ESSEX3IN1", "SPED")
PAIRS = SETS[3:]
WALK = 900_001  # as lmdb-build walk --seed 900
TITLES = {
    "fr1_rpy": "fr1_rpy, last 40 %",
    "corridor_loop": "corridor_loop",
    "walk": "synthetic walk",
    "ESSEX3IN1": "ESSEX3IN1",
    "SPED": "SPED",
}
# By the names in the tables. The words are those of images of an office tower, for every set.
METHODS = {
    "gray thumbnails, 32x24": "thumbnails",
    "bag of SIFT words, tf-idf": "bow",
    "FAB-MAP 2.0, 2,000 words of an office tower": "fabmap",
    "the net": "features",
    "the small net": "describe:small",
    "SeqSLAM on the net": "seqslam+features",
    "auto, on the net": "auto+features",
}
TABLES = {
    "accuracy": [name for name in METHODS if not name.startswith("auto")],
    "recall": [name for name in METHODS if any(word in name for word in ("FAB-MAP", "net"))],
}
AUTO = "auto, on the net"


def walked(work: Path, walk: Walk) -> Path:
    """Return the folder of a synthetic walk in ``work``."""
    folder = work / f"walk_{walk.seed}_{walk.width}"
    if not (folder / "rgb.txt").exists():
        for _ in write_walk(folder, walk):
            pass
    return folder


def data_set(name: str, data: Path, work: Path) -> DataSet:
    """Load one of the data sets."""
    if name == "fr1_rpy":
        sequence = read_sequence(data / "tum_fr1" / "rgbd_dataset_freiburg1_rpy", "tum")
        return load_sequence(sequence, Selection(start="60%"), Exclusion(seconds=3.0))
    if name == "corridor_loop":
        return load_folder(data / name / "samples", data / name / "samples_GT.bmp")
    if name == "walk":
        sequence = read_sequence(walked(work, Walk(400, 160, 120, laps=3, seed=WALK)), "tum")
        return load_sequence(sequence, exclusion=Exclusion(seconds=10.0))
    return load_place_pairs(data / "place_pairs" / {"SPED": "SPED_Test"}.get(name, name))


def tower_images(folder: Path) -> list[Path]:
    """Return the images of the office tower in the order of its index."""
    with (folder / "index.csv").open(encoding="utf-8") as table:
        return [folder / row["image"] for row in csv.DictReader(table)]


def measure(
    data: Path,
    work: Path,
    sets: Sequence[str],
    methods: Sequence[str],
    say: Callable[[str], None],
    words: Sequence[str],
) -> None:
    """Measure methods on data sets and update the figures; ``words`` are the arguments of the command."""
    work.mkdir(parents=True, exist_ok=True)
    figures = {kind: _stored_rows(kind) for kind in TABLES}
    needed = [METHODS[name] for name in methods or METHODS]
    tower = tower_images(data / "ie_tower")[::4] if {"bow", "fabmap"} & set(needed) else []
    for name in sets or SETS:
        held = data_set(name, data, work)
        cache = Cache(work / "kept" / f"{name}.pickle")
        images = [*held.queries.paths, *(() if held.references is None else held.references.paths)]
        if any("features" in method for method in needed):
            np.savez(work / f"{name}.npz", features=cache.descriptors(images), names=[str(image) for image in images])
        context = MethodContext(held.exclude_frames, pairs=cache.pairs)
        for label in methods or METHODS:
            if name in PAIRS and (label not in TABLES["accuracy"] or "SeqSLAM" in label):
                continue
            method = METHODS[label]
            if "features" in method:
                settings = {"features.file": str(work / f"{name}.npz")}
            else:
                settings = {f"{method}.model": str(work / "words.npz")} if method in ("bow", "fabmap") else {}
            outcome = judge(label, make_method(method, context, settings), held, tower)
            for kind, value in _figures(label, outcome, name):
                say(f"{name}, {label}, {kind}: {value}")
                figures[kind][label][TITLES[name]] = value
        cache.save()
        for kind, rows in figures.items():
            results.write(RESULTS / f"{kind}.json", list(rows.values()), words)


def _stored_rows(kind: str) -> dict[str, dict[str, Any]]:
    """Return the stored rows of a table by method, in the order of ``TABLES``; a figure never measured is None."""
    path = RESULTS / f"{kind}.json"
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.is_file() else []
    found = {row["method"]: row for row in rows}
    columns = [TITLES[name] for name in (SETS if kind == "accuracy" else SETS[:3])]
    return {name: found.get(name, {"method": name, **dict.fromkeys(columns)}) for name in TABLES[kind]}


def _figures(label: str, outcome: Outcome, name: str) -> Iterator[tuple[str, float | str]]:
    if label in TABLES["accuracy"]:
        found = outcome.recall_at[1] if name in PAIRS else outcome.pairs.average_precision
        yield "accuracy", round(float(found), 3)
    if name not in PAIRS and label in TABLES["recall"]:
        angles = [judged.best for judged in (outcome.rule, outcome.wide) if judged is not None]
        if label == AUTO:
            texts = [f"{z.recall[-1]:.3f} at {z.precision[-1]:.3f}" if len(z.recall) else "none" for z in angles]
        else:
            texts = [f"{z.recall_at_full_precision:.3f}" for z in angles]
        yield "recall", texts[0] + "".join(f" ({text})" for text in texts[1:])
