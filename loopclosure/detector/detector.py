"""Loop closure frame by frame, for use inside a running robot.

    detector = LoopDetector()
    for image in camera:
        for loop in detector.add(image):
            ...  # frame loop.query shows the same place as frame loop.match

An index (:mod:`loopclosure.index`) searches the earlier descriptors. The default index is exact: it multiplies all
earlier descriptors by the new one. The cost of the search grows with the number of frames, and so does that of the
lines through all scores; all other costs are constant. See :meth:`LoopDetector.add`.
"""

from __future__ import annotations

import json
import re
from bisect import insort
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.decision.constants import LOOKED_BACK
from loopclosure.decision.decider import Decider
from loopclosure.decision.lines import HALF
from loopclosure.detector.answered import results_of
from loopclosure.detector.decision import DetectorSettings, LoopResult, Runs, result_of
from loopclosure.detector.describers import NAME, load_describe
from loopclosure.detector.frames import Frames, Local, LocalOnDisk, Points, checked_pose, points_of
from loopclosure.detector.likely import Likely
from loopclosure.detector.saved import FORMAT, SAVED, Describe, fingerprint_of, reading, refuse_another, starts
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures
from loopclosure.errors import InputError
from loopclosure.index.index import Index, open_index
from loopclosure.stored import check_array, from_json
from netspec.files.arrays import read_npz
from netspec.files.whole_file import whole_file

PART = "enough points agree, but only a part of those that match"
CHECK = GeometricCheck()  # the one that docs/results.md measured


