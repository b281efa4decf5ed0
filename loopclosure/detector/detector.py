"""Loop closure frame by frame, for use inside a running robot.

    detector = LoopDetector(describe, check=GeometricCheck())
    for image in camera:
        result = detector.add(image)
        if result.accepted is not None:
            ...  # this frame shows the same place as frame result.accepted

The search is exact: a product of all earlier descriptors with the new one. Its cost grows with the number of frames;
all other costs are constant: see :meth:`LoopDetector.add`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.descriptors.similarity import check_metric, squared_distances
from loopclosure.detector.verification import GeometricCheck, LocalFeatures
from loopclosure.errors import InputError
from netspec.errors import SpecError
from netspec.files.arrays import check_array, from_json, read_npz
from netspec.files.whole_file import whole_file

Describe = Callable[[np.ndarray], np.ndarray]
FIRST_CAPACITY = 256  # frames; doubled when full
LEAST_STEPS = 20  # from one frame to the next, before they give a threshold
FORMAT = 1  # of the file that save writes
SAVED = "a file that LoopDetector.save wrote"


@dataclass(frozen=True)
class LoopResult:
    """What adding one frame found. It is true if the frame closes a loop.

    query_id    the frame's number, from 0
    candidates  (id, score) of the best earlier frames, best first, higher = more similar
    accepted    the earlier frame that this one closes a loop with, or None
    verdict     why: "accepted", "no candidate", "too early" (to choose a threshold), "below threshold",
                "not consistent", "not verified"
    score       of the accepted frame, or of the best candidate; -inf without one
    inliers     inliers of the accepted candidate, or the most of any candidate tried; None if none was tried
    stamp       seconds, as given
    """

    query_id: int
    candidates: list[tuple[int, float]]
    accepted: int | None
    verdict: str
    score: float
    inliers: int | None = None
    stamp: float | None = None

    def __bool__(self) -> bool:
        return self.accepted is not None


@dataclass(frozen=True)
class DetectorSettings:
    """How loops are decided.

    metric              "euclidean" (score = minus the distance) or "cosine"
    views               how many views of an image a descriptor consists of, one after the other; the score of two
                        frames is that of their two most similar views
    exclude_recent      frames i - exclude_recent .. i - 1 are not candidates of frame i
    exclude_seconds     frames less than this many seconds old are not candidates either
    top_k               how many candidates are examined
    threshold           a candidate needs score >= threshold. None: with a geometric check, that decides alone; without
                        one a candidate must be as similar as consecutive frames so far are (their median)
    consistency         how many previous frames must have had a candidate that leads to this one, so that places
                        follow each other in time
    consistency_window  a candidate leads to one of the next frame that is at most this many frames away
    """

    metric: str = "euclidean"
    views: int = 1
    exclude_recent: int = 50
    exclude_seconds: float = 0.0
    top_k: int = 5
    threshold: float | None = None
    consistency: int = 0
    consistency_window: int = 5

    def __post_init__(self) -> None:
        check_metric(self.metric)
        for name, least in (
            ("views", 1),
            ("exclude_recent", 0),
            ("exclude_seconds", 0),
            ("top_k", 1),
            ("consistency", 0),
        ):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; expected {least} or more")
        if self.threshold is not None and np.isnan(self.threshold):
            raise InputError("threshold is nan; expected a number")
        if self.consistency_window < 0:
            raise InputError(f"consistency_window is {self.consistency_window}; expected 0 or more")


@dataclass
class _Frames:
    """All frames so far, in arrays that double when full: ``count`` of the rows (views, D) are in use."""

    count: int = 0
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0), np.float32))
    squares: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    stamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    local: list[LocalFeatures] = field(default_factory=list)

    def append(self, row: np.ndarray, stamp: float | None, pose: np.ndarray | None) -> None:
        if self.count == 0:
            self.rows = np.zeros((0, *row.shape), np.float32)
            self.squares = np.zeros((0, len(row)), np.float32)
        if self.count == len(self.rows):
            capacity = max(FIRST_CAPACITY, 2 * len(self.rows))
            for name in ("rows", "squares", "stamps", "poses"):
                old = getattr(self, name)
                new = np.empty((capacity, *old.shape[1:]), old.dtype)
                new[: self.count] = old[: self.count]
                setattr(self, name, new)
        self.rows[self.count] = row
        self.squares[self.count] = np.square(row).sum(1)
        self.stamps[self.count] = np.nan if stamp is None else stamp
        self.poses[self.count] = np.nan if pose is None else pose
        self.count += 1


class LoopDetector:
    """Finds loops frame by frame; ``loops`` holds the results that were accepted, in order."""

    def __init__(
        self,
        describe: Describe | None = None,
        settings: DetectorSettings | None = None,
        *,
        check: GeometricCheck | None = None,
        **changes: Any,
    ) -> None:
        """Make an empty detector.

        describe  image (H, W, 3) uint8 BGR -> descriptor (D,), the same D each time, or (views D,); None: use
                  ``add_descriptor``
        settings  or its fields by name: ``LoopDetector(describe, exclude_recent=50, top_k=5)``
        check     verifies candidates by their geometry, best first; None: no verification
        """
        given = asdict(settings or DetectorSettings())
        unknown = set(changes) - set(given)
        if unknown:
            raise TypeError(f"LoopDetector has no setting {', '.join(sorted(unknown))}; known: {', '.join(given)}")
        self.describe = describe
        self.settings = DetectorSettings(**{**given, **changes})
        self.check = check
        self.loops: list[LoopResult] = []
        self._frames = _Frames()
        self._steps: list[float] = []  # the score of each frame with the one before it
        self._runs: list[tuple[int, int]] = []  # of the last frame: candidate, consecutive frames that led to it

    def __len__(self) -> int:
        return self._frames.count

    @property
    def stamps(self) -> np.ndarray:
        """The stamps (N,) in seconds, NaN for frames without one."""
        return self._frames.stamps[: len(self)].copy()

    @property
    def poses(self) -> np.ndarray:
        """The poses (N, 7), tx ty tz qx qy qz qw, NaN for frames without one."""
        return self._frames.poses[: len(self)].copy()

    def add(
        self, image: np.ndarray, stamp: float | None = None, pose: Sequence[float] | np.ndarray | None = None
    ) -> LoopResult:
        """Add the next frame, (H, W, 3) uint8 BGR, and return whether it closes a loop.

        ``stamp`` in seconds; ``pose`` tx ty tz qx qy qz qw, camera-to-world: kept for the export, not used otherwise.

        The cost is that of ``describe`` and of one pass over all earlier descriptors, 4 D bytes per frame. Measured on
        one server core of the 2020s, without ``describe``: frame 1,000 takes 0.04 ms and frame 10,000 takes 0.2 ms with
        D = 128; 0.07 ms and 1.4 to 1.8 ms with D = 512, which no longer fits in the cache. If ``describe`` takes 2 ms
        or more, as nets and SIFT do, frame 10,000 costs at most twice as much as frame 1,000 (1.7 times at 2 ms, 1.3
        times at 5 ms, D = 512). With thumbnails of 768 pixels, which take 0.15 ms, it costs ten times as much: 2.2 ms.
        """
        if self.describe is None:
            raise InputError("this detector has no describe function; give one, or use add_descriptor")
        return self.add_descriptor(self.describe(image), stamp, pose, image)

    def add_descriptor(
        self,
        descriptor: Sequence[float] | np.ndarray,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        image: np.ndarray | None = None,
    ) -> LoopResult:
        """Add a frame whose descriptor (D,) is known already; ``image`` is needed only for a geometric check."""
        row = self._checked(descriptor, stamp)
        position = _checked_pose(pose)
        candidates = self._search(row, stamp)
        local = None
        if self.check is not None:
            if image is None:
                raise InputError("a geometric check needs the images")
            local = self.check.describe(image)
        result = self._decide(candidates, stamp, local)
        if len(self):
            self._steps.append(float(self._score(self._frames.rows[len(self) - 1 : len(self)], row)[0]))
        self._frames.append(row, stamp, position)
        if local is not None:
            self._frames.local.append(local)
        if result.accepted is not None:
            self.loops.append(result)
        return result

    @property
    def descriptors(self) -> np.ndarray:
        """The descriptors of all frames (N, views D), of unit length for cosine."""
        return self._frames.rows[: len(self)].reshape(len(self), -1).copy()

    def decided(self, loops: Sequence[LoopResult], threshold: float | None) -> None:
        """Take loops that were found with all frames in view, and a threshold for frames to come."""
        self.loops = list(loops)
        self.settings = replace(self.settings, threshold=None if threshold is None else float(threshold))

    def save(self, path: str | Path) -> None:
        """Write everything except ``describe`` to an .npz file, from which ``load`` continues."""
        count = len(self)
        frames = self._frames
        arrays = {name: getattr(frames, name)[:count] for name in ("stamps", "poses")}
        arrays["rows"] = frames.rows[:count].reshape(count, -1) if count else np.zeros((0, 0), np.float32)
        about = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "check": None if self.check is None else asdict(self.check),
            "runs": self._runs,
            "loops": [asdict(loop) for loop in self.loops],
        }
        if self.check is not None:
            arrays["sizes"] = np.array([local.size for local in frames.local], np.int64).reshape(-1, 2)
            arrays["points_of_frame"] = np.array([len(local.points) for local in frames.local], np.int64)
            arrays["points"] = np.concatenate([np.zeros((0, 2), np.float32), *(f.points for f in frames.local)])
            arrays["descriptors"] = np.concatenate(
                [np.zeros((0, 128), np.uint8), *(f.descriptors for f in frames.local)]
            )
        with whole_file(path) as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(cls, path: str | Path, describe: Describe | None = None) -> LoopDetector:
        """Read what ``save`` wrote; ``describe`` must be the one that the detector was made with.

        Raises InputError for any other file.
        """
        arrays = read_npz(path, SAVED)
        try:
            about = json.loads(str(arrays["about"]))
            if about["format"] != FORMAT:
                raise InputError(f"has format {about['format']}; this version reads {FORMAT}", path)
            check = None
            if about["check"] is not None:  # files from before a setting was added do not have it
                check = from_json(GeometricCheck, {**asdict(GeometricCheck()), **about["check"]})
            detector = cls(describe, from_json(DetectorSettings, about["settings"]), check=check)
            detector._frames = _frames(arrays, detector.settings.views, check is not None)
            rows = detector._frames.rows
            detector._steps = [float(detector._score(rows[i : i + 1], rows[i + 1])[0]) for i in range(len(rows) - 1)]
            detector._runs = [(int(a), int(b)) for a, b in about["runs"]]
            detector.loops = [_loop(found, len(detector)) for found in about["loops"]]
        except SpecError as fault:
            raise fault if fault.where else InputError(fault.message, path) from None
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"cannot be read ({reason}); expected {SAVED}", path) from None
        return detector

    def _checked(self, descriptor: Sequence[float] | np.ndarray, stamp: float | None) -> np.ndarray:
        """Return the row that is kept, (views, D): of unit length for cosine."""
        row = np.asarray(descriptor, np.float32).reshape(-1)
        frames, views = self._frames, self.settings.views
        if frames.count and len(row) != frames.rows[0].size:
            raise InputError(
                f"frame {frames.count} has a descriptor of {len(row)} dimensions, those before {frames.rows[0].size}"
            )
        if len(row) % views:
            raise InputError(f"frame {frames.count} has a descriptor of {len(row)} dimensions, not of {views} views")
        row = row.reshape(views, -1)
        if not row.size or not np.all(np.isfinite(row)):
            raise InputError(f"the descriptor of frame {frames.count} is empty or not finite")
        if self.settings.exclude_seconds and stamp is None:
            raise InputError(
                f"{self.settings.exclude_seconds:g} s are to be excluded, but frame {frames.count} has no stamp"
            )
        if stamp is not None and frames.count and stamp < frames.stamps[frames.count - 1]:
            raise InputError(f"frame {frames.count} has stamp {stamp:.6f}, earlier than the one before it")
        if self.settings.metric == "cosine":
            lengths = np.linalg.norm(row, axis=1, keepdims=True)
            row = row / np.where(lengths > 0, lengths, 1)
        return row

    def _score(self, rows: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the scores (k,) of frames (k, views, D) with one (views, D), computed directly."""
        if self.settings.metric == "cosine":
            return (rows @ row.T).reshape(len(rows), -1).max(axis=1)
        return -np.linalg.norm(rows[:, :, None] - row, axis=-1).reshape(len(rows), -1).min(axis=1)

    def _threshold(self) -> float | None:
        """Return the least score of a loop now; None if there are too few frames to tell."""
        if self.settings.threshold is not None:
            return self.settings.threshold
        if self.check is not None:
            return -np.inf
        return float(np.median(self._steps)) if len(self._steps) >= LEAST_STEPS else None

    def _search(self, row: np.ndarray, stamp: float | None) -> list[tuple[int, float]]:
        frames, settings = self._frames, self.settings
        end = max(0, frames.count - settings.exclude_recent)
        if settings.exclude_seconds and stamp is not None:
            end = min(end, int(np.searchsorted(frames.stamps[:end], stamp - settings.exclude_seconds, side="right")))
        if end == 0:
            return []
        rows = frames.rows[:end].reshape(-1, row.shape[1])
        if settings.metric == "euclidean":  # as the distances are ordered, so are their squares
            scores = -squared_distances(rows, row, frames.squares[:end].reshape(-1, 1), np.square(row).sum(1))
        else:
            scores = rows @ row.T
        scores = scores.reshape(end, -1).max(axis=1)
        k = min(settings.top_k, end)
        best = np.argpartition(scores, end - k)[end - k :]
        # The product is fast but rounds small distances badly: the few that are reported are computed directly.
        values = self._score(frames.rows[best], row) if settings.metric == "euclidean" else scores[best]
        order = np.lexsort((best, -values))
        return [(int(best[i]), float(values[i])) for i in order]

    def _decide(
        self, candidates: list[tuple[int, float]], stamp: float | None, local: LocalFeatures | None
    ) -> LoopResult:
        """Threshold, then consistency, then geometry; remember what can lead to the next frame."""
        settings = self.settings
        query = len(self)
        before = self._runs
        self._runs = []
        score = candidates[0][1] if candidates else float("-inf")

        def result(
            verdict: str, accepted: int | None = None, value: float = score, inliers: int | None = None
        ) -> LoopResult:
            return LoopResult(query, candidates, accepted, verdict, value, inliers, stamp)

        if not candidates:
            return result("no candidate")
        threshold = self._threshold()
        if threshold is None:
            return result("too early")
        likely = [(number, value) for number, value in candidates if value >= threshold]
        if not likely:
            return result("below threshold")
        for number, _ in likely:
            led = [run for other, run in before if abs(other - number) <= settings.consistency_window]
            self._runs.append((number, 1 + max(led, default=0)))
        steady = [pair for pair, (_, run) in zip(likely, self._runs, strict=True) if run > settings.consistency]
        if not steady:
            return result("not consistent")
        if self.check is None:
            return result("accepted", *steady[0])
        assert local is not None
        most = 0
        for number, value in steady:
            found = self.check.agreement(local, self._frames.local[number])
            inliers = self.check.enough(found)
            if inliers:
                return result("accepted", number, value, inliers)
            most = max(most, found.inliers)
        return result("not verified", inliers=most)


