"""What a detector keeps of its frames, and the arrays that a file has of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loopclosure.detector.verification import LocalFeatures
from loopclosure.index.index import Index
from netspec.files.arrays import check_array

FIRST_CAPACITY = 256  # frames; doubled when full
NO_ROWS = np.zeros((0, 0), np.float32)


@dataclass
class Frames:
    """All frames so far, ``count`` of them, in arrays that double when full.

    An index has the descriptors (views, D) of those that are candidates of the next frame; ``waiting`` those of the
    others, which are too recent.
    """

    index: Index
    views: int
    count: int = 0
    stamps: np.ndarray = field(default_factory=lambda: np.zeros(0))
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    waiting: list[np.ndarray] = field(default_factory=list)
    local: list[LocalFeatures] = field(default_factory=list)

    def append(self, row: np.ndarray, stamp: float | None, pose: np.ndarray | None) -> None:
        """Add a frame with a descriptor (views, D)."""
        if self.count == len(self.stamps):
            capacity = max(FIRST_CAPACITY, 2 * self.count)
            for name in ("stamps", "poses"):
                old = getattr(self, name)
                new = np.empty((capacity, *old.shape[1:]), old.dtype)
                new[: self.count] = old
                setattr(self, name, new)
        self.stamps[self.count] = np.nan if stamp is None else stamp
        self.poses[self.count] = np.nan if pose is None else pose
        self.waiting.append(row)
        self.count += 1

    @property
    def settled(self) -> int:
        """How many frames, the first ones, the index has."""
        return self.count - len(self.waiting)

    def settle(self, end: int) -> None:
        """Have the index take the frames before ``end``."""
        new = self.waiting[: max(0, end - self.settled)]
        if new:
            self.index.add(np.concatenate(new))
            del self.waiting[: len(new)]

    def rows(self) -> np.ndarray:
        """Return all descriptors (count, views D)."""
        if not self.count:
            return NO_ROWS
        parts = [self.index.rows(0, self.settled * self.views)] if self.settled else []
        return np.concatenate([*parts, *self.waiting]).reshape(self.count, -1)

    def arrays(self, checked: bool) -> dict[str, np.ndarray]:
        """Return what a file has of the frames; ``checked``: their points too."""
        found = {"rows": self.rows(), "stamps": self.stamps[: self.count], "poses": self.poses[: self.count]}
        if checked:
            found["sizes"] = np.array([local.size for local in self.local], np.int64).reshape(-1, 2)
            found["points_of_frame"] = np.array([len(local.points) for local in self.local], np.int64)
            found["points"] = np.concatenate([np.zeros((0, 2), np.float32), *(f.points for f in self.local)])
            found["descriptors"] = np.concatenate([np.zeros((0, 128), np.uint8), *(f.descriptors for f in self.local)])
        return found

    def take(self, arrays: dict[str, np.ndarray], checked: bool) -> None:
        """Add the frames of a file. Raises ValueError or LookupError where its arrays do not fit together."""
        count = len(arrays["rows"])
        check_array(arrays, "rows", "f", (count, arrays["rows"].size // count if count else 0))
        check_array(arrays, "stamps", "f", (count,), finite=False)
        check_array(arrays, "poses", "f", (count, 7), finite=False)
        local = _local_features(arrays, count) if checked else []
        if not count:
            return
        rows = arrays["rows"].astype(np.float32).reshape(count, self.views, -1)
        if self.waiting and rows[0].shape != self.waiting[-1].shape:
            raise ValueError(f"descriptors of {rows[0].size} dimensions, those before {self.waiting[-1].size}")
        self.waiting.extend(rows)
        self.stamps = np.concatenate([self.stamps[: self.count], arrays["stamps"]])
        self.poses = np.concatenate([self.poses[: self.count], arrays["poses"]])
        self.local.extend(local)
        self.count += count


def _local_features(arrays: dict[str, np.ndarray], count: int) -> list[LocalFeatures]:
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
    return [
        LocalFeatures(*parts, (int(width), int(height)))
        for parts, (width, height) in zip(list(pieces)[:count], sizes, strict=True)
    ]
