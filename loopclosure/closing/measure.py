"""Reads a table of loops and measures the relative pose of the two frames of each loop."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.length import measured, neighbors
from loopclosure.closing.relative import METRIC, ROTATION_ONLY, Relative, View, relative_view
from loopclosure.csv_file import safe_cell
from loopclosure.detector.export import relative_pose
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.places.depth import read_depths
from loopclosure.places.frames import DEPTH_PER_M, read_bgr
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.trajectory import pieces
from loopclosure.progress import Progress, silent
from netspec.files.kinds import nearest_existing

# The points from which a pose is measured. Images are not reduced: a larger image gives a better pose.
CHECK = GeometricCheck(max_features=1000, most_side=1_000_000)
LEAST_BASELINE_M = 0.1  # with less between two cameras, the true direction is as uncertain as the true poses
SCALED, OFF_SCALE = 12, 1.25  # frames that show the scale of the depth; the ratio that is said
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
    count = len(frames)
    loops = []
    for line, row in loop_rows(path, "the loops.csv that loopclosure detect writes"):
        query, match = (_frame(row, end, numbers, count, path, line) for end in ("query", "match"))
        if query == match:
            raise InputError(f"joins frame {query} with itself", path, line, 1)
        loops.append(Loop(query, match))
    return loops


def loop_rows(path: Path, expected: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the line and the cells, by the name of their column, of each row of a table of loops.

    Raises InputError (file:line) for another file, and for a row that was cut.
    """
    if not path.exists():
        raise InputError(f"no such file; expected {expected}{nearest_existing(path)}", path)
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as stream:
            reader = csv.DictReader(stream)
            if {"query_id", "match_id"} - set(reader.fieldnames or ()):
                raise InputError(f"is not a table of loops; expected {expected}", path)
            for row in reader:
                if None in row or None in row.values():
                    raise InputError("has another number of cells than the first line", path, reader.line_num, 1)
                yield reader.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot be read; expected {expected}", path) from error


def measure(
    sequence: ImageSequence,
    loops: Sequence[Loop],
    camera: Intrinsics,
    odometry: np.ndarray | None = None,
    progress: Progress = silent,
) -> list[Loop]:
    """Measure the pose of each loop's query in the frame of its match, from depth if it is available.

    ``odometry`` (N, 7), NaN where not known, gives the lengths that depth does not give. A loop of an image that cannot
    be read is not measured.
    """
    ends = {end for loop in loops for end in (loop.query, loop.match)}
    drives = None if odometry is None else pieces(odometry, sequence.stamps)
    near = {} if odometry is None or drives is None else {end: neighbors(odometry, end, drives) for end in ends}
    wanted = ends.union(number for each in near.values() for number, _ in each)
    # A video is read once, in order.
    of_video = {} if sequence.paths else {i: view_of(CHECK, camera, image) for i, image, _ in sequence.frames(wanted)}

    @lru_cache(KEPT_VIEWS)
    def view(frame: int) -> View:
        if not sequence.paths:
            return of_video[frame]
        depth = None if sequence.depths is None else sequence.depths[frame]
        return view_of(CHECK, camera, read_bgr(sequence.paths[frame]), depth, sequence.depth_per_m)

    def around(frame: int) -> Iterator[tuple[View, float]]:
        for number, length in near.get(frame, ()):
            with suppress(InputError):
                yield view(number), length

    found = []
    for loop in progress(loops, "measuring loops", len(loops)):
        try:
            match, query = view(loop.match), view(loop.query)
        except InputError:
            found.append(Loop(loop.query, loop.match))
            continue
        relative = measured((match, query), (around(loop.match), around(loop.query)), CHECK.matches)
        found.append(Loop(loop.query, loop.match, relative))
    return found


