"""The frames that a detector stores, and the arrays in which a file holds them."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from tempfile import TemporaryFile
from threading import Lock
from typing import Any

import numpy as np

from loopclosure.descriptors.similarity import METRICS
from loopclosure.detector.verification import LocalFeatures
from loopclosure.errors import InputError
from loopclosure.index.exact import ExactIndex
from loopclosure.index.index import Index
from loopclosure.stored import check_array

FIRST_CAPACITY = 256  # frames; doubled when full
NO_ROWS = np.zeros((0, 0), np.float32)


@dataclass(frozen=True)
class Points:
    """The local features of N frames, concatenated, in arrays that may be on disk.

    sizes        (N, 2) width and height of the images
    ends         (N,) the index after the last point of each frame
    points       (P, 2) float32, x and y in pixels
    descriptors  (P, 128) uint8, of SIFT
    """

    sizes: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    descriptors: np.ndarray

    def part(self, frame: int) -> slice:
        """Return where the points of one frame are among all points."""
        return slice(int(self.ends[frame - 1]) if frame else 0, int(self.ends[frame]))

    def of(self, frame: int) -> LocalFeatures:
        """Return the local features of one frame."""
        part = self.part(frame)
        width, height = self.sizes[frame].tolist()
        return LocalFeatures(self.points[part], self.descriptors[part], (width, height))


class Local:
    """The local features of all frames: of sessions read from files, and of frames added since."""

    def __init__(self) -> None:
        self._parts: list[Points | list[LocalFeatures]] = []
        self._starts: list[int] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, frame: int) -> LocalFeatures:
        number = bisect_right(self._starts, frame) - 1
        part, frame = self._parts[number], frame - self._starts[number]
        return part.of(frame) if isinstance(part, Points) else part[frame]

    def append(self, features: LocalFeatures) -> None:
        """Add the features of the next frame."""
        if not self._parts or isinstance(self._parts[-1], Points):
            self._begin([])
        part = self._parts[-1]
        assert isinstance(part, list)
        part.append(features)
        self._count += 1

    def extend(self, points: Points) -> None:
        """Add the features of many frames."""
        if len(points.ends):
            self._begin(points)
            self._count += len(points.ends)

    def _begin(self, part: Points | list[LocalFeatures]) -> None:
        self._parts.append(part)
        self._starts.append(self._count)


POINT_BYTES = 2 * 4 + 128  # x and y, and a descriptor


class LocalOnDisk:
    """Like :class:`Local`, in a temporary file; the frames read last, at most ``in_memory``, are in memory too."""

    def __init__(self, in_memory: int) -> None:
        self._file = TemporaryFile(prefix="loopclosure-")  # noqa: SIM115  removed when it is closed, with this object
        self._ends = array("q")  # in bytes
        self._sizes = array("l")
        self._lock = Lock()  # several threads may read
        self._read = lru_cache(in_memory)(self._from_file)

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, frame: int) -> LocalFeatures:
        return self._read(frame)

    def _from_file(self, frame: int) -> LocalFeatures:
        begin = self._ends[frame - 1] if frame else 0
        count = (self._ends[frame] - begin) // POINT_BYTES
        with self._lock:
            self._file.seek(begin)
            data = self._file.read(count * POINT_BYTES)
        points = np.frombuffer(data, np.float32, 2 * count).reshape(-1, 2)
        descriptors = np.frombuffer(data, np.uint8, offset=8 * count).reshape(-1, 128)
        return LocalFeatures(points, descriptors, (self._sizes[2 * frame], self._sizes[2 * frame + 1]))

    def append(self, features: LocalFeatures) -> None:
        """Add the features of the next frame."""
        data = features.points.astype(np.float32).tobytes() + features.descriptors.tobytes()
        begin = self._ends[-1] if self._ends else 0
        with self._lock:
            self._file.seek(begin)
            self._file.write(data)
        self._ends.append(begin + len(data))
        self._sizes.extend(features.size)

    def extend(self, points: Points) -> None:
        """Add the features of many frames."""
        for frame in range(len(points.ends)):
            self.append(points.of(frame))


@dataclass
class Frames:
    """All frames so far, ``count`` of them, in arrays that double when full.

    The index has the descriptors (views, D) of the frames that are candidates for the next frame. ``waiting`` has the
    descriptors of the other frames, which are too recent.
    """

    index: Index
    views: int
    metric: str = METRICS[0]
    count: int = 0
    stamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    odometry: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    waiting: list[np.ndarray] = field(default_factory=list)
    local: Local | LocalOnDisk = field(default_factory=Local)
    drive: ExactIndex = field(init=False)

    def __post_init__(self) -> None:
        self.begin_drive()

    def begin_drive(self) -> None:
        """Begin a drive: the frames before it are compared by the index alone."""
        self.drive = ExactIndex(self.metric)

    def append(
        self, row: np.ndarray, stamp: float | None, pose: np.ndarray | None, odometry: np.ndarray | None = None
    ) -> None:
        """Add a frame with a descriptor (views, D)."""
        if self.count == len(self.stamps):
            room = np.empty((max(FIRST_CAPACITY, self.count), 7))
            self.stamps, self.poses = np.append(self.stamps, room[:, 0]), np.concatenate([self.poses, room])
            self.odometry = np.concatenate([self.odometry, room])
        self.stamps[self.count] = np.nan if stamp is None else stamp
        self.poses[self.count] = np.nan if pose is None else pose
        self.odometry[self.count] = np.nan if odometry is None else odometry
        self.waiting.append(row)
        if not isinstance(self.index, ExactIndex):
            self.drive.add(row)
        self.count += 1

    @property
    def settled(self) -> int:
        """The number of frames in the index; they are the first ones."""
        return self.count - len(self.waiting)

    def settle(self, end: int) -> None:
        """Move the frames before ``end`` into the index."""
        new = self.waiting[: max(0, end - self.settled)]
        if new:
            self.index.add(np.concatenate(new))
            del self.waiting[: len(new)]

    def score(self, other: np.ndarray, row: np.ndarray) -> float:
        """Return the score of two descriptors (views, D), computed directly."""
        if self.metric == "cosine":
            return float((other @ row.T).max())
        return -float(np.linalg.norm(other[:, None] - row, axis=-1).min())

    def most_similar(self, row: np.ndarray, k: int, waiting: bool) -> list[tuple[int, float]]:
        """Return the ``k`` frames most similar to a descriptor (views, D), best first, and their scores.

        waiting  search the frames that are not yet in the index too
        """
        found = [self.index.search(view, k * self.views) for view in row if self.settled]
        return self._best(found, row, k, waiting)

    def search_all(self, row: np.ndarray, k: int) -> tuple[list[tuple[int, float]], np.ndarray]:
        """Return the ``k`` most similar frames of the index, and the scores (N,) of all frames, NaN where not known.

        Only the exact index compares all descriptors. With another one, the scores of this drive's frames, whose
        descriptors are kept beside it, and of the most similar ones are known.
        """
        if not isinstance(self.index, ExactIndex):
            best, scores = self.most_similar(row, k, False), np.full(self.count, np.nan, np.float32)
            scores[[number for number, _ in best]] = [score for _, score in best]
            own = [self.drive.search_all(view, 1)[2] for view in row]
            if len(self.drive):
                scores[-len(self.drive) // self.views :] = np.max(own, axis=0).reshape(-1, self.views).max(axis=1)
            return best, scores
        found = [self.index.search_all(view, k * self.views) for view in row]
        of_views = np.max([scores for *_, scores in found], axis=0).reshape(-1, self.views)
        waiting = [self.score(each, row) for each in self.waiting]
        scores = np.append(of_views.max(axis=1, initial=-np.inf), waiting).astype(np.float32)
        return self._best([best for *best, _ in found], row, k, False), scores

    def _best(self, found: Sequence[Sequence[np.ndarray]], row: np.ndarray, k: int, waiting: bool) -> list[Any]:
        best: dict[int, float] = {}  # the search can return several views of one frame
        for numbers, values in found:
            for number, value in zip(numbers.tolist(), values.tolist(), strict=True):
                best[number // self.views] = max(value, best.get(number // self.views, value))
        if waiting:
            best |= {self.settled + i: self.score(each, row) for i, each in enumerate(self.waiting)}
        return sorted(best.items(), key=lambda pair: (-pair[1], pair[0]))[:k]

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return the descriptors (stop - start, views D) of some frames, as a copy."""
        if start >= stop:
            return NO_ROWS
        views, known = self.views, min(stop, self.settled)
        parts = [self.index.rows(start * views, known * views)] if start < known else []
        parts += self.waiting[max(0, start - self.settled) : max(0, stop - self.settled)]
        return np.concatenate(parts).reshape(stop - start, -1)

    def steps(self, sessions: Sequence[int]) -> tuple[list[float], np.ndarray]:
        """Return the score of each frame with the one before it in its session, and the last descriptor."""
        rows = self.rows(0, self.count).reshape(self.count, self.views, -1) if self.count else NO_ROWS
        scores = [self.score(rows[i - 1], rows[i]) for i in range(len(rows)) if i not in sessions]
        return scores, rows[-1] if self.count else NO_ROWS

    def arrays(self, checked: bool, start: int = 0) -> dict[str, np.ndarray]:
        """Return the arrays of the frames from ``start`` on, without descriptors; ``checked``: with local features."""
        found = {"stamps": self.stamps[start : self.count], "poses": self.poses[start : self.count]}
        if np.isfinite(odometry := self.odometry[start : self.count]).any():
            found["odometry"] = odometry
        if checked:
            local = [self.local[i] for i in range(start, self.count)]
            found["sizes"] = np.array([f.size for f in local], np.int64).reshape(-1, 2)
            found["points_of_frame"] = np.array([len(f.points) for f in local], np.int64)
            found["points"] = np.concatenate([np.zeros((0, 2), np.float32), *(f.points for f in local)])
            found["descriptors"] = np.concatenate([np.zeros((0, 128), np.uint8), *(f.descriptors for f in local)])
        return found

    def take(self, arrays: Mapping[str, Any], points: Points | None) -> None:
        """Add the frames of a file, except their descriptors, which the caller adds to the index or to ``waiting``.

        Raises ValueError or LookupError if the arrays do not fit together.
        """
        count = len(arrays["stamps"])
        check_array(arrays, "stamps", "f", (count,), finite=False)
        check_array(arrays, "poses", "f", (count, 7), finite=False)
        self.stamps = np.concatenate([self.stamps[: self.count], arrays["stamps"]])
        self.poses = np.concatenate([self.poses[: self.count], arrays["poses"]])
        odometry = arrays.get("odometry", np.full((count, 7), np.nan))  # absent without odometry
        check_array({"odometry": odometry}, "odometry", "f", (count, 7), finite=False)
        self.odometry = np.concatenate([self.odometry[: self.count], odometry])
        if points is not None:
            self.local.extend(points)
        self.count += count