class LoopDetector:
    """Finds loops frame by frame; ``loops`` has all of them, in the order of their queries.

    Frames are numbered from 0. The newest frames are not candidates: those of the last ``exclude_seconds``, or the last
    ``exclude_recent`` frames (:class:`DetectorSettings`). ``newest`` is the result of the newest frame, a loop or not.

        >>> detector = LoopDetector(None, check=None, exclude_recent=1, threshold=-0.5)
        >>> for place in (0, 1, 2, 0):
        ...     loops = detector.add_descriptor(numpy.eye(3)[place])
        >>> loops[0].query, loops[0].match, loops[0].reason
        (3, 0, 'score')
    """

    newest: LoopResult

    def __init__(
        self,
        describe: Describe | str | None = "default",
        *,
        check: GeometricCheck | None = CHECK,
        index: Index | str = "exact",
        in_memory: int | None = None,
        **settings: Any,
    ) -> None:
        """Make an empty detector. Without arguments, it is the one that docs/results.md measured.

        describe  the name of an included net, "default" or "small"; or a function, image (H, W, 3) uint8 BGR ->
                  descriptor (D,), the same D each time, or (views D,); None: use ``add_descriptor``
        check     verifies candidates by their geometry, best first; None: no verification, which needs no images
        index     an empty index that stores and searches the descriptors, or a name for
                  :func:`loopclosure.index.index.open_index`
        in_memory keep the descriptors and points of about this many frames in memory, and the others in temporary files
                  (``TMPDIR`` names their folder); None: all of them
        settings  fields of :class:`DetectorSettings`, as in ``LoopDetector(exclude_recent=50)``
        """
        self.describer = describe if isinstance(describe, str) else ""
        self.describe = load_describe(describe) if isinstance(describe, str) else describe
        chosen = DetectorSettings(**{"views": getattr(self.describe, "views", 1), **settings})
        self.fingerprint: str | None = fingerprint_of(self.describe)  # None: unknown, from an older file
        self.check = check
        self.loops: list[LoopResult] = []
        if in_memory is not None and in_memory < 1:
            raise InputError(f"{in_memory} frames are to be kept in memory; expected at least 1")
        metric, views = chosen.metric, chosen.views
        rows = None if in_memory is None else in_memory * views
        opened = open_index(index, metric, in_memory=rows) if isinstance(index, str) else index
        self._frames = Frames(opened, views, metric, local=Local() if in_memory is None else LocalOnDisk(in_memory))
        self._likely = Likely(chosen)
        self._begin, self._decider = 0, self._decider_from(0)
        self._sessions = [0]  # the first frame of each
        self._runs: Runs = []  # of the last frame
        self._last = np.zeros((0, 0), np.float32)  # the descriptor of the last frame

    def __len__(self) -> int:
        return self._frames.count

    @property
    def settings(self) -> DetectorSettings:
        """How loops are decided."""
        return self._likely.settings

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
    ) -> list[LoopResult]:
        """Add the next frame, (H, W, 3) uint8 BGR, and return the loops that become certain with it.

        They are its own, and those of at most ten frames before it that the sequence up to this frame completes.
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
    ) -> list[LoopResult]:
        """Add a frame by its descriptor (D,), as ``add`` does; only a geometric check needs the ``image``."""
        path = checked_pose(pose), checked_pose(odometry)
        row = self._row(descriptor)
        stamp = self._checked_stamp(stamp)
        self._frames.settle(self._end(stamp))
        local, end = self._local(image), self._end(stamp)
        loops: list[LoopResult] = []
        if self.check is None:
            found = self._found(len(self), self._similar(row), stamp)
            self._keep(row, stamp, path, None)
            verdict, steady, self._runs = self._likely.of(found.candidates, self._runs, False)
            self.newest = _by_score(found, verdict, steady)
        else:
            candidates, scores = self._frames.search_all(row, self.settings.top_k)
            found = self._found(len(self), candidates, stamp)
            self._keep(row, stamp, path, local)
            self.newest, loops = self._decided(found, scores, end)
        loops += [self.newest] if self.newest else []
        for loop in loops:
            insort(self.loops, loop, key=lambda each: each.query)
        return loops

    def _decided(self, found: LoopResult, scores: np.ndarray, end: int) -> tuple[LoopResult, list[LoopResult]]:
        """Decide on the newest frame by its points, and on the one ``HALF`` frames before it by its line.

        Returns the result of the newest, and that of the other if it is a loop.

        scores  (N,) with all frames before it; of these, the first ``end`` are old enough to be its candidates
        """
        query = found.query
        if len(self._decider) != query - self._begin:  # frames before it were only remembered
            self._begin, self._decider = query, self._decider_from(query)
        number, begin, decider = query - self._begin, self._begin, self._decider
        visits = begin if self.settings.exclude_recent is None else None
        possible = decider.add(scores, scores[begin:], visits, np.arange(query) < end)
        result, self._runs = self._looked_at(decider, number, found, scores, possible, self._runs)
        middle = number - HALF
        if middle < 0 or self.settings.threshold is not None:
            return result, []
        decider.lines.search(middle + 1)
        first = max(0, middle + 1 - LOOKED_BACK)
        decision = decider.decide(first, middle + 1, middle)
        known = {loop.query for loop in self.loops[-2 * HALF :]}
        if not decision.loops[-1] or begin + middle in known:
            return result, []
        return result, results_of(decision, begin + first, self._frames.stamps[begin + first :], middle - first)

    def _looked_at(
        self,
        decider: Decider,
        number: int,
        found: LoopResult,
        scores: np.ndarray,
        possible: np.ndarray,
        before: Runs,
        every: bool = False,
    ) -> tuple[LoopResult, Runs]:
        """Decide on a frame, query ``number`` of a decider, by its points; return the result and its runs.

        every  examine all its candidates, though no setting chooses among them by their scores
        """
        verdict, steady, runs = self._likely.of(found.candidates, before, True)
        by_scores = every or self.settings.threshold is not None or self.settings.consistency > 0
        if by_scores and not steady:
            return replace(found, verdict=verdict), runs
        looked = decider.look(number, [k for k, _ in steady if possible[k]] if by_scores else None)
        if looked.match < 0:
            return found, runs
        points = replace(found, verdict="not verified", inliers=looked.inliers, reason=PART if looked.part else "")
        if not decider.is_loop(looked.wrong):
            return points, runs
        score, reason = float(scores[looked.match]), f"points: {looked.inliers} agree"
        accepted = replace(points, match=looked.match, verdict="accepted", score=score, reason=reason)
        return replace(accepted, wrong=looked.wrong), runs

    def _decider_from(self, begin: int) -> Decider:
        """Return a decider on the frames from ``begin`` on."""
        check, local = self.check, self._frames.local

        def agree(one: int, other: int) -> Agreement:
            assert check is not None
            return check.agreement(local[one], local[other])

        return Decider(
            check=check,
            agree=None if check is None else lambda query, reference: agree(begin + query, reference),
            among=lambda one, other: agree(begin + one, begin + other),
        )

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
        path = checked_pose(pose), checked_pose(odometry)
        row = self._row(descriptor)
        stamp = self._checked_stamp(stamp)
        self._runs = []
        self._keep(row, stamp, path, self._local(image))

    def look_up(self, frame: int) -> LoopResult:
        """Look for the place of a frame of the last session in the sessions before it, by its scores."""
        row = self.descriptors_of(frame, frame + 1).reshape(self.settings.views, -1)
        stamp, before = float(self._frames.stamps[frame]), self._sessions[-1]
        known = [(number, score) for number, score in self._similar(row) if number < before]
        found = self._found(frame, known, None if np.isnan(stamp) else stamp)
        return _by_score(found, *self._likely.of(known, [], False)[:2])

    def _keep(
        self,
        row: np.ndarray,
        stamp: float | None,
        path: tuple[np.ndarray | None, np.ndarray | None],
        local: LocalFeatures | None,
    ) -> None:
        """Store a frame; ``path`` is its pose and its odometry."""
        if len(self) > self._sessions[-1]:
            self._likely.steps.append(self._frames.score(self._last, row))
        self._last = row
        self._frames.append(row, stamp, *path)
        if local is not None:
            self._frames.local.append(local)

    def looked_up(
        self,
        query: int,
        descriptor: Sequence[float] | np.ndarray,
        stamp: float | None,
        before: Runs,
        decider: Decider | None,
    ) -> tuple[LoopResult, Runs]:
        """Look up frame ``query`` of another session without adding it. ``before``: the runs of the frame before it.

        ``decider`` decides on that session; None: there is no geometric check.
        """
        row = self._row(descriptor)
        candidates = self._frames.most_similar(row, self.settings.top_k, True)
        found = self._found(query, candidates, stamp)
        if decider is None:
            verdict, steady, runs = self._likely.of(candidates, before, False)
            return _by_score(found, verdict, steady), runs
        _, scores = self._frames.search_all(row, 1)
        possible = decider.add(scores, np.zeros(0), None)
        return self._looked_at(decider, query, found, scores, possible, before, every=True)

    def begin_session(self) -> None:
        """Start another drive. All earlier frames are candidates for its frames, however recent they are."""
        self._frames.settle(len(self))
        if len(self) > self._sessions[-1]:
            self._sessions.append(len(self))
        self._begin, self._decider = len(self), self._decider_from(len(self))
        self._frames.begin_drive()
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

    def decided(self, loops: Sequence[LoopResult]) -> None:
        """Set the loops, found from all frames at once."""
        self.loops = list(loops)

    def save(self, path: str | Path) -> None:
        """Write everything except ``describe`` to an .npz file, from which ``load`` continues."""
        about = {
            "format": FORMAT,
            "describer": self.describer,
            "fingerprint": self.fingerprint,
            "settings": asdict(self.settings),
            "check": None if self.check is None else asdict(self.check),
            "runs": self._runs,
            "loops": [asdict(loop) for loop in self.loops],
            "sessions": self._sessions,
            "begin": self._begin,
        }
        arrays: dict[str, Any] = {"rows": self.descriptors, **self._frames.arrays(self.check is not None)}
        arrays |= self._decider.arrays()
        with whole_file(path) as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, about=np.array(json.dumps(about)), **arrays)

    @classmethod
    def load(
        cls,
        path: str | Path,
        describe: Describe | str | None = None,
        index: Index | str = "exact",
        in_memory: int | None = None,
    ) -> LoopDetector:
        """Read a file that ``save`` wrote.

        ``describe`` must be the function that the detector was made with; None: the included net, if it was one.

        Raises InputError for any other file, or if the file and ``describe`` have different fingerprints.
        """
        arrays = read_npz(path, SAVED)
        with reading(path):
            about = json.loads(str(arrays["about"]))
            if about["format"] != FORMAT:
                raise InputError(f"has format {about['format']}; this version reads {FORMAT}", path)
            check = None
            if about["check"] is not None:  # older files lack newer settings
                check = from_json(GeometricCheck, {**asdict(GeometricCheck()), **about["check"]})
            settings = from_json(DetectorSettings, about["settings"])
            if describe is None and re.fullmatch(NAME, name := about.get("describer", "")):
                describe = name  # never a file or a module that a detector's file names
            detector = cls(describe, check=check, index=index, in_memory=in_memory, **asdict(settings))
            described, detector.fingerprint = detector.fingerprint, about.get("fingerprint")
            refuse_another(described or "", detector.fingerprint, "or start a new file", path)
            detector._take(arrays)
            detector._sessions = starts(about.get("sessions", [0]), len(detector))
            detector._settle()
            detector._likely.steps, detector._last = detector._frames.steps(detector._sessions)
            detector._runs = [(int(a), int(b)) for a, b in about["runs"]]
            detector.loops = [result_of(found, len(detector)) for found in about["loops"]]
            detector._begin = begin = int(about["begin"])
            detector._decider = detector._decider_from(begin)
            detector._decider.take(arrays, len(detector) - begin)
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

    def _checked_stamp(self, stamp: float | None) -> float | None:
        frames, seconds = self._frames, self.settings.exclude_seconds
        if seconds and stamp is None:
            raise InputError(f"{seconds:g} s are to be excluded, but frame {frames.count} has no stamp")
        if stamp is not None and not np.isfinite(stamp):
            raise InputError(f"frame {frames.count} has stamp {stamp}; expected seconds")
        if stamp is not None and frames.count > self._sessions[-1] and stamp < frames.stamps[frames.count - 1]:
            raise InputError(f"frame {frames.count} has stamp {stamp:.6f}, earlier than the one before it")
        return None if stamp is None else float(stamp)

    def _end(self, stamp: float | None) -> int:
        """Return how many frames are candidates: all of earlier sessions, and those of this one that are not recent."""
        frames, settings, begin = self._frames, self.settings, self._sessions[-1]
        end = max(begin, frames.count - settings.recent)
        if settings.exclude_seconds and stamp is not None:
            latest = stamp - settings.exclude_seconds
            end = min(end, begin + int(np.searchsorted(frames.stamps[begin:end], latest, side="right")))
        return end

    def _local(self, image: np.ndarray | None) -> LocalFeatures | None:
        if self.check is None:
            return None
        if image is None:
            raise InputError("a geometric check needs the images; give them, or make the detector with check=None")
        return self.check.describe(image)

    def _similar(self, row: np.ndarray) -> list[tuple[int, float]]:
        return self._frames.most_similar(row, self.settings.top_k, False)

    def _found(self, query: int, candidates: list[tuple[int, float]], stamp: float | None) -> LoopResult:
        score = candidates[0][1] if candidates else -np.inf
        return LoopResult(query, candidates, None, "no candidate", score, stamp=stamp)


def _by_score(found: LoopResult, verdict: str, steady: Sequence[tuple[int, float]]) -> LoopResult:
    """Return the result of a frame by its ``steady`` candidates, best first, or the verdict without any."""
    if not steady:
        return replace(found, verdict=verdict)
    match, score = steady[0]
    return replace(found, match=match, verdict="accepted", score=score, reason="score")
