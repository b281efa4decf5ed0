"""The HTML page of ``loopclosure detect``: a summary, a picture of the loops, and sample pairs of images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from loopclosure.detector.decision import LoopResult
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.report.page import Kind, Pair, rendered, side_by_side, spread
from loopclosure.report.plots import FOUND, MISSED, STYLE, longest_axes
from netspec.files.figures import COLORS, GRID, png
from netspec.files.whole_file import write_whole

BEST, WORST, REJECTED = 4, 3, 3  # number of pairs shown
IN_WORDS = {"below threshold": "not similar enough", "not verified": "too few points agree"}
PARTS = 30  # of a drive; the pairs shown differ by at least one part
OF_PATH = "The path from its known poses; green lines join the two frames of each loop."
OF_ODOMETRY = "The path by the odometry, which drifts; green lines join the two frames of each loop."
OF_FRAMES = (
    "Each green dot is a loop: a frame (across) and the earlier frame of the same place (upward). "
    "Gray dots are the best matches that were not accepted. A way driven again makes a rising line."
)


def write_drive(
    path: Path, results: Sequence[LoopResult], reasons: Sequence[str], recording: ImageSequence | None, command: str
) -> None:
    """Write the page; ``recording`` is None for a camera, because its images were not kept."""
    loops = sum(1 for result in results if result)
    paths = () if recording is None else ((recording.poses, OF_PATH), (recording.odometry, OF_ODOMETRY))
    known = [(path, caption) for path, caption in paths if path is not None and np.isfinite(path[:, 0]).sum() > 1]
    picture, caption = (_path(known[0][0], results), known[0][1]) if known else (_dots(results), OF_FRAMES)
    text = rendered(
        "drive.html.jinja",
        title=verdict(loops, len(results)),
        lead="" if recording is None else str(recording.source),
        picture=png(picture),
        caption=caption,
        kinds=[] if recording is None else _kinds(results, recording),
        reasons=reasons,
        command=command,
    )
    write_whole(path, text, "backslashreplace")


def verdict(loops: int, frames: int) -> str:
    """Return a sentence that summarizes the result."""
    if not loops:
        return f"None of {frames} frames shows a place that was certainly seen before"
    return f"{loops} of {frames} frames show a place that was seen before"


def _dots(results: Sequence[LoopResult]) -> Figure:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6, 3.6), layout="constrained")
        axis = figure.subplots()
        for accepted, color, size in ((False, MISSED, 2), (True, FOUND, 5)):
            some = [(r.query, r.candidates[0][0]) for r in results if bool(r) is accepted and r.candidates]
            axis.plot(*np.array(some).reshape(-1, 2).T, ".", color=color, markersize=size)
        axis.set_xlabel("frame")
        axis.set_ylabel("earlier frame")
        first, last = (results[0].query, results[-1].query) if results else (0, 1)
        axis.set_xlim(first - 0.5, last + 0.5)
        axis.set_ylim(-0.5, last + 0.5)
        axis.grid(color=GRID, linewidth=0.5)
        return figure


def _path(poses: np.ndarray, results: Sequence[LoopResult]) -> Figure:
    """Draw the path in the plane of the two axes along which it is longest."""
    across, labels = longest_axes(poses[:, :3])
    places = poses[:, across]
    ends = np.array(
        [pair for pair in _loops_in_drive(results) if np.all(np.isfinite(places[list(pair)]))], int
    ).reshape(-1, 2)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6, 4), layout="constrained")
        axis = figure.subplots()
        axis.plot(*places.T, color=COLORS[0], lw=1)
        axis.add_collection(LineCollection(list(places[ends]), colors=FOUND, linewidths=0.8, alpha=0.7))
        axis.plot(*places[ends].reshape(-1, 2).T, ".", color=FOUND, markersize=3)
        axis.set_aspect("equal")
        axis.set_xlabel(labels[0])
        axis.set_ylabel(labels[1])
        return figure


def _loops_in_drive(results: Sequence[LoopResult]) -> list[tuple[int, int]]:
    """Return the loops as pairs of frames (query, match) of this drive. Loops to frames of earlier runs are omitted."""
    first = results[0].query if results else 0
    ends = [(r.query - first, r.match - first) for r in results if r.match is not None]
    return [pair for pair in ends if pair[1] >= 0]


def _kinds(results: Sequence[LoopResult], recording: ImageSequence) -> list[Kind]:
    """Return the loops with the highest and the lowest scores, and the rejected pairs with the highest scores."""
    first = results[0].query if results else 0
    there = [r for r in results if r.candidates and r.candidates[0][0] >= first]
    loops = sorted((r for r in there if r), key=lambda r: -r.score)
    best = _spread(loops, BEST, len(results))
    taken = {r.query for r in best}
    worst = _spread([r for r in reversed(loops) if r.query not in taken], WORST, len(results))
    rejected = _spread(sorted((r for r in there if not r), key=lambda r: -r.score), REJECTED, len(results))
    groups = {
        ("found", "loops with the highest scores"): best,
        ("found", "loops with the lowest scores"): worst,
        ("rejected", "not accepted, with the highest scores"): rejected,
    }
    wanted = {end - first for some in groups.values() for r in some for end in (r.query, _match(r))}
    images = _read(recording, wanted)
    kinds = []
    for (name, title), some in groups.items():
        seen = [r for r in some if {r.query - first, _match(r) - first} <= set(images)]
        kinds.append(Kind(name, title, [_pair(r, images, first) for r in seen]))
    return kinds


def _read(recording: ImageSequence, wanted: set[int]) -> dict[int, np.ndarray]:
    """Return the images of frames. With features from a file, images that cannot be read are met only here."""
    images: dict[int, np.ndarray] = {}
    with suppress(InputError):  # none can be read
        images.update((number, image) for number, image, _ in recording.frames(wanted))
    return images


def _match(result: LoopResult) -> int:
    return result.candidates[0][0] if result.match is None else result.match


def _pair(result: LoopResult, images: dict[int, np.ndarray], first: int) -> Pair:
    match = _match(result)
    why = result.reason or IN_WORDS.get(result.verdict, result.verdict)
    picture = side_by_side(images[result.query - first], images[match - first])
    return Pair(picture, f"{result.query} and {match}{', ' if why else ''}{why}")


def _spread(results: Sequence[LoopResult], count: int, frames: int) -> list[LoopResult]:
    return [results[i] for i in spread([result.query for result in results], count, frames / PARTS)]
