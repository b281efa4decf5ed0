"""Reads runs of a camera, from CSV tables of frames or from folders of images."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError
from loopclosure.places.frames import image_paths
from netspec.files.image_list import IMAGE_ENDINGS
from netspec.files.kinds import unreadable

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Runs:
    """M images of several runs of a camera.

    names   M paths, relative to the root folder
    tracks  (M,) the number of the run that the image belongs to
    stamps  (M,) the position of the image in its run: seconds, or its number
    """

    names: list[str]
    tracks: Indices
    stamps: NDArray[np.float64]


def index_runs(index: Path, root: Path, track: str, time: str) -> Runs:
    """Read runs from a CSV table of frames. Column ``track`` names the run, column ``time`` the position in it."""
    rows, (column,) = read_table(index, 1)
    tracks = [cell(index, line, row, track) for line, row in rows]
    return Runs(
        names=[relative(index.parent / row[column], root) for _, row in rows],
        tracks=np.unique(tracks, return_inverse=True)[1],
        stamps=np.array([as_number(index, line, row, time) for line, row in rows]),
    )


def folder_runs(folders: Sequence[Path], root: Path, step: float = 1.0) -> Runs:
    """Make a run from each folder or list of images. The stamps of successive images differ by ``step``."""
    runs = [[relative(path, root) for path in image_paths(folder)] for folder in folders]
    return Runs(
        names=[name for run in runs for name in run],
        tracks=np.repeat(np.arange(len(runs)), [len(run) for run in runs]),
        stamps=np.concatenate([np.arange(len(run), dtype=np.float64) * step for run in runs]),
    )


def join_runs(parts: Sequence[Runs]) -> Runs:
    """Return the runs of all parts. The names of all parts must be relative to the same root."""
    ends = np.cumsum([len(np.unique(part.tracks)) for part in parts])
    return Runs(
        names=[name for part in parts for name in part.names],
        tracks=np.concatenate([part.tracks + start for part, start in zip(parts, [0, *ends], strict=False)]),
        stamps=np.concatenate([part.stamps for part in parts]),
    )


def read_table(path: Path, images: int) -> tuple[list[tuple[int, dict[str, str]]], list[str]]:
    """Return the rows of a CSV table with their line numbers, and the names of the columns that have image names.

    There must be as many such columns as ``images`` says. Raises InputError.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, restval="")
            rows = [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise InputError(unreadable(path, error, "a CSV table with a header line"), path) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError("is not a table; expected a CSV table with a header line", path) from error
    if not rows:
        raise InputError("has no row below its header line", path)
    columns = [name for name, text in rows[0][1].items() if str(text).lower().endswith(IMAGE_ENDINGS)]
    if len(columns) != images:
        found = f"{len(columns)} {'column' if len(columns) == 1 else 'columns'}"
        message = f"has {found} of image names ({', '.join(columns) or 'none'}); expected {images}"
        raise InputError(message, path, 1, 1)
    return rows, columns


def cell(path: Path, line: int, row: dict[str, str], column: str) -> str:
    """Return the text in a column of a row. Raises InputError if it is empty, or if there is no such column."""
    if column not in row:
        raise InputError(f'has no column "{column}"; there are: {", ".join(map(str, row))}', path, 1, 1)
    if not row[column]:
        raise InputError(f"column {column} is empty", path, line, 1)
    return row[column]


def as_number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    """Return the number in a column of a row. Raises InputError if it is not a number."""
    text = cell(path, line, row, column)
    try:
        return float(text)
    except ValueError:
        raise InputError(f'expected a number in column {column}, found "{text}"', path, line, 1) from None


def relative(path: Path, root: Path) -> str:
    """Return the path relative to the root, with slashes. Raises InputError if it is not below the root."""
    try:
        return path.resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        raise InputError(f"is not below the root folder {root}; give another --root", path) from None
