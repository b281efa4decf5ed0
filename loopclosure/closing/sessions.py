"""Joins the sessions of a map: their paths and loops become one pose graph, and each path is corrected in one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation

from loopclosure.closing.close import Closed, close, write_graph
from loopclosure.closing.length import measured, neighbors
from loopclosure.closing.measure import Loop, loop_rows, whole_number
from loopclosure.closing.relative import View
from loopclosure.detector.export import STILL, after, relative_pose
from loopclosure.detector.map import SESSION, Map, Session
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.trajectory import pieces, write_trajectory
from loopclosure.progress import Progress, silent

MOST_TRIED = 200  # loops of two sessions that are tried as the one that places them


@dataclass(frozen=True)
class ClosedMap:
    """The sessions of a map after their loops were closed.

    closed  the graph; its frames are those of the map that have a pose, and ``odometry`` has the paths of the sessions,
            placed by one of their loops
    starts  the first frame of each session
    parts   (S,) the part of each session: sessions in one part are joined by loops that are used, in one frame
    """

    known: Map
    closed: Closed
    starts: np.ndarray
    parts: np.ndarray

    def said(self) -> list[str]:
        """Return sentences about sessions that are not in the frame of the first one, or have no path."""
        names = np.array([session.folder.name for session in self.known.sessions])
        apart = names[self.parts != self.parts[0]]
        joined = f"{len(names) - len(apart)} of {len(names)} sessions are in one frame, that of {names[0]}"
        return [
            joined,
            *([f"no loop joins them, so each is in its own frame: {', '.join(apart)}"] if len(apart) else []),
        ]


def close_map(known: Map, progress: Progress = silent) -> ClosedMap:
    """Measure the loops of a map in its stored points, and solve the graph of all its sessions.

    The path of a session is its odometry or, if it has none, its poses. Raises InputError if fewer than two frames have
    one, or if no session has a calibration of its camera.
    """
    sessions = known.sessions
    starts = np.cumsum([0, *(len(session.names) for session in sessions)])
    path, truth = np.full((len(known), 7), np.nan), np.full((len(known), 7), np.nan)
    for session, begin in zip(sessions, starts, strict=False):
        poses, odometry = session.arrays["poses"], session.arrays.get("odometry")
        driven = odometry is not None and bool(np.isfinite(odometry).any())
        path[begin : begin + len(poses)] = odometry if driven else poses
        truth[begin : begin + len(poses)] = poses if driven else np.nan
    if all(session.camera is None for session in sessions):
        raise InputError("has no calibration of a camera; build it again, with --camera", known.folder)
    loops = _measured(known, starts, path, progress)
    placed = _placed(path, loops, starts)
    true = truth if np.isfinite(truth).any() else None
    closed = close(placed, loops, true, starts)
    used = [loop for loop, accepted in zip(closed.loops, closed.accepted, strict=True) if accepted]
    return ClosedMap(known, closed, starts[:-1], _parts(used, starts))


def write_closed_map(out: Path, found: ClosedMap) -> None:
    """Write the path of each session in TUM's format, closed.g2o and loops.csv; numbers are frames of the map.

    Frames without a time have their numbers in the session instead.
    """
    closed, poses = found.closed, np.full((len(found.known), 7), np.nan)
    poses[closed.frames] = closed.poses
    write_graph(out, closed, found.known.names)
    for session, begin in zip(found.known.sessions, found.starts.tolist(), strict=True):
        own, stamps = poses[begin : begin + len(session.names)], np.asarray(session.arrays["stamps"])
        kept = np.isfinite(own).all(axis=1)
        times = np.where(np.isfinite(stamps), stamps, np.arange(len(own)))[kept]
        write_trajectory(out / f"{session.folder.name}.txt", times, own[kept], "corrected")


def _measured(known: Map, starts: np.ndarray, path: np.ndarray, progress: Progress) -> list[Loop]:
    """Return the loops of all sessions with their relative poses, None where they cannot be measured."""
    check, drives = GeometricCheck(), pieces(path, starts=starts)

    def view(frame: int) -> View | None:
        session, own = known.session_of(frame)
        local = session.points.of(own)
        camera = None if session.camera is None else session.camera.of_size(*local.size)
        return None if camera is None else View(local, camera, session.depths_of(own))

    def around(frame: int) -> Iterator[tuple[View, float]]:
        number = int(_session_of([frame], starts)[0])
        begin = int(starts[number])
        own = slice(begin, int(starts[number + 1]))
        for near, length in neighbors(path[own], frame - begin, drives[own]):
            beside = view(begin + near)
            if beside is not None:
                yield beside, length

    loops = [loop for number, session in enumerate(known.sessions) for loop in _loops_of(session, starts, number)]
    found = []
    for loop in progress(loops, "measuring loops", len(loops)):
        match, query = view(loop.match), view(loop.query)
        relative = None
        if match is not None and query is not None:
            relative = measured((match, query), (around(loop.match), around(loop.query)), check.matches)
        found.append(Loop(loop.query, loop.match, relative))
    return found


def _loops_of(session: Session, starts: np.ndarray, number: int) -> list[Loop]:
    """Read the loops of a session; frames are numbered as in the map. Raises InputError for another file."""
    path = session.folder / "loops.csv"
    loops = []
    for line, row in loop_rows(path, SESSION):
        ends = (whole_number(row[f"{end}_id"], int(starts[number + 1]), path, line) for end in ("query", "match"))
        query, match = ends
        if not match < query or query < starts[number]:
            raise InputError(f"joins frames {query} and {match}, which this session does not", path, line, 1)
        loops.append(Loop(query, match))
    return loops


def _session_of(frames: Sequence[int] | np.ndarray, starts: np.ndarray) -> np.ndarray:
    return np.searchsorted(starts, np.asarray(frames, int), side="right") - 1


def _placed(path: np.ndarray, loops: Sequence[Loop], starts: np.ndarray) -> np.ndarray:
    """Return the paths (N, 7) with each session moved to where a loop with an earlier placed one says that it is.

    Of the loops between two sessions, that one counts with which most others agree. The solution starts from there.
    """
    path = path.copy()
    known = set(np.flatnonzero(np.isfinite(path).all(axis=1)).tolist())
    measured = [loop for loop in loops if loop.relative is not None and {loop.query, loop.match} <= known]
    ends = _session_of([end for loop in measured for end in (loop.query, loop.match)], starts).reshape(-1, 2)
    placed: set[int] = set()
    while len(placed) < len(starts) - 1:
        joining: dict[tuple[int, int], list[Loop]] = {}
        for loop, (query, match) in zip(measured, ends.tolist(), strict=True):
            if (query in placed) != (match in placed):
                joining.setdefault((match, query) if match in placed else (query, match), []).append(loop)
        if not joining:
            placed.add(min(set(range(len(starts) - 1)) - placed))
            continue
        (_, moved), between = max(joining.items(), key=lambda item: len(item[1]))
        rows = slice(int(starts[moved]), int(starts[moved + 1]))
        path[rows] = after(_motion(path, between, moved, starts), path[rows])
        placed.add(moved)
    return path


def _motion(path: np.ndarray, loops: Sequence[Loop], moved: int, starts: np.ndarray) -> np.ndarray:
    """Return the motion (7,) of session ``moved`` that most of its ``loops`` with another session agree with."""
    here, there = [], []  # the pose of the frame of the moved session: by its path, and by the other session's
    for loop in loops:
        assert loop.relative is not None
        if _session_of([loop.query], starts)[0] == moved:
            here.append(path[loop.query])
            there.append(after(path[loop.match], loop.relative.pose))
        else:
            here.append(path[loop.match])
            there.append(after(path[loop.query], relative_pose(loop.relative.pose, STILL)))
    own, wanted = np.array(here), np.array(there)
    best, most = STILL, -1
    for number in np.unique(np.linspace(0, len(loops) - 1, MOST_TRIED).round().astype(int)).tolist():
        motion = after(wanted[number], relative_pose(own[number], STILL))
        off = relative_pose(after(motion, own), wanted)
        near = np.linalg.norm(off[:, :3], axis=1) < MAX_DISTANCE_M
        agree = int(np.count_nonzero(near & (np.degrees(Rotation.from_quat(off[:, 3:]).magnitude()) < MAX_ANGLE_DEG)))
        if agree > most:
            best, most = motion, agree
    return best


def _parts(loops: Sequence[Loop], starts: np.ndarray) -> np.ndarray:
    count = len(starts) - 1
    ends = _session_of([end for loop in loops for end in (loop.query, loop.match)], starts).reshape(-1, 2)
    joined = sparse.coo_matrix((np.ones(len(ends)), tuple(ends.T)), (count, count))
    return csgraph.connected_components(joined, directed=False)[1]