def points_of(arrays: Mapping[str, Any], count: int, finite: bool = True) -> Points:
    """Return the points of ``count`` frames of a file. ``finite``: read all points and check that they are finite.

    Raises ValueError if the arrays do not fit together.
    """
    check_array(arrays, "points_of_frame", "i", (count,))
    if min(arrays["points_of_frame"], default=0) < 0:
        raise ValueError('"points_of_frame" has a negative number')
    ends = np.cumsum(arrays["points_of_frame"])
    points = int(ends[-1]) if count else 0
    check_array(arrays, "points", "f", (points, 2), finite)
    check_array(arrays, "descriptors", "u", (points, 128), finite)
    sizes = arrays.get("sizes", np.tile(LocalFeatures.size, (count, 1)))  # older files have no sizes
    check_array({"sizes": sizes}, "sizes", "i", (count, 2))
    return Points(sizes, ends, arrays["points"], arrays["descriptors"])


def checked_pose(pose: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    """Check a pose, and return it with a rotation of unit length, (7,)."""
    if pose is None:
        return None
    values = np.array(pose, np.float64).reshape(-1)
    if len(values) != 7 or not np.all(np.isfinite(values)) or not np.any(values[3:]):
        raise InputError(f"a pose is {values}; expected tx ty tz qx qy qz qw")
    values[3:] /= np.linalg.norm(values[3:])
    return values
