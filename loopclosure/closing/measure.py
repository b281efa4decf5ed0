"""Reads a table of loops and measures the relative pose of the two frames of each loop."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from loopclosure.closing.relative import LEAST_INLIERS, Relative, View, relative_view
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr, read_depth
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.progress import Progress, silent
from netspec.files.kinds import nearest_existing
from netspec.files.opencv import cv2
from netspec.files.whole_file import safe_cell

# Images are not reduced: a larger image gives a better pose.
CHECK = GeometricCheck(max_features=1000, min_inliers=LEAST_INLIERS, most_side=1_000_000)
KEPT_VIEWS = 500  # images with cached features


@dataclass(frozen=True)
class Loop:
    """Frame ``query`` shows the place of the earlier frame ``match``; ``relative`` is None if it was not measured."""

    query: int
    match: int
    relative: Relative | None = None


def read_loops(path: Path, frames: ImageSequence) -> list[Loop]:
    """Read the loops.csv of ``loopclosure detect``: loops between these frames.

    Frames are found by their names, or by their numbers if the table has no names. "frame K" is frame K of a video,
    whichever of its frames are selected. Raises InputError (file:line) for a frame that is not there.
    """
    names = frames.names
    numbers = {str(safe_cell(name)): number for number, name in enumerate(names)}
    numbers |= {name: number for number, name in enumerate(names)}
    if not any(name.startswith("frame ") for name in names):  # a video whose frames were extracted
        of_video = range(len(frames)) if frames.numbers is None else frames.numbers.tolist()
        numbers |= {f"frame {number}": index for index, number in enumerate(of_video)}
    loops = []
    if not path.exists():
        expected = "expected the loops.csv that loopclosure detect writes"
        raise InputError(f"no such file; {expected}{nearest_existing(path)}", path)
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as stream:
            reader = csv.DictReader(stream, restval="")
            missing = {"query_id", "match_id"} - set(reader.fieldnames or ())
            if missing:
                raise InputError("is not a table of loops; expected the loops.csv that loopclosure detect writes", path)
            for row in reader:
                query, match = (_frame(row, end, numbers, path, reader.line_num) for end in ("query", "match"))
                if query == match:
                    raise InputError(f"joins frame {query} with itself", path, reader.line_num, 1)
                loops.append(Loop(query, match))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("cannot be read; expected the loops.csv that loopclosure detect writes", path) from error
    return loops


def measure(
    sequence: ImageSequence, loops: Sequence[Loop], camera: Intrinsics, progress: Progress = silent
) -> list[Loop]:
    """Measure the pose of each loop's query in the frame of its match, from depth if it is available."""

    @lru_cache(KEPT_VIEWS)
    def view(frame: int) -> View:
        image = read_bgr(sequence.paths[frame])
        height, width = image.shape[:2]
        depths = sequence.depths
        file, depth = None if depths is None else depths[frame], None
        if file is not None:
            depth = cv2.resize(read_depth(file).astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
        return View(CHECK.describe(image), camera.of_size(width, height), depth)

    measured = []
    for loop in progress(loops, "measuring loops", len(loops)):
        match, query = view(loop.match), view(loop.query)
        matches = CHECK.matches(match.local, query.local)
        measured.append(Loop(loop.query, loop.match, relative_view(match, query, matches)))
    return measured


def _frame(row: dict[str, str], end: str, numbers: dict[str, int], path: Path, line: int) -> int:
    name, number = row.get(f"{end}_name", ""), row[f"{end}_id"]
    if name in numbers:
        return numbers[name]
    if name:
        raise InputError(f'no selected image of the sequence has the name "{name}"', path, line, 1)
    if not number.isdigit() or int(number) >= (count := len(set(numbers.values()))):
        raise InputError(f'no frame has the number "{number}"; there are {count}', path, line, 1)
    return int(number)
