"""A map on disk: a folder of sessions, each with the descriptors and points of its frames.

``map.json`` lists the contents of the map: the net that describes the frames, the number of sessions, and the
projection. A session is a folder ``000000``, ``000001``, ... that never changes. The folder ``projected-N`` has the
projection (the principal directions of N frames) and the projected descriptors: one file for each session.

Adding a session writes all new files first and then replaces ``map.json`` in one step. So a map is always complete:
files that ``map.json`` does not list are not read, and the next add removes them. A process that reads the map during
an add sees the earlier sessions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.descriptors.whitening import Whitening, learn_whitening
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import write_loops_csv
from loopclosure.detector.frames import Points, points_of
from loopclosure.detector.own_files import remove_own
from loopclosure.detector.run import NAME, remember_all, run_detector, views_of
from loopclosure.detector.saved import Describe, fingerprint_of, refuse_another
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.index.index import INDEXES, open_index
from loopclosure.places.depth import read_depths
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics, read_intrinsics, write_calibration
from loopclosure.progress import Progress, silent
from loopclosure.stored import Rows, check_array, regular
from netspec.files.arrays import read_npz
from netspec.files.paths import inside
from netspec.files.whole_file import only_one, whole_file, whole_folder, write_whole

FORMAT = 2
NAMED_BY_FOLDERS = 1  # an older format: every session folder on disk belongs to the map
SESSION = "a session of a map that loopclosure map wrote"
PROJECTION = "the projection of a map"
METRIC = "euclidean"
COMPONENTS = 256  # of a projected descriptor
LEARNED_FROM = 2048  # frames, evenly spread; with fewer there is no projection
BLOCK = 4096  # frames read at a time
MOST_FRAMES = 10**15  # a projection learned from more frames is rejected
Decide = Callable[[LoopDetector], list[LoopResult]]
# Fingerprints of the nets of versions 0.2.0 and 0.3.0; their maps do not contain them.
OLDER = {"default": "63cb899e0703cb96", "small": "2e195dd29a635c6c"}
MAPPED = ("rows", "points", "descriptors")  # arrays in files of their own, read where they are used
# Where the source has them: the camera, and the depth of each point.
CALIBRATION, DEPTHS = "calibration.txt", "depths.npy"
SESSION_FILES = ("frames.npz", *(f"{name}.npy" for name in MAPPED), DEPTHS, CALIBRATION, "loops.csv")
PROJECTION_FILE = "projection.npz"
EXTRACTED, LOCK = "frames", ".lock"  # images from bags, and the lock of an add; map.json does not list them


@dataclass(frozen=True)
class Session:
    """A session of N frames: their names, and the arrays in its files.

    camera  None if the source has no calibration, and in maps of earlier versions, which did not store it
    depths  (P,) float32, of all points in meters, 0 where not known; None without depth images
    """

    folder: Path
    names: list[str]
    arrays: dict[str, Any]
    points: Points
    camera: Intrinsics | None = None
    depths: Rows | None = None

    def depths_of(self, frame: int) -> np.ndarray | None:
        """Return the depths (K,) of the points of one frame."""
        return None if self.depths is None else self.depths[self.points.part(frame)]

    def blocks(self, start: int = 0, projection: Whitening | None = None, views: int = 1) -> Iterator[np.ndarray]:
        """Yield the descriptors (n, views D) float32 from frame ``start`` on; the projection applies to each view."""
        kept = None if projection is None else self._projected(projection, views)
        for first in range(start, len(self.names), BLOCK):
            rows = slice(first, first + BLOCK)
            if kept is not None:
                try:
                    yield kept[rows]
                    continue
                except InputError:  # removed meanwhile by an add that learned another projection
                    kept = None
            whole = self.arrays["rows"][rows].astype(np.float32)
            if not np.all(np.isfinite(whole)):
                raise InputError(f"has a number that is not finite; expected {SESSION}", self.folder / "rows.npy")
            yield shortened(whole, projection, views)

    def _projected(self, projection: Whitening, views: int) -> Rows | None:
        """Return the projected descriptors stored on disk; None if there are none."""
        try:
            kept = Rows(self.folder.with_name(projected(projection)) / f"{self.folder.name}.npy", SESSION)
        except (ValueError, OSError):
            return None
        return kept if kept.shape == (len(self.names), views * COMPONENTS) and kept.dtype == np.float32 else None


class Map:
    """A map on disk.

    describer   the name of the net that describes its frames
    sessions    its sessions, in the order in which they were added
    projection  shortens the descriptors for the search in memory; None while there are too few frames
    """

    def __init__(self, folder: str | Path) -> None:
        """Open a map to read it. Raises InputError if the folder is not a map."""
        self.folder = Path(folder)
        self.sessions: list[Session] = []
        self.projection: Whitening | None = None
        self._read()

    def _read(self) -> None:
        about = self._about()
        self.describer = checked_name(about["describer"])
        for number in range(len(self.sessions), self._count(about)):
            session = _read_session(self.folder / f"{number:06d}")
            session.arrays.setdefault("fingerprint", OLDER.get(self.describer, ""))
            first = [*self.sessions, session][0]
            width, expected = (each.arrays["rows"].shape[1] for each in (session, first))
            if width != expected:
                message = f"has {width} numbers a frame, that of {first.folder.name} {expected}; they are of one net"
                raise InputError(message, session.folder / "rows.npy")
            self.sessions.append(session)
        path = self.folder / about["projection"] / PROJECTION_FILE
        known = about["projection"] or about["format"] == NAMED_BY_FOLDERS
        self.projection = _read_projection(path) if known else None
        if about["projection"] and (self.projection is None or projected(self.projection) != about["projection"]):
            raise InputError(f"is not the projection that {self.folder / 'map.json'} names; build the map again", path)

    def _about(self) -> dict[str, Any]:
        """Read ``map.json``."""
        path = self.folder / "map.json"
        try:
            about = json.loads(regular(path, "the head of a map").read_text(encoding="utf-8"))
            if about["format"] not in (FORMAT, NAMED_BY_FOLDERS):
                raise InputError(f"has format {about['format']}; this version reads {FORMAT}", path)
            checked_name(about["describer"])
            if about["format"] == NAMED_BY_FOLDERS:
                return {**about, "sessions": None, "projection": ""}
            if not isinstance(about["sessions"], int) or not re.fullmatch(r"(projected-\d+)?", about["projection"]):
                raise InputError("does not name the sessions and the projection of a map", path)
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError("is not a map; loopclosure map build makes one", self.folder) from None
        return about

    def _count(self, about: dict[str, Any]) -> int:
        """Return the number of sessions."""
        count = about["sessions"]
        if count is None:
            count = 0
            while (self.folder / f"{count:06d}").is_dir():
                count += 1
        return count

    @classmethod
    def create(cls, folder: str | Path, describer: str) -> Map:
        """Make an empty map. Raises InputError if the folder is in use already."""
        folder, describer = Path(folder), checked_name(describer)
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        empty = names <= {"map.json", EXTRACTED, LOCK} and ("map.json" not in names or not cls(folder).sessions)
        if folder.exists() and not (folder.is_dir() and empty):
            raise InputError("exists already; loopclosure map add adds to a map", folder)
        folder.mkdir(parents=True, exist_ok=True)
        _write_head(folder, describer, 0, None)
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

    def detector(self, describe: Describe, index: str = "exact") -> LoopDetector:
        """Return a detector with all frames of the map and a geometric check.

        index  a name for :func:`loopclosure.index.index.open_index`; only frames that are not in the index are added

        Raises InputError if the net's descriptors have another size or fingerprint than those of the map.
        """
        return self._detector(self._described(describe, index), index)

    def _described(self, describe: Describe, index: str) -> _Described:
        """Wrap ``describe`` for an index; only an index in memory gets projected descriptors."""
        return _Described(describe, self.projection if index in INDEXES else None)

    def _detector(self, described: _Described, index: str) -> LoopDetector:
        views = described.views
        for session in self.sessions:
            known = str(session.arrays["fingerprint"])
            refuse_another(described.fingerprint, known, "or build the map again from its drives", self.folder)
        opened = open_index(index, METRIC, len(self) * views)
        there = len(opened) // views
        detector = LoopDetector(described, check=GeometricCheck(), index=opened, metric=METRIC, views=views)
        for session in self.sessions:
            skipped = min(there, len(session.names))
            there -= skipped
            blocks = session.blocks(skipped, described.projection, views)
            detector.take_session(blocks, session.arrays, session.points)
        detector.begin_session()
        return detector

    def add(
        self,
        recording: ImageSequence,
        describe: Describe,
        index: str = "exact",
        progress: Progress = silent,
        decide: Decide | None = None,
    ) -> list[LoopResult]:
        """Add a recording as a session, and return a result for each of its frames: loops to all sessions.

        ``decide`` finds the loops from all frames at once; None: each frame is decided when it is added. The loops are
        written to ``loops.csv`` in the session's folder. Raises InputError, SpecError or OSError, and adds nothing, if
        another process is adding, if there are no frames, or if a file cannot be written.
        """
        with only_one(inside(self.folder, LOCK), "wait until it has ended"):
            self._read()  # what others have added
            described = self._described(describe, index)
            detector = self._detector(described, index)
            before = len(detector)
            if decide is None:
                results = run_detector(detector, recording, progress=progress)
            else:
                remember_all(detector, recording, progress=progress)
                results = decide(detector) if len(detector) > before else []
            if len(detector) == before:
                raise InputError("has no frames; nothing is added", recording.source)
            self._write(recording.readable(), described, detector, results)
        return results

    def _write(
        self, recording: ImageSequence, described: _Described, detector: LoopDetector, results: list[LoopResult]
    ) -> None:
        """Write the files of a new session, then ``map.json``; after an error, remove what was written."""
        count, views, named = len(self.sessions), described.views, self.projection
        if self._about()["format"] == NAMED_BY_FOLDERS:
            self._write_projected(self.sessions, named, views)
            _write_head(self.folder, self.describer, count, named)
        folder = inside(self.folder, f"{count:06d}")
        remove_own(folder, SESSION_FILES)  # of an add that was killed
        if folder.exists():
            raise InputError("is not part of the map; move it to another folder", folder)
        arrays: dict[str, Any] = detector.arrays_since(len(self))
        every = [*self.names, *(f"{folder.name}/{name}" for name in recording.names)]
        try:
            with whole_folder(folder) as unfinished:
                np.save(unfinished / "rows.npy", np.array(described.kept))
                if recording.depths is not None:
                    np.save(unfinished / DEPTHS, _depths(recording.depths, points_of(arrays, len(recording))))
                if recording.camera is not None:
                    write_calibration(unfinished / CALIBRATION, recording.camera)
                np.save(unfinished / "points.npy", arrays.pop("points"))
                np.save(unfinished / "descriptors.npy", arrays.pop("descriptors"))
                about = {"source": np.array(str(recording.source)), "fingerprint": np.array(described.fingerprint)}
                np.savez(unfinished / "frames.npz", names=np.array(recording.names), **about, **arrays)
                write_loops_csv(unfinished / "loops.csv", [r for r in results if r], detector.stamps, every)
            sessions = [*self.sessions, _read_session(folder)]
            projection = _learned(sessions, named, views)
            self._write_projected(sessions, projection, views)
            _write_head(self.folder, self.describer, len(sessions), projection)
        except BaseException:
            if self._count(self._about()) == count:
                remove_own(folder, SESSION_FILES)
            raise
        self._read()
        self._remove_projections({projected(each) for each in (named, self.projection) if each is not None})

    def _write_projected(self, sessions: list[Session], projection: Whitening | None, views: int) -> None:
        """Write a projection and the projected descriptors that are missing on disk, to open the map faster."""
        if projection is None:
            return
        name = projected(projection)
        inside(self.folder, name).mkdir(exist_ok=True)
        with whole_file(inside(self.folder, name, PROJECTION_FILE)) as unfinished, unfinished.open("wb") as stream:
            images = np.array(projection.images)
            np.savez(stream, mean=projection.mean, projection=projection.projection, images=images)
        for number, session in enumerate(sessions):
            path = inside(self.folder, name, f"{session.folder.name}.npy")
            if number < len(self.sessions) and projection is self.projection and path.exists():
                continue
            rows = [shortened(block, projection, views) for block in session.blocks()]
            with whole_file(path) as unfinished, unfinished.open("wb") as stream:
                np.save(stream, np.concatenate(rows))

    def _remove_projections(self, kept: set[str]) -> None:
        """Remove all projections except ``kept``: the current one, and the previous one, which may be in use."""
        files = (PROJECTION_FILE, *(f"{session.folder.name}.npy" for session in self.sessions))
        for folder in self.folder.glob("projected-*"):
            if folder.name not in kept and re.fullmatch(r"projected-\d+", folder.name):
                remove_own(folder, files)
        remove_own(self.folder, [PROJECTION_FILE])  # where format 1 stored it


def _write_head(folder: Path, describer: str, sessions: int, projection: Whitening | None) -> None:
    named = "" if projection is None else projected(projection)
    about = {"format": FORMAT, "describer": describer, "sessions": sessions, "projection": named}
    write_whole(inside(folder, "map.json"), json.dumps(about) + "\n")


def projected(projection: Whitening) -> str:
    """Return the name of the folder for a projection and the descriptors that it shortened."""
    return f"projected-{projection.images}"


def _read_projection(path: Path) -> Whitening | None:
    """Read a projection; None if there is no file."""
    if not path.exists():
        return None
    arrays = read_npz(regular(path, PROJECTION), PROJECTION)
    try:
        size = len(arrays["mean"])
        check_array(arrays, "mean", "f", (size,))
        check_array(arrays, "projection", "f", (size, COMPONENTS))
        images = int(arrays.get("images", 0))  # older files do not have it
        if not 0 <= images < MOST_FRAMES:
            raise ValueError(f'"images" is {images:.6g}')
    except (ValueError, LookupError, TypeError, ArithmeticError) as error:
        raise InputError(f"{error}; remove it, and loopclosure map add makes it again", path) from None
    return Whitening(arrays["mean"], arrays["projection"], images, 0, str(path))


def _learned(sessions: list[Session], before: Whitening | None, views: int) -> Whitening | None:
    """Return ``before``, or a new projection if there are twice as many frames as ``before`` was learned from."""
    starts = np.cumsum([0, *(len(session.names) for session in sessions)])
    count, size = int(starts[-1]), sessions[-1].arrays["rows"].shape[1] // views
    if count < max(LEARNED_FROM, 2 * before.images if before else 0) or size <= COMPONENTS:
        return before
    parts = []
    for wanted in np.linspace(0, count - 1, LEARNED_FROM).round().astype(int):
        number = int(np.searchsorted(starts, wanted, side="right")) - 1
        row = int(wanted - starts[number])
        parts.append(sessions[number].arrays["rows"][row : row + 1].astype(np.float32))
    rows = np.concatenate(parts)
    learned = learn_whitening(rows.reshape(len(rows) * views, -1)[::views], COMPONENTS, 0.0)
    return before if learned.projection.shape[1] < COMPONENTS else replace(learned, images=count)


class _Described:
    """Describes images for a map; ``kept`` collects the net's descriptors in half precision, as in the files."""

    def __init__(self, describe: Describe, projection: Whitening | None) -> None:
        self.views, self.fingerprint = views_of(describe, None), fingerprint_of(describe)
        self.kept: list[np.ndarray] = []
        self._describe, self.projection = describe, projection

    def __call__(self, image: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            row = np.asarray(self._describe(image), np.float32).reshape(1, -1).astype(np.float16)
        if not np.all(np.isfinite(row)):
            raise InputError("a descriptor has a number that is not finite in half precision, which ends at 65,504")
        self.kept.append(row[0])
        return shortened(row.astype(np.float32), self.projection, self.views)[0]


def shortened(rows: np.ndarray, projection: Whitening | None, views: int) -> np.ndarray:
    """Project each view of descriptors (n, views D) to 256 components: (n, views 256)."""
    if projection is None:
        return rows
    if rows.shape[1] % views:
        raise InputError(f"descriptors of {rows.shape[1]} numbers are not of {views} views")
    return np.hstack([projection.project(view) for view in np.split(rows, views, axis=1)])


def checked_name(describer: str) -> str:
    """Check that a describer is a plain name: opening a map must not run a file that the map names."""
    if not re.fullmatch(NAME, describer):
        raise InputError(f'"{describer}" is not the name of a net; a map needs default, small or another installed net')
    return describer


def _depths(files: Sequence[Path | None], points: Points) -> np.ndarray:
    """Return the depths (P,) of all points of a session, 0 where not known or where the file cannot be read."""
    found = np.zeros(points.points.shape[0], np.float32)
    for frame, file in enumerate(files):
        local = points.of(frame)
        with suppress(InputError):
            if file is not None:
                found[points.part(frame)] = read_depths(file, local.points, local.size)
    return found


def _read_session(folder: Path) -> Session:
    arrays: dict[str, Any] = read_npz(regular(folder / "frames.npz", SESSION), SESSION)
    arrays |= {name: Rows(folder / f"{name}.npy", SESSION) for name in MAPPED}
    try:
        names = [str(name) for name in arrays["names"].reshape(-1)]
        count = len(names)
        check_array(arrays, "rows", "f", (count, arrays["rows"].size // count), finite=False)
        check_array(arrays, "stamps", "f", (count,), finite=False)
        check_array(arrays, "poses", "f", (count, 7), finite=False)
        points, depths, calibration = points_of(arrays, count, finite=False), folder / DEPTHS, folder / CALIBRATION
        known = Rows(depths, SESSION) if depths.exists() else None
        if known is not None:
            check_array({"depths": known}, "depths", "f", (int(points.ends[-1]),), finite=False)
        camera = read_intrinsics(regular(calibration, SESSION)) if calibration.exists() else None
        return Session(folder, names, arrays, points, camera, known)
    except (ValueError, LookupError, TypeError, ArithmeticError) as error:
        raise InputError(f"cannot be read ({error}); expected {SESSION}", folder) from None
