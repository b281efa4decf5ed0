"""Where a camera was when it saw a place of a map: its pose in the frame of the poses of the matched session.

The pose is T_map_query = T_map_match T_match_query: it takes a point in meters from the camera (x to the right, y down,
z ahead) to the frame of the session's poses. T_map_match is the known pose of the matched frame or, if it has none, the
robot's odometry, which drifts; a result says which. T_match_query is measured in the two images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.measure import cells, view_of
from loopclosure.closing.relative import LEAST_INLIERS, METRIC, Relative, View, relative_view
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.export import RELATIVE, after
from loopclosure.detector.map import Map
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.places.frames import DEPTH_PER_M
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.progress import Progress, silent

POSES, ODOMETRY = "poses", "odometry"
IN_MAP = ("map_x_m", "map_y_m", "map_z_m", "map_qx", "map_qy", "map_qz", "map_qw", "map_by")
LOCATED = (*RELATIVE, *IN_MAP)


@dataclass(frozen=True)
class Located:
    """Where the camera was by one match.

    match     the number of the matched frame in the map
    relative  the measured pose of the query in the frame of its match, T_match_query
    pose      (7,) T_map_query, tx ty tz in meters and qx qy qz qw; the position is NaN if ``relative`` is not metric.
              None if the matched frame has no pose
    by        "poses" or "odometry": the path of the session that ``pose`` is relative to; "" without a pose
    """

    match: int
    relative: Relative
    pose: np.ndarray | None
    by: str

    def cells(self) -> list[object]:
        """Return the cells of the columns LOCATED in loops.csv; empty where nothing is known."""
        place = [""] * 7 if self.pose is None else ["" if np.isnan(v) else f"{v:.6f}" for v in self.pose]
        return [*cells(self.relative), *place, self.by]


class Locator:
    """Measures where a calibrated camera was in a map."""

    def __init__(self, known: Map, camera: Intrinsics) -> None:
        self.map, self.camera, self.check = known, camera, GeometricCheck()

    def locate(
        self, image: np.ndarray, match: int, depth: Path | None = None, depth_per_m: float = DEPTH_PER_M
    ) -> Located | None:
        """Return where the camera was for an image (H, W, 3) uint8 BGR that shows the place of frame ``match``.

        ``depth`` is the file of its depth, ``depth_per_m`` for a meter, if there is one. None if fewer than 20 points
        agree or if the session of the match has no camera. Raises InputError if there is no such frame.
        """
        session, frame = self.map.session_of(match)
        if session.camera is None:
            return None
        local = session.points.of(frame)
        seen = View(local, session.camera.of_size(*local.size), session.depths_of(frame))
        query = view_of(self.check, self.camera, image, depth, depth_per_m)
        relative = relative_view(seen, query, self.check.matches(seen.local, query.local))
        if relative is None:
            return None
        for by in (POSES, ODOMETRY):
            path = session.arrays.get(by)
            if path is not None and np.isfinite(path[frame]).all():
                pose = after(path[frame], relative.pose)
                if relative.kind != METRIC:
                    pose[:3] = np.nan
                return Located(match, relative, pose, by)
        return Located(match, relative, None, "")

    def locate_all(
        self, recording: ImageSequence, loops: Sequence[LoopResult], progress: Progress = silent
    ) -> dict[int, Located]:
        """Return query -> where the camera was, for the accepted frames of a recording whose pose is measured."""
        matches = {loop.query: loop.match for loop in loops if loop.match is not None}
        found = {}
        for frame, image, _ in progress(recording.frames(matches), "locating", len(matches)):
            depth = None if recording.depths is None else recording.depths[frame]
            try:
                located = self.locate(image, matches[frame], depth, recording.depth_per_m)
            except InputError:  # its depth cannot be read
                located = self.locate(image, matches[frame])
            if located is not None:
                found[frame] = located
        return found


def located_said(found: Mapping[int, Located], loops: Sequence[LoopResult], locator: Locator) -> list[str]:
    """Return sentences: how many loops have a pose in the map, and why others have none."""
    said = []
    for by, words in ((POSES, "in the frame of the map's poses"), (ODOMETRY, "by the map's odometry, which drifts")):
        poses = [each.pose for each in found.values() if each.by == by and each.pose is not None]
        if poses:
            whole = sum(bool(np.isfinite(pose).all()) for pose in poses)
            said.append(f"located {words}: {whole} with position and rotation, {len(poses) - whole} with rotation only")
    if bare := sum(each.pose is None for each in found.values()):
        said.append(f"not located: {bare}, whose matches have no poses; their relative poses are in loops.csv")
    sessions = [locator.map.session_of(loop.match)[0] for loop in loops if loop.match is not None]
    without = [session.folder.name for session in sessions if session.camera is None]
    if without:
        names = ", ".join(sorted(set(without)))
        said.append(f"not located: {len(without)}, matched in {names}, where the map has no calibration of the camera")
    if few := len(loops) - len(found) - len(without):
        said.append(f"not located: {few}, with fewer than {LEAST_INLIERS} points that agree with one pose")
    return said


def place_errors_said(found: Mapping[int, Located], poses: np.ndarray) -> str:
    """Return a sentence with the median errors of located frames by their true poses (N, 7); empty if none is known.

    The true poses must be in the frame of the map's. Frames that were located by odometry are not judged.
    """
    shifts, turns = [], []
    for frame, each in found.items():
        true = poses[frame]
        if each.by != POSES or each.pose is None or not np.isfinite(true).all():
            continue
        turn = Rotation.from_quat(true[3:]).inv() * Rotation.from_quat(each.pose[3:])
        turns.append(np.rad2deg(turn.magnitude()))
        if each.relative.kind == METRIC:
            shifts.append(np.linalg.norm(each.pose[:3] - true[:3]))
    if not turns:
        return ""
    position = f"position {np.median(shifts):.2g} m (of {len(shifts)}), " if shifts else ""
    of = "if the poses of the query are in the frame of the map's"
    return f"median errors of the {len(turns)} located frames, {of}: {position}rotation {np.median(turns):.2g} degrees"
