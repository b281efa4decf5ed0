"""A map on disk: a folder of sessions, each with the descriptors and points of its frames, written whole or not at all.

``map.json`` says which net describes the frames. A session is a folder ``000000``, ``000001``, ... that appears when it
is complete and never changes: whoever reads a map meanwhile reads the sessions before. ``projection.npz`` has the
principal directions of all sessions, by which long descriptors are shortened, and ``projected-N`` the descriptors that
the one learned from N frames shortened.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.descriptors.whitening import Whitening, learn_whitening
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.detector import Describe, LoopDetector, fingerprint_of, refuse_another
from loopclosure.detector.export import write_loops_csv
from loopclosure.detector.frames import Points, points_of
from loopclosure.detector.run import NAME, remember_all, run_detector, views_of
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.index.index import INDEXES, open_index
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import Progress, silent
from netspec.files.arrays import Rows, check_array, read_npz, regular
from netspec.files.whole_file import only_one, whole_file, whole_folder, write_whole

FORMAT = 1
SESSION = "a session of a map that loopclosure map wrote"
METRIC = "euclidean"
COMPONENTS = 256  # of a projected descriptor
LEARNED_FROM = 2048  # frames, evenly spread; fewer are compared as they are
BLOCK = 4096  # frames that are read at a time
Decide = Callable[[LoopDetector], list[LoopResult]]
# Of the nets of versions 0.2.0 and 0.3.0, whose maps do not say it.
OLDER = {"default": "63cb899e0703cb96", "small": "2e195dd29a635c6c"}
MAPPED = ("rows", "points", "descriptors")  # arrays in files of their own, read where they are used


@dataclass(frozen=True)
class Session:
    """N frames of a map: their names, and what its files have of them."""

    folder: Path
    names: list[str]
    arrays: dict[str, Any]
    points: Points

    def blocks(self, start: int = 0, projection: Whitening | None = None, views: int = 1) -> Iterator[np.ndarray]:
        """Yield the descriptors (n, views D) float32 from frame ``start`` on, each view projected by itself."""
        kept = None if projection is None else self._projected(projection, views)
        for first in range(start, len(self.names), BLOCK):
            rows = (self.arrays["rows"] if kept is None else kept)[first : first + BLOCK].astype(np.float32)
            if not np.all(np.isfinite(rows)):
                raise InputError(f"has a number that is not finite; expected {SESSION}", self.folder / "rows.npy")
            yield rows if projection is None or kept is not None else shortened(rows, projection, views)

    def _projected(self, projection: Whitening, views: int) -> Rows | None:
        """Return the descriptors that this projection shortened before; None where they are not there."""
        try:
            kept = Rows(self.projected(projection), SESSION)
        except (ValueError, OSError):
            return None
        return kept if kept.shape == (len(self.names), views * COMPONENTS) and kept.dtype == np.float32 else None

    def projected(self, projection: Whitening) -> Path:
        """Return the file of what a projection shortens."""
        return self.folder.with_name(f"projected-{projection.images}") / f"{self.folder.name}.npy"


class Map:
    """A map; ``describer`` is the name of what describes its frames."""

    def __init__(self, folder: str | Path) -> None:
        """Open a map to read it. Raises InputError for what is none."""
        self.folder = Path(folder)
        path = self.folder / "map.json"
        try:
            about = json.loads(regular(path, "the head of a map").read_text(encoding="utf-8"))
            if about["format"] != FORMAT:
                raise InputError(f"has format {about['format']}; this version reads {FORMAT}", path)
            self.describer = checked_name(about["describer"])
        except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError("is no map; loopclosure map build makes one", self.folder) from None
        self.sessions: list[Session] = []
        self._read_sessions()

    def _read_sessions(self) -> None:
        while (self.folder / f"{len(self.sessions):06d}").is_dir():
            session = _read_session(self.folder / f"{len(self.sessions):06d}")
            session.arrays.setdefault("fingerprint", OLDER.get(self.describer, ""))
            first = [*self.sessions, session][0]
            width, expected = (each.arrays["rows"].shape[1] for each in (session, first))
            if width != expected:
                told = f"has {width} numbers a frame, that of {first.folder.name} {expected}; they are of one net"
                raise InputError(told, session.folder / "rows.npy")
            self.sessions.append(session)

    @classmethod
    def create(cls, folder: str | Path, describer: str) -> Map:
        """Make an empty map. Raises InputError where there is one already."""
        folder, describer = Path(folder), checked_name(describer)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError("is there already; loopclosure map add adds to a map", folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "map.json", json.dumps({"format": FORMAT, "describer": describer}) + "\n")
        return cls(folder)

    def __len__(self) -> int:
        return sum(len(session.names) for session in self.sessions)

    @property
    def names(self) -> list[str]:
        """The names of all frames, SESSION/NAME."""
        return [f"{session.folder.name}/{name}" for session in self.sessions for name in session.names]

    def detector(self, describe: Describe, index: str = "exact") -> LoopDetector:
        """Return a detector that has all frames, checks candidates by their geometry, and describes frames as the map.

        index  for :func:`loopclosure.index.index.open_index`; a database keeps what it has of the map already

        Raises InputError where descriptors of the net and of the map do not have the same size, or fingerprint.
        """
        return self._detector(_Described(describe, self._projection(index)), index)

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
        """Add a recording as a session; return what each of its frames found, in all sessions and in its own.

        ``decide`` says which are loops, of a detector that has all frames; None: each is decided when it comes. The
        loops are in ``loops.csv`` of the session's folder. Raises InputError, and adds nothing, where another process
        is adding.
        """
        with only_one(self.folder / ".lock", "wait until it has ended"):
            self._read_sessions()  # what others have added
            described = _Described(describe, self._projection(index))
            detector = self._detector(described, index)
            before = len(detector)
            if decide is None:
                results = run_detector(detector, recording, progress=progress)
            else:
                remember_all(detector, recording, progress=progress)
                results = decide(detector)
            recording = recording.readable()
            rows = np.array(described.kept)
            folder = self.folder / f"{len(self.sessions):06d}"
            arrays: dict[str, Any] = detector.arrays_since(before)
            with whole_folder(folder) as unfinished:
                np.save(unfinished / "rows.npy", rows)
                np.save(unfinished / "points.npy", arrays.pop("points"))
                np.save(unfinished / "descriptors.npy", arrays.pop("descriptors"))
                said = {"source": np.array(str(recording.source)), "fingerprint": np.array(described.fingerprint)}
                np.savez(unfinished / "frames.npz", names=np.array(recording.names), **said, **arrays)
                every = [*self.names, *(f"{folder.name}/{name}" for name in recording.names)]
                write_loops_csv(unfinished / "loops.csv", [r for r in results if r], detector.stamps, every)
            self._read_sessions()
            self._learn_projection(described.views)
            self._project(described.views)
        return results

    def _projection(self, index: str) -> Whitening | None:
        """Return the projection for an index in memory; a database keeps the descriptors as they are."""
        path = self.folder / "projection.npz"
        if index not in INDEXES or not path.exists():
            return None
        arrays = read_npz(regular(path, "the projection of a map"), "the projection of a map")
        try:
            size = len(arrays["mean"])
            check_array(arrays, "mean", "f", (size,))
            check_array(arrays, "projection", "f", (size, COMPONENTS))
            images = int(arrays.get("images", 0))  # files from before it do not have it
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(f"{error}; remove it, and loopclosure map add makes it again", path) from None
        return Whitening(arrays["mean"], arrays["projection"], images, 0, str(path))

    def _learn_projection(self, views: int) -> None:
        """Learn the projection, and again once there are twice as many frames."""
        count, size = len(self), self.sessions[-1].arrays["rows"].shape[1] // views
        before = self._projection("exact")
        if count < max(LEARNED_FROM, 2 * before.images if before else 0) or size <= COMPONENTS:
            return
        starts, parts = np.cumsum([0, *(len(session.names) for session in self.sessions)]), []
        for wanted in np.linspace(0, count - 1, LEARNED_FROM).round().astype(int):
            number = int(np.searchsorted(starts, wanted, side="right")) - 1
            row = int(wanted - starts[number])
            parts.append(self.sessions[number].arrays["rows"][row : row + 1].astype(np.float32))
        rows = np.concatenate(parts)
        learned = learn_whitening(rows.reshape(len(rows) * views, -1)[::views], COMPONENTS, 0.0)
        if learned.projection.shape[1] < COMPONENTS:
            return
        with whole_file(self.folder / "projection.npz") as unfinished, unfinished.open("wb") as stream:
            np.savez(stream, mean=learned.mean, projection=learned.projection, images=np.array(count))

    def _project(self, views: int) -> None:
        """Write what the projection shortens, where it is not there, so that opening need not compute it."""
        projection = self._projection("exact")
        if projection is None:
            return
        for session in self.sessions:
            path = session.projected(projection)
            if not path.exists():
                path.parent.mkdir(exist_ok=True)
                rows = np.concatenate([*session.blocks(0, projection, views)])
                with whole_file(path) as unfinished, unfinished.open("wb") as stream:
                    np.save(stream, rows)
        for folder in self.folder.glob("projected-*"):
            if folder != path.parent and re.fullmatch(r"projected-\d+", folder.name):
                with suppress(OSError):  # what is not of a map's own making stays
                    for session in self.sessions:
                        (folder / f"{session.folder.name}.npy").unlink(missing_ok=True)
                    folder.rmdir()


class _Described:
    """Describes images for a map: ``kept`` has what the net said, in half precision, as files keep it."""

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
    """Return descriptors (n, views D) projected, each view by itself: (n, views 256)."""
    if projection is None:
        return rows
    if rows.shape[1] % views:
        raise InputError(f"descriptors of {rows.shape[1]} numbers are not of {views} views")
    return np.hstack([projection.project(view) for view in np.split(rows, views, axis=1)])


def checked_name(describer: str) -> str:
    """Check that a describer is a name: opening a map must not run a file that it mentions."""
    if not re.fullmatch(NAME, describer):
        raise InputError(f'"{describer}" is no name of a net; a map needs default, small or another that is installed')
    return describer


def _read_session(folder: Path) -> Session:
    arrays: dict[str, Any] = read_npz(regular(folder / "frames.npz", SESSION), SESSION)
    arrays |= {name: Rows(folder / f"{name}.npy", SESSION) for name in MAPPED}
    try:
        names = [str(name) for name in arrays["names"].reshape(-1)]
        count = len(names)
        check_array(arrays, "rows", "f", (count, arrays["rows"].size // count), finite=False)
        check_array(arrays, "stamps", "f", (count,), finite=False)
        check_array(arrays, "poses", "f", (count, 7), finite=False)
        return Session(folder, names, arrays, points_of(arrays, count, finite=False))
    except (ValueError, LookupError, TypeError, ArithmeticError) as error:
        raise InputError(f"cannot be read ({error}); expected {SESSION}", folder) from None
