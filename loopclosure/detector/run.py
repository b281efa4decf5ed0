"""The detector on a whole sequence of images or a video, with any descriptor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from loopclosure.descriptors.feature_file import Features
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.visitor import Visitor
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.same_place import same_place
from loopclosure.progress import Progress, silent


@dataclass(frozen=True)
class _Frame:
    """The stamp of a frame in seconds, its true pose and its odometry (7,), None where not known."""

    stamp: float | None
    pose: np.ndarray | None
    odometry: np.ndarray | None

    @classmethod
    def of(cls, sequence: ImageSequence, i: int, stamp: float | None) -> _Frame:
        """Return what is known of a frame of a sequence."""
        rows = [None if path is None else path[i] for path in (sequence.poses, sequence.odometry)]
        return cls(stamp, *(row if row is not None and np.isfinite(row).all() else None for row in rows))


def run_detector(
    detector: LoopDetector | Visitor,
    sequence: ImageSequence,
    features: Features | None = None,
    progress: Progress = silent,
) -> list[LoopResult]:
    """Add every frame of a sequence; ``features``, with a descriptor of each image, replace ``describe``.

    Images that cannot be read are left out: the frames are then those of ``sequence.readable()``.
    """
    results = list[LoopResult]()
    for row, image, frame in _described(sequence, features, detector.check is not None, progress):
        if row is None:
            assert image is not None
            loops = detector.add(image, frame.stamp, frame.pose, frame.odometry)
        else:
            loops = detector.add_descriptor(row, frame.stamp, frame.pose, image, frame.odometry)
        put(results, detector.newest, loops)
    return results


def put(results: list[LoopResult], newest: LoopResult, loops: Sequence[LoopResult]) -> None:
    """Append the result of the newest frame, and replace those of the frames before it that are ``loops`` now."""
    results.append(newest)
    for loop in loops:
        if (back := newest.query - loop.query) < len(results):
            results[-1 - back] = loop


def remember_all(
    detector: LoopDetector, sequence: ImageSequence, features: Features | None = None, progress: Progress = silent
) -> None:
    """Add all frames as :func:`run_detector` does, without looking for loops; see :meth:`LoopDetector.remember`."""
    for row, image, frame in _described(sequence, features, detector.check is not None, progress):
        detector.remember(row, frame.stamp, frame.pose, image, frame.odometry)


def _described(
    sequence: ImageSequence, features: Features | None, checked: bool, progress: Progress
) -> Iterator[tuple[np.ndarray | None, np.ndarray | None, _Frame]]:
    """Yield the descriptor and the image of each frame, None for what is not needed, and what else is known of it.

    ``checked``: read the images for a geometric check, even if their descriptors are known.
    """
    rows = None
    if features is not None:
        if not sequence.paths:
            raise InputError("the frames of a video have no names to find features by; use --describe", features.path)
        rows = features.rows_of(sequence.paths)
    if rows is not None and not checked:
        for i, row in enumerate(progress(rows, "frames", len(rows))):
            yield row, None, _Frame.of(sequence, i, None if sequence.stamps is None else float(sequence.stamps[i]))
        return
    for i, image, stamp in progress(sequence.frames(), "frames", len(sequence)):
        yield None if rows is None else rows[i], image, _Frame.of(sequence, i, stamp)


def verdicts_said(results: Sequence[LoopResult]) -> str:
    """Return a sentence that counts the verdicts and gives the best score."""
    verdicts = [result.verdict for result in results]
    words = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts))
    scores = [result.score for result in results if result.candidates]
    return f"frames: {words}" + (f"; best score {max(scores) + 0.0:.4g}" if scores else "")


def judged_by_poses(detector: LoopDetector) -> str:
    """Return a sentence that counts the accepted loops which are the same place by the paper's rule.

    Only loops with two known poses count.
    """
    poses = detector.poses
    ends = np.array([(loop.query, loop.match) for loop in detector.loops], int).reshape(-1, 2)
    known = ends[np.all(np.isfinite(poses[ends]), axis=(1, 2))]
    right = int(np.count_nonzero(same_place(*poses[known.T])))
    return f"{right} of {len(known)} loops are the same place by their poses (2 m, 15 degrees)"