def depth_scale_said(sequence: ImageSequence, camera: Intrinsics) -> str:
    """Say that steps measured with depth have a constant ratio, not 1, to those of the odometry; else empty."""
    path, depths = sequence.odometry, sequence.depths
    if path is None or depths is None or not sequence.paths:
        return ""
    drives, ratios = pieces(path, sequence.stamps), []
    frames = [frame for frame, depth in enumerate(depths) if depth is not None and np.isfinite(path[frame]).all()]
    for frame in [frames[i] for i in np.linspace(0, len(frames) - 1, SCALED).round().astype(int)] if frames else []:
        depth = depths[frame]
        for other, length in neighbors(path, frame, drives)[:1]:
            with suppress(InputError):
                view = view_of(CHECK, camera, read_bgr(sequence.paths[frame]), depth, sequence.depth_per_m)
                beside = view_of(CHECK, camera, read_bgr(sequence.paths[other]))
                step = relative_view(view, beside, CHECK.matches(view.local, beside.local))
                if step is not None and step.kind == METRIC:
                    ratios.append(float(np.linalg.norm(step.pose[:3])) / length)
    ratio = float(np.median(ratios)) if len(ratios) >= SCALED // 2 else 1.0
    spread = float(np.median(np.abs(np.array(ratios) - ratio))) if ratios else 0.0
    if 1 / OFF_SCALE < ratio < OFF_SCALE or spread > 0.1 * ratio:
        return ""
    scale = float(f"{sequence.depth_per_m * ratio:.2g}")
    return f"lengths by depth are {ratio:.3g} times those by the odometry; is it depth-scale={scale:.10g}?"


def cells(relative: Relative) -> list[object]:
    """Return the cells of ``loopclosure.detector.export.RELATIVE`` in loops.csv; empty where nothing is known."""
    length = float(np.linalg.norm(relative.pose[:3]))
    toward = [f"{value:.6f}" for value in relative.pose[:3] / length] if length > 0 else [""] * 3
    known, (shift, turn) = relative.kind == METRIC, relative.sigmas
    metric = (f"{length:.6f}", f"{shift:.4g}") if known else ("", "")
    entries = " ".join(f"{value:.6g}" for value in relative.covariance[np.triu_indices(6)])
    rotation = [f"{value:.6f}" for value in relative.pose[3:]]
    agreeing = [metric[0], relative.inliers, metric[1], f"{np.rad2deg(turn):.4g}"]
    return [relative.kind, *rotation, *toward, *agreeing, relative.length_by, entries]


def errors_said(loops: Sequence[Loop], poses: np.ndarray) -> str:
    """Return a sentence with the median errors of measured loops by the true poses (N, 7); empty if none is known."""
    turns, directions, shifts = [], [], []
    for loop in loops:
        both = poses[[loop.match, loop.query]]
        if loop.relative is None or not np.isfinite(both).all():
            continue
        true, found = relative_pose(*both), loop.relative.pose
        turn = Rotation.from_quat(true[3:]).inv() * Rotation.from_quat(found[3:])
        turns.append(np.rad2deg(turn.magnitude()))
        far = np.linalg.norm(true[:3])
        if loop.relative.kind == METRIC:
            shifts.append(np.linalg.norm(found[:3] - true[:3]))
        if loop.relative.kind != ROTATION_ONLY and far > LEAST_BASELINE_M:
            cosine = found[:3] @ true[:3] / far / np.linalg.norm(found[:3])
            directions.append(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
    if not turns:
        return ""
    parts = [f"rotation {np.median(turns):.2g} degrees"]
    parts += [f"direction {np.median(directions):.2g} degrees (of {len(directions)})"] if directions else []
    parts += [f"translation {np.median(shifts):.2g} m (of {len(shifts)})"] if shifts else []
    return f"median errors of the {len(turns)} measured loops, by the true poses: {', '.join(parts)}"


def view_of(
    check: GeometricCheck,
    camera: Intrinsics,
    image: np.ndarray,
    depth: Path | None = None,
    depth_per_m: float = DEPTH_PER_M,
) -> View:
    """Return the points of an image (H, W, 3) uint8 BGR, with the file of its depth if there is one.

    Raises InputError if the depth cannot be read.
    """
    local = check.describe(image)
    depths = None if depth is None else read_depths(depth, local.points, local.size, depth_per_m)
    return View(local, camera.of_size(*local.size), depths)


def _frame(row: dict[str, str], end: str, numbers: dict[str, int], count: int, path: Path, line: int) -> int:
    name, number = row.get(f"{end}_name", ""), row[f"{end}_id"]
    if name in numbers:
        return numbers[name]
    if name:
        raise InputError(f'no selected image of the sequence has the name "{name}"', path, line, 1)
    return whole_number(number, count, path, line)


def whole_number(text: str, count: int, path: Path, line: int) -> int:
    """Return the number of a frame, of ``count``. Raises InputError (file:line) for anything else."""
    if not re.fullmatch("[0-9]{1,12}", text) or int(text) >= count:
        raise InputError(f'no frame has the number "{text:.40}"; there are {count}', path, line, 1)
    return int(text)