def _checked_pose(pose: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    if pose is None:
        return None
    values = np.asarray(pose, np.float64).reshape(-1)
    if len(values) != 7 or not np.all(np.isfinite(values)) or not np.any(values[3:]):
        raise InputError(f"a pose is {values}; expected tx ty tz qx qy qz qw")
    values = values.copy()
    values[3:] /= np.linalg.norm(values[3:])
    return values


def _frames(arrays: dict[str, np.ndarray], views: int, checked: bool) -> _Frames:
    """Return the frames of a saved detector. Raises ValueError where the arrays do not fit together."""
    count = len(arrays["rows"])
    check_array(arrays, "rows", "f", (count, arrays["rows"].size // count if count else 0))
    check_array(arrays, "stamps", "f", (count,), finite=False)
    check_array(arrays, "poses", "f", (count, 7), finite=False)
    rows = arrays["rows"].reshape(count, views, -1) if count else np.zeros((0, 0, 0), np.float32)
    frames = _Frames(count, rows, np.square(rows).sum(-1), arrays["stamps"], arrays["poses"])
    if checked:
        check_array(arrays, "points_of_frame", "i", (count,))
        ends = np.cumsum(arrays["points_of_frame"])
        points = int(ends[-1]) if count else 0
        if min(arrays["points_of_frame"], default=0) < 0:
            raise ValueError('"points_of_frame" has a negative number')
        check_array(arrays, "points", "f", (points, 2))
        check_array(arrays, "descriptors", "u", (points, 128))
        sizes = arrays.get("sizes", np.tile(LocalFeatures.size, (count, 1)))  # files from before it do not have it
        check_array({"sizes": sizes}, "sizes", "i", (count, 2))
        pieces = zip(np.split(arrays["points"], ends), np.split(arrays["descriptors"], ends), strict=True)
        frames.local = [
            LocalFeatures(*parts, (int(width), int(height)))
            for parts, (width, height) in zip(list(pieces)[:count], sizes, strict=True)
        ]
    return frames


def _loop(found: Any, count: int) -> LoopResult:
    """Return a saved loop of a detector of ``count`` frames. Raises ValueError, LookupError or TypeError."""
    candidates = [(int(number), float(score)) for number, score in found["candidates"]]
    loop = LoopResult(**{**found, "candidates": candidates})
    ends = (loop.query_id, loop.accepted)
    if not all(isinstance(end, int) and 0 <= end < count for end in ends) or not isinstance(loop.score, float):
        raise ValueError(f"a loop of frames {ends} among {count}")
    if not isinstance(loop.inliers, int | None) or not isinstance(loop.stamp, float | int | None):
        raise ValueError(f"a loop with {loop.inliers!r:.20} inliers at {loop.stamp!r:.20} s")
    return loop
