"""Writes recordings for the Rerun viewer (rerun.io): images, scores, paths and loops."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.closing.close import Closed
from loopclosure.detector.decision import LoopResult
from loopclosure.errors import InputError
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import Progress, silent
from netspec.files.opencv import cv2
from netspec.files.whole_file import whole_file

WIDTH = 320  # largest width of an image in pixels
BEFORE, AFTER, TRUE = [230, 120, 30], [40, 110, 220], [150, 150, 150]  # RGB colors of paths
USED, FALSE = [40, 160, 60], [210, 40, 40]  # RGB colors of loops


def check_rerun() -> None:
    """Raise InputError if Rerun's SDK is not installed."""
    if find_spec("rerun") is None:
        raise InputError("rerun is not installed; pip install netspec-caffe[rerun]")


class RerunFile:
    """Writes a drive to a Rerun file, frame by frame."""

    def __init__(self, path: Path) -> None:
        self._rr = import_module("rerun")  # optional
        self._stream: Any = self._rr.RecordingStream("loopclosure")
        self._stream.save(str(path))

    def frame(self, number: int, stamp: float | None, jpeg: bytes, result: LoopResult | None = None) -> None:
        """Write an image and the detector's result for it. It becomes the current frame."""
        self._stream.set_time("frame", sequence=number)
        if stamp is not None and np.isfinite(stamp):
            self._stream.set_time("seconds", duration=stamp)
        self.image("image", jpeg)
        if result is not None and result.candidates:
            self._stream.log("score", self._rr.Scalars(float(result.score)))
        if result:
            text = f"frame {result.query_id} shows the place of frame {result.accepted}"
            self._stream.log("loop", self._rr.TextLog(text))

    def image(self, name: str, jpeg: bytes) -> None:
        """Write an image of the current frame."""
        self._stream.log(name, self._rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))

    def point(self, name: str, position: np.ndarray, color: list[int]) -> None:
        """Write a position (3,) at the current frame, unless it is not known (NaN)."""
        if np.all(np.isfinite(position)):
            self._stream.log(name, self._rr.Points3D([position], colors=[color], radii=[0.05]))

    def lines(self, name: str, lines: Sequence[np.ndarray], color: list[int]) -> None:
        """Write lines, (n, 3) each, that are visible at all frames."""
        if len(lines):
            self._stream.log(name, self._rr.LineStrips3D(list(lines), colors=[color] * len(lines)), static=True)

    def close(self) -> None:
        """Write everything to disk and close the file."""
        self._stream.flush()
        self._stream.disconnect()


def small_jpeg(image: np.ndarray) -> bytes:
    """Return an image (H, W, 3) BGR as a JPEG that is at most 320 pixels wide."""
    factor = min(1.0, WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else image
    return cv2.imencode(".jpg", small)[1].tobytes()


@contextmanager
def rerun_file(path: str | Path) -> Iterator[RerunFile]:
    """Yield a recording that appears at ``path`` once it is complete."""
    with whole_file(path) as unfinished:
        made = RerunFile(unfinished)
        try:
            yield made
        finally:
            made.close()


def write_detected(
    path: Path, recording: ImageSequence, results: Sequence[LoopResult], progress: Progress = silent
) -> None:
    """Write the frames of a recording with their results and, if poses are known, the path and its loops."""
    matched: dict[int | None, bytes] = {}
    wanted = {result.accepted for result in results if result}
    poses = None if recording.poses is None else recording.poses[:, :3]
    first = results[0].query_id if results else 0
    with rerun_file(path) as made:
        if poses is not None:
            known = poses[np.all(np.isfinite(poses), axis=1)]
            made.lines("path/before", [known], BEFORE)
            ends = [(r.query_id - first, r.accepted - first) for r in results if r.accepted is not None]
            loops = [poses[list(pair)] for pair in ends if min(pair) >= 0]
            made.lines("path/loops", [loop for loop in loops if np.all(np.isfinite(loop))], USED)
        frames = progress(recording.frames(), "rerun", len(recording))
        for (i, image, stamp), result in zip(frames, results, strict=True):
            jpeg = small_jpeg(image)
            made.frame(result.query_id, stamp, jpeg, result)
            if result.query_id in wanted:
                matched[result.query_id] = jpeg
            if result.accepted in matched:
                made.image("match", matched[result.accepted])
            if poses is not None:
                made.point("path/camera", poses[i], BEFORE)


def write_closed_paths(path: Path, closed: Closed, frames: Iterator[tuple[int, float | None, np.ndarray]]) -> None:
    """Write the paths before and after closing the loops, and the true path; ``frames``: number, stamp, image."""
    before, after = closed.odometry[:, :3], closed.poses[:, :3]
    row = {int(frame): i for i, frame in enumerate(closed.frames)}
    with rerun_file(path) as made:
        made.lines("path/before", [before], BEFORE)
        made.lines("path/after", [after], AFTER)
        if closed.truth is not None:
            made.lines("path/true", [closed.truth[np.all(np.isfinite(closed.truth), axis=1), :3]], TRUE)
        for name, which, color in (("used", True, USED), ("contradicting", False, FALSE)):
            ends = [(e.first, e.second) for e, used in zip(closed.edges, closed.accepted, strict=True) if used == which]
            made.lines(f"path/loops/{name}", [after[list(pair)] for pair in ends], color)
        for number, stamp, image in frames:
            made.frame(number, stamp, small_jpeg(image))
            if number in row:
                made.point("path/camera/before", before[row[number]], BEFORE)
                made.point("path/camera/after", after[row[number]], AFTER)
