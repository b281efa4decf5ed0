"""Images of a camera, run by run: from a table of frames, or from folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.table import as_number, cell, read_table, relative
from loopclosure.places.frames import image_paths

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Runs:
    """M images of several runs of a camera.

    names   M names below the root folder
    tracks  (M,) the number of the run
    stamps  (M,) the position along the run: seconds, or the image's number
    """

    names: list[str]
    tracks: Indices
    stamps: NDArray[np.float64]


def index_runs(index: Path, root: Path, track: str, time: str) -> Runs:
    """Read a CSV table of frames as runs: column ``track`` names the run, ``time`` is the position along it."""
    rows, (column,) = read_table(index, 1)
    tracks = [cell(index, line, row, track) for line, row in rows]
    return Runs(
        names=[relative(index.parent / row[column], root) for _, row in rows],
        tracks=np.unique(tracks, return_inverse=True)[1],
        stamps=np.array([as_number(index, line, row, time) for line, row in rows]),
    )


def folder_runs(folders: Sequence[Path], root: Path, step: float = 1.0) -> Runs:
    """Take each folder (or list) of images as a run, with images ``step`` apart."""
    runs = [[relative(path, root) for path in image_paths(folder)] for folder in folders]
    return Runs(
        names=[name for run in runs for name in run],
        tracks=np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
        stamps=np.concatenate([np.arange(len(run), dtype=np.float64) * step for run in runs]),
    )


def join_runs(parts: Sequence[Runs]) -> Runs:
    """Return the runs of all parts; their names are below the same root."""
    ends = np.cumsum([len(np.unique(part.tracks)) for part in parts])
    return Runs(
        names=[name for part in parts for name in part.names],
        tracks=np.concatenate([part.tracks + start for part, start in zip(parts, [0, *ends], strict=False)]),
        stamps=np.concatenate([part.stamps for part in parts]),
    )
