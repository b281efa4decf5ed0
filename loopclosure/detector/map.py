"""A map on disk: a folder of sessions, each with the descriptors and points of its frames.

``map.json`` has the net that describes the frames, and the list of the sessions. A session is a folder that never
changes: ``frames.h5``, ``loops.csv``, and ``calibration.txt`` if the source has a calibration of its camera.

Adding a session writes its folder first and then replaces ``map.json`` in one step. So a map is always complete: a
folder that ``map.json`` does not list is not read, and a process that reads the map during an add sees the earlier
sessions.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.detector.decision import LoopResult
from loopclosure.detector.describers import NAME, load_describe
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import write_loops_csv
from loopclosure.detector.frames import Points, points_of
from loopclosure.detector.run import remember_all, run_detector
from loopclosure.detector.saved import Describe, fingerprint_of, reading, refuse_another
from loopclosure.errors import InputError
from loopclosure.index.index import open_index
from loopclosure.places.depth import read_depths
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics, read_intrinsics, write_calibration
from loopclosure.progress import Progress, silent
from loopclosure.stored import check_array
from netspec.files.hdf5 import new_hdf5, open_hdf5
from netspec.files.paths import inside
from netspec.files.whole_file import only_one, whole_folder, write_whole

SESSION = "a session of a map that loopclosure map wrote"
METRIC = "euclidean"
BLOCK = 4096  # frames read at a time
Decide = Callable[[LoopDetector], list[LoopResult]]
HEAD, FRAMES, CALIBRATION, LOOPS = "map.json", "frames.h5", "calibration.txt", "loops.csv"
LARGE = ("rows", "points", "descriptors", "depths")  # arrays of which only the rows in use are read
EXTRACTED, LOCK = "frames", ".lock"  # images from bags, and the lock of an add


class Stored:
    """An array (N, ...) of a session's file. ``stored[first:end]`` reads only these rows."""

    def __init__(self, path: Path, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.path, self.name, self.shape, self.dtype = path, name, shape, dtype

    def __getitem__(self, rows: slice) -> np.ndarray:
        with open_hdf5(self.path) as file:
            found = file.dataset(self.name)
            if found is None or found.shape != self.shape:
                raise InputError(f'"{self.name}" was changed after it was opened', self.path)
            return np.asarray(found[rows])


@dataclass(frozen=True)
class Session:
    """A session of N frames.

    arrays  ``stamps`` (N,) and ``poses`` (N, 7), NaN where not known, and ``odometry`` (N, 7) if the robot measured it
    rows    (N, views D) float32, the descriptors
    camera  None if the source has no calibration
    depths  (P,) float32, of all points in meters, 0 where not known; None without depth images
    """

    folder: Path
    names: list[str]
    arrays: dict[str, np.ndarray]
    rows: Stored
    points: Points
    camera: Intrinsics | None = None
    depths: Stored | None = None

    def depths_of(self, frame: int) -> np.ndarray | None:
        """Return the depths (K,) of the points of one frame."""
        return None if self.depths is None else self.depths[self.points.part(frame)]

    def blocks(self, start: int = 0) -> Iterator[np.ndarray]:
        """Yield the descriptors (n, views D) float32 from frame ``start`` on."""
        for first in range(start, len(self.names), BLOCK):
            yield self.rows[first : first + BLOCK]


class Map:
    """A map on disk.

    describer    the name of the net that describes its frames
    fingerprint  of that net; "" if it is not known
    sessions     its sessions, in the order in which they were added
    """

    def __init__(self, folder: str | Path) -> None:
        """Open a map to read it. Raises InputError if the folder is not a map."""
        self.folder = Path(folder)
        self.sessions: list[Session] = []
        self._read()

    def _read(self) -> None:
        """Read what others have added."""
        head = _read_head(self.folder)
        self.describer, self.fingerprint = str(head["describer"]), str(head["fingerprint"])
        for name in head["sessions"][len(self.sessions) :]:
            self.sessions.append(_read_session(self.folder / name))

    @classmethod
    def create(cls, folder: str | Path, describer: str) -> Map:
        """Make an empty map. Raises InputError if the folder is in use already."""
        folder, describer = Path(folder), checked_name(describer)
        empty = not folder.exists()
        if folder.is_dir():  # what a killed process left behind is hidden, or is not in the list of the sessions
            shown = {path.name for path in folder.iterdir() if not path.name.startswith(".")} - {EXTRACTED}
            empty = not cls(folder).sessions if HEAD in shown else not shown
        if not empty:
            raise InputError("exists already; loopclosure map add adds to a map", folder)
        folder.mkdir(parents=True, exist_ok=True)
        _write_head(folder, describer, "", [])
        return cls(folder)

    def __len__(self) -> int:
        return sum(len(session.names) for session in self.sessions)

    def session_of(self, frame: int) -> tuple[Session, int]:
        """Return the session of a frame of the map, and the number of the frame in it."""
        for session in self.sessions:
            if frame < len(session.names):
                return session, frame
            frame -= len(session.names)
        raise InputError("has no such frame", self.folder)

    @property
    def names(self) -> list[str]:
        """The names of all frames, SESSION/NAME."""
        return [f"{session.folder.name}/{name}" for session in self.sessions for name in session.names]

    @cached_property
    def describe(self) -> Describe:
        """The installed net that ``describer`` names."""
        return load_describe(self.describer)

    def detector(self, describe: Describe | None = None, index: str = "exact") -> LoopDetector:
        """Return a detector with all frames of the map and a geometric check.

        describe  the function that described the frames; None: the installed net that the map names
        index     a name for :func:`loopclosure.index.index.open_index`; only frames that are not in the index are added

        Raises InputError if the net's descriptors have another size or fingerprint than those of the map.
        """
        describe = describe or self.describe
        instead = "or build the map again from its drives"
        refuse_another(fingerprint_of(describe), self.fingerprint, instead, self.folder)
        views = getattr(describe, "views", 1)
        opened = open_index(index, METRIC, len(self) * views)
        there = len(opened) // views
        detector = LoopDetector(describe, index=opened, metric=METRIC)
        for session in self.sessions:
            skipped = min(there, len(session.names))
            there -= skipped
            detector.take_session(session.blocks(skipped), session.arrays, session.points)
        detector.begin_session()
        return detector

    def add(
        self,
        recording: ImageSequence,
        describe: Describe | None = None,
        index: str = "exact",
        progress: Progress = silent,
        decide: Decide | None = None,
    ) -> list[LoopResult]:
        """Add a recording as a session, and return a result for each of its frames: loops to all sessions.

        ``describe`` and ``index`` are those of :meth:`detector`. ``decide`` finds the loops from all frames at once;
        None: each frame is decided when it is added. The loops are written to ``loops.csv`` in the session's folder.
        Raises InputError, SpecError or OSError, and adds nothing, if another process is adding, if there are no frames,
        or if a file cannot be written.
        """
        with only_one(inside(self.folder, LOCK), "wait until it has ended"):
            self._read()
            detector = self.detector(describe, index)
            before = len(detector)
            if decide is None:
                results = run_detector(detector, recording, progress=progress)
            else:
                remember_all(detector, recording, progress=progress)
                results = decide(detector) if len(detector) > before else []
            if len(detector) == before:
                raise InputError("has no frames; nothing is added", recording.source)
            self._write(recording.readable(), detector, results)
        return results

    def _write(self, recording: ImageSequence, detector: LoopDetector, results: list[LoopResult]) -> None:
        """Write the files of a new session, then ``map.json``; after an error, remove what was written."""
        names = (f"{number:06d}" for number in itertools.count(len(self.sessions)))
        folder = self.folder / next(name for name in names if not os.path.lexists(self.folder / name))
        arrays = detector.arrays_since(len(self))
        if recording.depths is not None:
            arrays["depths"] = _depths(recording, points_of(arrays, len(recording)))
        arrays["rows"] = detector.descriptors_of(len(self), len(detector))
        # File names are not always UTF-8.
        arrays["names"] = np.frombuffer(json.dumps(list(recording.names)).encode(), np.uint8)
        every = [*self.names, *(f"{folder.name}/{name}" for name in recording.names)]
        sessions = [*(session.folder.name for session in self.sessions), folder.name]
        try:
            with whole_folder(folder) as unfinished:
                with new_hdf5(unfinished / FRAMES) as file:
                    for name, values in arrays.items():
                        file[name] = values
                if recording.camera is not None:
                    write_calibration(unfinished / CALIBRATION, recording.camera)
                write_loops_csv(unfinished / LOOPS, [r for r in results if r], detector.stamps, every)
            _write_head(self.folder, self.describer, self.fingerprint or detector.fingerprint, sessions)
        except BaseException:
            if folder.name not in _read_head(self.folder)["sessions"]:
                shutil.rmtree(folder, ignore_errors=True)
            raise
        self._read()


def _read_head(folder: Path) -> dict[str, Any]:
    """Read ``map.json``. Raises InputError for any other file."""
    path = folder / HEAD
    if not path.is_file():
        raise InputError("is not a map; loopclosure map build makes one", folder)
    with reading(path, "the head of a map, as loopclosure map build writes it"):
        head = json.loads(path.read_text(encoding="utf-8"))
        checked_name(head["describer"])
        names = head["sessions"]
        if sorted(set(names)) != names or not all(re.fullmatch("[0-9]{6}", name) for name in names):
            raise ValueError(f"its sessions are {names!r:.80}")
    return head


def _write_head(folder: Path, describer: str, fingerprint: str | None, sessions: list[str]) -> None:
    head = {"describer": describer, "fingerprint": fingerprint, "sessions": sessions}
    write_whole(inside(folder, HEAD), json.dumps(head) + "\n")


def _read_session(folder: Path) -> Session:
    path, calibration = folder / FRAMES, folder / CALIBRATION
    if not path.is_file():
        raise InputError(f"no such file; expected {SESSION}", path)
    with open_hdf5(path) as file:
        found = {name: file.dataset(name) for name in LARGE}
        large = {name: Stored(path, name, each.shape, each.dtype) for name, each in found.items() if each is not None}
        arrays = {name: file.values(name) for name in file.names() if name not in LARGE}
    with reading(path, SESSION):
        names = json.loads(arrays.pop("names").tobytes())
        count = len(names)
        check_array(large, "rows", "f", (count, *large["rows"].shape[1:2]), finite=False)
        check_array(arrays, "stamps", "f", (count,), finite=False)
        check_array(arrays, "poses", "f", (count, 7), finite=False)
        points = points_of({**arrays, **large}, count, finite=False)
        if "depths" in large:
            check_array(large, "depths", "f", (int(points.ends[-1]),), finite=False)
    camera = read_intrinsics(calibration) if calibration.is_file() else None
    return Session(folder, names, arrays, large["rows"], points, camera, large.get("depths"))


def checked_name(describer: str) -> str:
    """Check that a describer is a plain name: opening a map must not run a file that the map names."""
    if not re.fullmatch(NAME, describer):
        raise InputError(f'"{describer}" is not the name of a net; a map needs default, small or another installed net')
    return describer


def _depths(recording: ImageSequence, points: Points) -> np.ndarray:
    """Return the depths (P,) of all points of a session, 0 where not known or where the file cannot be read."""
    found = np.zeros(points.points.shape[0], np.float32)
    for frame, file in enumerate(recording.depths or ()):
        local = points.of(frame)
        with suppress(InputError):
            if file is not None:
                found[points.part(frame)] = read_depths(file, local.points, local.size, recording.depth_per_m)
    return found
