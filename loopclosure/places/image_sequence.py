"""The one type for frames: data sets, detectors, methods and lists of pairs have them as such sequences."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.frames import DEPTH_PER_M, Selection, read_bgr, video_frames
from loopclosure.places.intrinsics import Intrinsics
from netspec.files.image_list import ImageList

MOST_NAMES = 10  # of unreadable images in a message


@dataclass(frozen=True)
class ImageSequence(ImageList):
    """N frames in order: image files, or frames of a video.

    paths       the N files; empty for a video
    names       N names: the paths relative to ``source``, or "frame NUMBER" for a video
    stamps      (N,) seconds, None if not known
    source      the folder, list or video that was read
    numbers     (N,) positions of the frames in the source, counted from 0; None: all of its frames
    poses       (N, 7) the camera's true poses in the world, tx ty tz qx qy qz qw, NaN where not known; None without any
    odometry    (N, 7) the camera's path as the robot measured it, which drifts, NaN where not known; None without it
    camera      None if not known
    depths      N files of depth (16 bits), None for an image without one; or None
    depth_per_m the value of a meter in them
    doubts      sentences about poses that look wrong, and about files that could not be used
    pose_fault  why the sequence's own poses could not be read
    unreadable  indices of the images that ``frames`` could not read
    """

    source: Path = Path()
    numbers: np.ndarray | None = None
    poses: np.ndarray | None = None
    odometry: np.ndarray | None = None
    camera: Intrinsics | None = None
    depths: tuple[Path | None, ...] | None = None
    depth_per_m: float = DEPTH_PER_M
    pose_fault: InputError | None = None
    unreadable: list[int] = field(default_factory=list)

    @classmethod
    def of_files(cls, paths: Sequence[Path]) -> ImageSequence:
        """Make a sequence of image files, without stamps, poses or a camera."""
        return cls(tuple(paths), tuple(path.name for path in paths))

    @classmethod
    def of_video(cls, source: Path, count: int) -> ImageSequence:
        """Return the first ``count`` frames of a video."""
        return cls((), tuple(f"frame {number}" for number in range(count)), source=source)

    @property
    def name(self) -> str:
        """The name of the source."""
        return self.source.resolve().name

    @property
    def folder(self) -> Path:
        """The folder that the names are relative to."""
        return self.source if self.source.is_dir() else self.source.parent

    @property
    def known(self) -> np.ndarray:
        """Whether each frame has a pose: (N,) bool."""
        if self.poses is None:
            return np.zeros(len(self), bool)
        return np.all(np.isfinite(self.poses), axis=1)

    def remarks(self) -> Iterator[str]:
        """Yield a sentence for all that looks wrong, for a command that needs no poses."""
        yield from self.doubts
        if self.pose_fault is not None:
            yield f"{self.pose_fault}; continued without poses"

    def taken(self, selection: Selection) -> ImageSequence:
        """Return the selected frames. The selection counts all frames, with or without a pose."""
        return self.at(selection.numbers(len(self)))

    def at(self, indices: Sequence[int] | np.ndarray) -> ImageSequence:
        """Return the frames with these indices."""
        indices = np.asarray(indices, int)
        return replace(
            self,
            paths=tuple(self.paths[i] for i in indices) if self.paths else (),
            names=tuple(self.names[i] for i in indices),
            stamps=None if self.stamps is None else self.stamps[indices],
            numbers=indices if self.numbers is None else self.numbers[indices],
            poses=None if self.poses is None else self.poses[indices],
            odometry=None if self.odometry is None else self.odometry[indices],
            depths=None if self.depths is None else tuple(self.depths[i] for i in indices),
            unreadable=[],
        )

    def with_poses(self) -> ImageSequence:
        """Return the frames that have a pose. Raises InputError if none has."""
        if self.pose_fault is not None:
            raise self.pose_fault
        if self.poses is None and self.odometry is not None:
            raise InputError(
                "has odometry, but no true poses; odometry drifts, so it does not tell which frames show one place. If "
                "it is exact enough, name its topic in pose-topic=",
                self.source,
            )
        if self.poses is None:
            raise InputError("has no poses; expected groundtruth.txt, or the name of a file of poses", self.source)
        known = np.flatnonzero(self.known)
        if not len(known):
            raise InputError(f"none of its {len(self)} images has a pose", self.source)
        return self.at(known)

    def known_poses(self) -> np.ndarray:
        """Return the poses (N, 7) of a sequence in which every frame has one; see :meth:`with_poses`."""
        assert self.poses is not None
        return self.poses

    def with_files(self) -> ImageSequence:
        """Return the sequence itself. Raises InputError for the first missing image."""
        for path in self.paths:
            if not os.path.isfile(path):
                raise InputError("no such image, though the sequence lists it", path)
        return self

    def frames(self, wanted: Collection[int] | None = None) -> Iterator[tuple[int, np.ndarray, float | None]]:
        """Yield the index, the image (H, W, 3) uint8 BGR and the stamp of each frame, or of those ``wanted``.

        An image that cannot be read is left out and added to ``unreadable``. Raises InputError if none can be read, or
        if a video ends too soon.
        """
        chosen = range(len(self)) if wanted is None else sorted(wanted)
        if not self.paths:
            yield from self._video_frames(chosen)
            return
        for i in chosen:
            try:
                image = read_bgr(self.paths[i])
            except InputError:
                if i not in self.unreadable:
                    self.unreadable.append(i)
                if len(self.unreadable) == len(self):
                    raise
                continue
            yield i, image, None if self.stamps is None else float(self.stamps[i])

    def _video_frames(self, chosen: Sequence[int]) -> Iterator[tuple[int, np.ndarray, float | None]]:
        """Read a video once, up to the last of the ``chosen`` frames, which are in order."""
        wanted = [(i if self.numbers is None else int(self.numbers[i]), i) for i in chosen]
        if not wanted:
            return
        count = 0
        for number, (seconds, image) in enumerate(video_frames(self.source)):
            count += 1
            if number == wanted[0][0]:
                index = wanted.pop(0)[1]
                yield index, image, seconds if self.stamps is None else float(self.stamps[index])
                if not wanted:
                    return
        message = f"ends after {count} frames, though frame {wanted[0][0]} is wanted and it says that it has it"
        raise InputError(f"{message}; write {self.source},stop={count}", self.source)

    def left_out(self) -> str:
        """Return a sentence that lists the images that could not be read; empty if all could."""
        names = [self.names[i] for i in self.unreadable]
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        listed = ", ".join(names[:MOST_NAMES])
        text = f"{len(names)} of {len(self)} images cannot be read and are left out: {listed}{more}"
        return text if names else ""

    def readable(self) -> ImageSequence:
        """Return the sequence without the images that could not be read."""
        if not self.unreadable:
            return self
        unreadable = set(self.unreadable)
        return self.at([i for i in range(len(self)) if i not in unreadable])
