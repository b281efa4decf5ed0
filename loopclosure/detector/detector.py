"""Loop closure frame by frame, for use inside a running robot.

    detector = LoopDetector(describe, check=GeometricCheck())
    for image in camera:
        result = detector.add(image)
        if result.accepted is not None:
            ...  # this frame shows the same place as frame result.accepted

An index (:mod:`loopclosure.index`) searches the earlier descriptors. The default index is exact: it multiplies all
earlier descriptors by the new one. The cost of the search grows with the number of frames; all other costs are
constant. See :meth:`LoopDetector.add`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.decision import DetectorSettings, LoopResult, Runs, result_of
from loopclosure.detector.frames import Frames, Local, LocalOnDisk, Points, points_of
from loopclosure.detector.verification import SURE, GeometricCheck, LocalFeatures
from loopclosure.errors import InputError
from loopclosure.index.index import Index, open_index
from loopclosure.stored import check_array, from_json
from netspec.errors import SpecError
from netspec.files.arrays import read_npz
from netspec.files.whole_file import whole_file

Describe = Callable[[np.ndarray], np.ndarray]
UNLIKE = 40  # frames, each of which is compared with an unlike one; then every second frame is, and so on
AMONG = 9  # frames of which the least similar one is unlike
LEAST_STEPS = 20  # scores of consecutive frames that are needed to choose a threshold
PART = "enough points agree, but only a part of those that match"
ALIKE = "places look alike: of most frames with enough points, only a part of those that match agrees"
VISIT = "the place was not left in between"
FORMAT = 1  # of the file that save writes
SAVED = "a file that LoopDetector.save wrote"


class LoopDetector:
    """Finds loops frame by frame; ``loops`` holds the results that were accepted, in order.

    Frames are numbered from 0. The newest frames are not candidates: those of the last ``exclude_seconds``, or the last
    ``exclude_recent`` frames (:class:`DetectorSettings`).

        >>> detector = LoopDetector(exclude_recent=1, threshold=-0.5)
        >>> for place in (0, 1, 2, 0):
        ...     result = detector.add_descriptor(numpy.eye(3)[place])
        >>> result.accepted, result.verdict
        (0, 'accepted')
    """

    def __init__(
        self,
        describe: Describe | None = None,
        settings: DetectorSettings | None = None,
        *,
        check: GeometricCheck | None = None,
        index: Index | str = "exact",
        in_memory: int | None = None,
        **changes: Any,
    ) -> None:
        """Make an empty detector.

        describe  image (H, W, 3) uint8 BGR -> descriptor (D,), the same D each time, or (views D,); None: use
                  ``add_descriptor``
        settings  the settings; single fields can also be given by name:
                  ``LoopDetector(describe, exclude_recent=50, top_k=5)``
        check     verifies candidates by their geometry, best first; None: no verification
        index     an empty index that stores and searches the descriptors, or a name for
                  :func:`loopclosure.index.index.open_index`
        in_memory keep the descriptors and points of about this many frames in memory, and the others in temporary files
                  (``TMPDIR`` names their folder); None: all of them
        """
        given = asdict(settings or DetectorSettings())
        unknown = set(changes) - set(given)
        if unknown:
            raise TypeError(f"LoopDetector has no setting {', '.join(sorted(unknown))}; known: {', '.join(given)}")
        self.describe = describe
        self.fingerprint: str | None = fingerprint_of(describe)  # None: unknown, from an older file
        self.settings = DetectorSettings(**{**given, **changes})
        self.check = check
        self.loops: list[LoopResult] = []
        metric = self.settings.metric
        if in_memory is not None and in_memory < 1:
            raise InputError(f"{in_memory} frames are to be kept in memory; expected at least 1")
        views, rows = self.settings.views, None if in_memory is None else in_memory * self.settings.views
        opened = open_index(index, metric, in_memory=rows) if isinstance(index, str) else index
        self._frames = Frames(opened, views, local=Local() if in_memory is None else LocalOnDisk(in_memory))
        self._sessions = [0]  # the first frame of each
        self._steps: list[float] = []  # the score of each frame with the one before it
        self._runs: Runs = []  # of the last frame
        self._last = np.zeros((0, 0), np.float32)  # the descriptor of the last frame
        self._unlike: list[tuple[float, int]] = []  # scores of unlike pairs of frames, and their points in common
        self._whole, self._part = 0, 0  # frames with enough points, of which most agree, or only a part

    def __len__(self) -> int:
        return self._frames.count

    @property
    def sessions(self) -> list[int]:
        """The first frame of each session."""
        return list(self._sessions)

    @property
    def stamps(self) -> np.ndarray:
        """The stamps (N,) in seconds, NaN for frames without one."""
        return self._frames.stamps[: len(self)].copy()

    @property
    def poses(self) -> np.ndarray:
        """The poses (N, 7), tx ty tz qx qy qz qw, NaN for frames without one."""
        return self._frames.poses[: len(self)].copy()

    @property
    def odometry(self) -> np.ndarray:
        """The poses (N, 7) by the robot's odometry, NaN for frames without one."""
        return self._frames.odometry[: len(self)].copy()

    def add(
        self,
        image: np.ndarray,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        odometry: Sequence[float] | np.ndarray | None = None,
    ) -> LoopResult:
        """Add the next frame, (H, W, 3) uint8 BGR, and return whether it closes a loop.

        ``stamp`` is in seconds. ``pose`` is tx ty tz qx qy qz qw, camera-to-world, and ``odometry`` is such a pose as
        the robot measures it; both are only stored for the export.

        The cost is one call of ``describe`` and one pass over all earlier descriptors of 4 D bytes:
        docs/performance.md.
        """
        if self.describe is None:
            raise InputError("this detector has no describe function; give one, or use add_descriptor")
        return self.add_descriptor(self.describe(image), stamp, pose, image, odometry)

    def add_descriptor(
        self,
        descriptor: Sequence[float] | np.ndarray,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        image: np.ndarray | None = None,
        odometry: Sequence[float] | np.ndarray | None = None,
    ) -> LoopResult:
        """Add a frame by its descriptor (D,); ``image`` is needed only for a geometric check."""
        path = _checked_pose(pose), _checked_pose(odometry)
        row = self._row(descriptor)
        self._check_stamp(stamp)
        self._frames.settle(self._end(stamp))
        candidates = self._candidates(row, False)
        local = self._local(image)
        result, self._runs = self._decide(len(self), candidates, stamp, local, self._runs)
        self._keep(row, stamp, path, local)
        if result.accepted is not None:
            self.loops.append(result)
        self._compare_unlike(row, local)
        self._whole += result.accepted is not None or result.reason == ALIKE
        self._part += result.reason == PART
        return result

    def remember(
        self,
        descriptor: Sequence[float] | np.ndarray | None,
        stamp: float | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        image: np.ndarray | None = None,
        odometry: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        """Add the next frame without looking for loops, which are found later from all frames of the drive.

        descriptor  (D,), or None: ``describe`` computes it from ``image``
        image       (H, W, 3) uint8 BGR; also needed for a geometric check
        """
        if descriptor is None:
            if self.describe is None or image is None:
                raise InputError("a frame has neither a descriptor nor an image that can be described")
            descriptor = self.describe(image)
        path = _checked_pose(pose), _checked_pose(odometry)
        row = self._row(descriptor)
        self._check_stamp(stamp)
        self._runs = []
        self._keep(row, stamp, path, self._local(image))

    def look_up(self, frame: int) -> LoopResult:
        """Look for the place of a frame of the last session in the sessions before it."""
        row = self.descriptors_of(frame, frame + 1).reshape(self.settings.views, -1)
        local = None if self.check is None else self.local_features(frame)
        stamp = float(self._frames.stamps[frame])
        before = self._sessions[-1]
        known = [(number, score) for number, score in self._candidates(row, False) if number < before]
        return self._decide(frame, known, None if np.isnan(stamp) else stamp, local, [])[0]

    def _keep(
        self,
        row: np.ndarray,
        stamp: float | None,
        path: tuple[np.ndarray | None, np.ndarray | None],
        local: LocalFeatures | None,
    ) -> None:
        """Store a frame; ``path`` is its pose and its odometry."""
        if len(self) > self._sessions[-1]:
            self._steps.append(float(self._score(self._last, row)))
        self._last = row
        self._frames.append(row, stamp, *path)
        if local is not None:
            self._frames.local.append(local)

    def looked_up(
        self,
        query: int,
        descriptor: Sequence[float] | np.ndarray,
        stamp: float | None,
        image: np.ndarray | None,
        before: Runs,
    ) -> tuple[LoopResult, Runs]:
        """Look up frame ``query`` of another session without adding it. ``before``: the runs of the frame before it."""
        candidates = self._candidates(self._row(descriptor), True)
        return self._decide(query, candidates, stamp, self._local(image), before)

    def begin_session(self) -> None:
        """Start another drive. All earlier frames are candidates for its frames, however recent they are."""
        self._frames.settle(len(self))
        if len(self) > self._sessions[-1]:
            self._sessions.append(len(self))
        self._runs = []

    @property
    def descriptors(self) -> np.ndarray:
        """The descriptors of all frames (N, views D), of unit length for cosine."""
        return self.descriptors_of(0, len(self))

    def descriptors_of(self, start: int, stop: int) -> np.ndarray:
        """Return the descriptors (stop - start, views D) of some frames."""
        return self._frames.rows(start, stop)

    def local_features(self, frame: int) -> LocalFeatures:
        """Return the points that the geometric check found in a frame, for measuring the pose of a loop."""
        return self._frames.local[frame]

    def arrays_since(self, frame: int) -> dict[str, np.ndarray]:
        """Return the arrays that a file stores for the frames from ``frame`` on, without their descriptors."""
        return self._frames.arrays(self.check is not None, frame)

    def decided(self, loops: Sequence[LoopResult], threshold: float | None) -> None:
        """Set the loops, found from all frames at once, and the threshold for later frames."""
        self.loops = list(loops)
        self.settings = replace(self.settings, threshold=None if threshold is None else float(threshold))

    def save(self, path: str | Path) -> None:
        """Write everything except ``describe`` to an .npz file, from which ``load`` continues."""
        about = {
            "format": FORMAT,
            "fingerprint": self.fingerprint,
            "settings": asdict(self.settings),
            "check": None if self.check is None else asdict(self.check),
            "runs": self._runs,
            "agreed": [self._whole, self._part],
            "unlike": self._unlike,
            "loops": [asdict(loop) for loop in self.loops],
            "sessions": self._sessions,
        }
        arrays: dict[str, Any] = {"rows": self.descriptors, **self._frames.arrays(self.check is not None)}
        with whole_file(path) as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(
        cls,
        path: str | Path,
        describe: Describe | None = None,
        index: Index | str = "exact",
        in_memory: int | None = None,
    ) -> LoopDetector:
        """Read a file that ``save`` wrote; ``describe`` must be the function that the detector was made with.

        Raises InputError for any other file, or if the file and ``describe`` have different fingerprints.
        """
        arrays = read_npz(path, SAVED)
        try:
            about = json.loads(str(arrays["about"]))
            if about["format"] != FORMAT:
                raise InputError(f"has format {about['format']}; this version reads {FORMAT}", path)
            check = None
            if about["check"] is not None:  # older files lack newer settings
                check = from_json(GeometricCheck, {**asdict(GeometricCheck()), **about["check"]})
            settings = from_json(DetectorSettings, about["settings"])
            detector = cls(describe, settings, check=check, index=index, in_memory=in_memory)
            detector.fingerprint = about.get("fingerprint")
            refuse_another(fingerprint_of(describe), detector.fingerprint, "or start a new file", path)
            detector._take(arrays)
            detector._sessions = _starts(about.get("sessions", [0]), len(detector))
            detector._settle()
            detector._steps = detector._all_steps()
            detector._whole, detector._part = map(int, about.get("agreed", (0, 0)))
            detector._unlike = [(float(score), int(points)) for score, points in about.get("unlike", [])]
            detector._runs = [(int(a), int(b)) for a, b in about["runs"]]
            detector.loops = [result_of(found, len(detector)) for found in about["loops"]]
        except SpecError as fault:
            raise fault if fault.where else InputError(fault.message, path) from None
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"cannot be read ({reason}); expected {SAVED}", path) from None
        return detector

    def _take(self, arrays: dict[str, np.ndarray]) -> None:
        count, frames = len(arrays["rows"]), self._frames
        check_array(arrays, "rows", "f", (count, arrays["rows"].size // count if count else 0))
        frames.take(arrays, None if self.check is None else points_of(arrays, count))
        if frames.count != count:
            raise ValueError(f"{count} rows and {frames.count} stamps")
        if count:
            frames.waiting.extend(arrays["rows"].reshape(count, self.settings.views, -1))

    def _settle(self) -> None:
        """Move the frames that are candidates of any next frame into the index."""
        last = float(self._frames.stamps[len(self) - 1]) if len(self) else np.nan
        if not self.settings.exclude_seconds or np.isfinite(last):
            self._frames.settle(self._end(last))

    def take_session(self, blocks: Iterable[np.ndarray], arrays: dict[str, np.ndarray], points: Points | None) -> None:
        """Add the frames of a finished session without looking for loops.

        blocks  their descriptors, (N, views D) each, except those that are in the index already
        arrays  their ``stamps`` (N,) and ``poses`` (N, 7), NaN where not known
        points  their local features for a geometric check, or None
        """
        self.begin_session()
        frames, views = self._frames, self.settings.views
        for block in blocks:
            frames.index.add(block.astype(np.float32).reshape(len(block) * views, -1))
        frames.take(arrays, points)
        if len(self):
            self._last = frames.index.rows((len(self) - 1) * views, len(self) * views)

    def _row(self, descriptor: Sequence[float] | np.ndarray) -> np.ndarray:
        """Check a descriptor and return the row to store, (views, D), of unit length for cosine."""
        row = np.asarray(descriptor, np.float32).reshape(-1)
        frames, views = self._frames, self.settings.views
        before = self._last.size if frames.count else len(row)
        if len(row) != before:
            found = f"frame {frames.count} has a descriptor of {len(row)} dimensions, those before {before}"
            raise InputError(f"{found}; use the net that described those, or start a new detector")
        if len(row) % views:
            raise InputError(f"frame {frames.count} has a descriptor of {len(row)} dimensions, not of {views} views")
        row = row.reshape(views, -1)
        if not row.size or not np.all(np.isfinite(row)):
            raise InputError(f"the descriptor of frame {frames.count} is empty or not finite")
        if self.settings.metric == "cosine":
            lengths = np.linalg.norm(row, axis=1, keepdims=True)
            row = row / np.where(lengths > 0, lengths, 1)
        return row

    def _check_stamp(self, stamp: float | None) -> None:
        frames, seconds = self._frames, self.settings.exclude_seconds
        if seconds and stamp is None:
            raise InputError(f"{seconds:g} s are to be excluded, but frame {frames.count} has no stamp")
        if stamp is not None and not np.isfinite(stamp):
            raise InputError(f"frame {frames.count} has stamp {stamp}; expected seconds")
        if stamp is not None and frames.count > self._sessions[-1] and stamp < frames.stamps[frames.count - 1]:
            raise InputError(f"frame {frames.count} has stamp {stamp:.6f}, earlier than the one before it")

    def _score(self, other: np.ndarray, row: np.ndarray) -> np.floating[Any]:
        """Return the score of two frames (views, D), computed directly."""
        if self.settings.metric == "cosine":
            return (other @ row.T).max()
        return -np.linalg.norm(other[:, None] - row, axis=-1).min()

    def _threshold(self) -> float | None:
        """Return the current threshold; None if there are too few frames to choose one."""
        if self.settings.threshold is not None:
            return self.settings.threshold
        if self.check is not None:
            return -np.inf
        return float(np.median(self._steps)) if len(self._steps) >= LEAST_STEPS else None

    def _end(self, stamp: float | None) -> int:
        """Return how many frames are candidates: all of earlier sessions, and those of this one that are not recent."""
        frames, settings, begin = self._frames, self.settings, self._sessions[-1]
        end = max(begin, frames.count - settings.recent)
        if settings.exclude_seconds and stamp is not None:
            latest = stamp - settings.exclude_seconds
            end = min(end, begin + int(np.searchsorted(frames.stamps[begin:end], latest, side="right")))
        return end

    def _candidates(self, row: np.ndarray, waiting: bool) -> list[tuple[int, float]]:
        """Return the most similar frames, best first; ``waiting``: search the frames not yet in the index too."""
        frames, views, k = self._frames, self.settings.views, self.settings.top_k
        best: dict[int, float] = {}  # the search can return several views of one frame
        for view in row if frames.settled else ():
            for number, value in zip(*(found.tolist() for found in frames.index.search(view, k * views)), strict=True):
                best[number // views] = max(value, best.get(number // views, value))
        if waiting:
            best |= {frames.settled + i: float(self._score(each, row)) for i, each in enumerate(frames.waiting)}
        return sorted(best.items(), key=lambda pair: (-pair[1], pair[0]))[:k]

    def _local(self, image: np.ndarray | None) -> LocalFeatures | None:
        if self.check is None:
            return None
        if image is None:
            raise InputError("a geometric check needs the images")
        return self.check.describe(image)

    def _all_steps(self) -> list[float]:
        rows = list(self.descriptors.reshape(len(self), self.settings.views, -1)) if len(self) else []
        if rows:
            self._last = rows[-1]
        return [float(self._score(rows[i - 1], rows[i])) for i in range(len(rows)) if i not in self._sessions]

    def _decide(
        self,
        query: int,
        candidates: list[tuple[int, float]],
        stamp: float | None,
        local: LocalFeatures | None,
        before: Runs,
    ) -> tuple[LoopResult, Runs]:
        """Apply threshold, consistency, then geometry; return the result and the runs for the next frame."""
        settings = self.settings
        runs: Runs = []
        score = candidates[0][1] if candidates else float("-inf")

        def result(
            verdict: str,
            accepted: int | None = None,
            value: float = score,
            inliers: int | None = None,
            reason: str = "",
        ) -> tuple[LoopResult, Runs]:
            return LoopResult(query, candidates, accepted, verdict, value, inliers, stamp, reason), runs

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
            runs.append((number, 1 + max(led, default=0)))
        steady = [pair for pair, (_, run) in zip(likely, runs, strict=True) if run > settings.consistency]
        if not steady:
            return result("not consistent")
        if self.check is None:
            return result("accepted", *steady[0])
        assert local is not None
        most, reason = 0, ""
        for number, value in steady:
            found = self.check.agreement(local, self._frames.local[number])
            if inliers := self.check.sure(found, self._points):
                if not self._left(number):
                    most, reason = inliers, VISIT
                    continue
                if self._alike:
                    return result("not verified", inliers=inliers, reason=ALIKE)
                return result("accepted", number, value, inliers)
            most = max(most, found.inliers)
            if self.check.evidence(found, self._points) >= SURE:
                reason = PART
        return result("not verified", inliers=most, reason=reason)

    @property
    def _points(self) -> float:
        """The mean number of points that unlike pairs have in common, of those below their own number needed 0.

        These are the less similar half of those compared: at the start of a drive no frame is unlike.
        """
        unlike = sorted(self._unlike)[: (len(self._unlike) + 1) // 2]
        return sum(points for _, points in unlike) / max(1, len(unlike))

    def _compare_unlike(self, row: np.ndarray, local: LocalFeatures | None) -> None:
        """Verify the last frame with the least similar of some earlier ones: a bridge's towers are seen all along."""
        last = len(self) - 1
        if self.check is None or local is None or last < LEAST_STEPS or last % (1 + len(self._unlike) // UNLIKE):
            return
        some = np.linspace(0, last - 1, AMONG).round().astype(int).tolist()
        rows = [self.descriptors_of(number, number + 1).reshape(row.shape) for number in some]
        scores = [float(self._score(other, row)) for other in rows]
        least = some[int(np.argmin(scores))]
        self._unlike.append((min(scores), self.check.enough(self.check.agreement(local, self._frames.local[least]))))

    def _left(self, number: int) -> bool:
        """Whether the place of a frame was left since, if no setting says how old a frame must be.

        It was if two frames in a row differ from it as much as half of all frames do. On a straight road frames stay
        alike for long; that is no loop.
        """
        settings, count = self.settings, len(self)
        if settings.exclude_recent is not None or settings.exclude_seconds or number < self._sessions[-1]:
            return True
        rows = self.descriptors_of(self._sessions[-1], count)
        own = rows[number - self._sessions[-1]]
        scores = similarity_matrix(own[None], rows, settings.metric, settings.views)[0]
        away = scores[number - self._sessions[-1] :] <= np.median(scores)
        return bool(np.any(away[1:] & away[:-1]))

    @property
    def _alike(self) -> bool:
        """Whether most frames with enough points agree only in part: then places cannot be told apart."""
        return self._part > self._whole


def fingerprint_of(describe: Describe | None) -> str:
    """Return the ``fingerprint`` of a ``describe`` function; "" if it has none. Nets have one."""
    return str(getattr(describe, "fingerprint", ""))


def refuse_another(describes: str, described: str | None, instead: str, path: str | Path) -> None:
    """Raise InputError for fingerprints that differ; ``instead`` is the alternative to using the other net."""
    if describes and described and describes != described:
        fault = f"its frames were described by another net ({described}, this is {describes})"
        raise InputError(f"{fault}; use the version of the package that has it, {instead}", path)


def _checked_pose(pose: Sequence[float] | np.ndarray | None) -> np.ndarray | None:
    if pose is None:
        return None
    values = np.array(pose, np.float64).reshape(-1)
    if len(values) != 7 or not np.all(np.isfinite(values)) or not np.any(values[3:]):
        raise InputError(f"a pose is {values}; expected tx ty tz qx qy qz qw")
    values[3:] /= np.linalg.norm(values[3:])
    return values


def _starts(found: Any, count: int) -> list[int]:
    """Check the first frame of each session of ``count`` frames. Raises ValueError or TypeError."""
    starts = [int(start) for start in found]
    if starts[:1] != [0] or sorted(starts) != starts or starts[-1] > count:
        raise ValueError(f"sessions that begin at {starts} of {count} frames")
    return starts
