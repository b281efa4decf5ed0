"""Closes the loops of a robot while it drives: keyframes, loops as constraints of a pose graph, the corrected path.

    closer = LoopCloser(LoopDetector(exclude_seconds=10), camera)
    closer.start()
    for stamp, image, pose in robot:  # the pose of the robot by its wheels
        closer.add(image, stamp, pose)
        closer.correction  # the frame of the odometry in the map; map -> odom in ROS

A thread of its own solves the graph; an image waits at most for a step of GTSAM. With GTSAM, it continues from the
solution before; without, it solves the whole graph again. The class knows nothing of ROS; ``examples/ros2_node.py`` is
a node around it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Event, Lock, Thread

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.close import Closed, constraint, loop_edges
from loopclosure.closing.graph import Edge, cross_matrices, solve
from loopclosure.closing.incremental import IncrementalSolver, installed
from loopclosure.closing.length import FARTHEST, measured, neighbors
from loopclosure.closing.measure import Loop
from loopclosure.closing.relative import METRIC, View
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import STILL, after, information_of_step, relative_pose
from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.trajectory import jumps
from netspec import log

FORWARD = np.array([0, 0, 0, -0.5, 0.5, -0.5, 0.5])  # a camera that looks along the robot's x axis; y is left, z is up
# A stamp this much earlier than the one before it begins another drive: a recording starts again. A smaller step back
# is an image that came late.
ANOTHER_DRIVE_S = 1.0
COMPARED = 100  # keyframes that a step is compared with
UNKNOWN = 1e6  # the variance of a position that a loop does not measure


@dataclass
class _Graph:
    """The keyframes so far: their stamps, poses by the odometry, drives, and edges. Poses are of the camera."""

    stamps: list[float] = field(default_factory=list)
    odometry: list[np.ndarray] = field(default_factory=list)
    drives: list[int] = field(default_factory=list)
    steps: list[Edge] = field(default_factory=list)
    loops: list[Loop] = field(default_factory=list)


class LoopCloser:
    """Closes the loops of a robot while it drives; what a sensor sends wrong is warned of and left out.

    detector   an empty one with a geometric check, which finds the points that measure its loops
    camera     the intrinsics of the images; ``camera.size`` may differ from theirs
    mount      pose (7,) of the camera in the frame of the robot, tx ty tz qx qy qz qw
    step_m, turn_rad  the least motion between keyframes, which are looked up and become nodes of the graph
    warn       gets a sentence for each image that is left out

    ``correction`` is the pose (7,) of the odometry's frame in the map, by the last of the ``solutions`` of the graph.
    """

    def __init__(
        self,
        detector: LoopDetector,
        camera: Intrinsics,
        mount: Sequence[float] | np.ndarray = FORWARD,
        step_m: float = 0.1,
        turn_rad: float = 0.1,
        warn: Callable[[str], None] = log.logger.warning,
    ) -> None:
        if len(detector) or detector.check is None:
            raise InputError("loops are closed from the first keyframe on: the detector must be empty and have a check")
        self.detector, self.camera, self.warn = detector, camera, warn
        self.mount = np.asarray(mount, np.float64)
        self.step_m, self.turn_rad = step_m, turn_rad
        self._graph, self._lock, self._solving = _Graph(), Lock(), Lock()
        self._solve = IncrementalSolver().solve if installed() else solve
        self._solved, self._accepted = np.zeros((0, 7)), np.zeros(0, bool)
        self.correction, self.solutions = STILL, 0
        self._new, self._stop, self._thread = Event(), Event(), None

    def add(self, image: np.ndarray, stamp: float, odometry: Sequence[float] | np.ndarray) -> list[Loop]:
        """Add an image (H, W, 3) uint8 BGR, taken at ``stamp`` seconds where the robot had this pose (7,).

        Returns the loops that become known with it, each measured from its two images: its own, and those of the ten
        keyframes before it that its sequence supports. There are none if the robot has hardly moved.
        """
        pose = np.asarray(odometry, np.float64).reshape(-1)
        if pose.shape != (7,) or not np.all(np.isfinite(pose)) or not np.any(pose[3:]):
            self.warn(f"the odometry at {stamp:.6f} is {pose}, not a pose; the image is left out")
            return []
        pose = after(pose, self.mount)
        graph, another = self._graph, False
        if graph.stamps:
            back = graph.stamps[-1] - stamp
            another = back > ANOTHER_DRIVE_S
            if not another and back > 0:
                self.warn(f"an image came late, {back:.3f} s before the one that was seen last; it is left out")
                return []
            step = relative_pose(graph.odometry[-1], pose)
            if another:
                self.warn(f"the time goes back by {back:.1f} s, to {stamp:.6f}: another drive begins")
            elif not self._moved(step):
                return []
            elif another := self._jumps(stamp, pose):
                far = np.linalg.norm(step[:3])
                self.warn(f"the odometry jumps by {far:.3g} m at {stamp:.6f}: another drive begins")
            if another:
                self.detector.begin_session()
        try:
            found = self.detector.add(image, stamp, odometry=pose)
        except InputError as fault:
            self.warn(f"the image at {stamp:.6f} is left out: {fault.message}")
            return []
        number, drive = len(self.detector) - 1, (graph.drives[-1] if graph.drives else 0) + another
        measured = [self._measured(each.query, each.match, image, (pose, drive)) for each in found]
        loops = [loop for loop in measured if loop is not None]
        with self._lock:
            if number and not another:
                step = relative_pose(graph.odometry[-1], pose)
                graph.steps.append(Edge(number - 1, number, step, information_of_step(step)))
            graph.stamps.append(stamp)
            graph.odometry.append(pose)
            graph.drives.append(drive)
            graph.loops += loops
        if loops:
            self._new.set()
        return loops

    def _moved(self, step: np.ndarray) -> bool:
        turn = float(Rotation.from_quat(step[3:]).magnitude())
        return float(np.linalg.norm(step[:3])) >= self.step_m or turn >= self.turn_rad

    def _jumps(self, stamp: float, pose: np.ndarray) -> bool:
        """Return whether the odometry was reset before the next keyframe."""
        graph = self._graph
        begin = max(graph.drives.index(graph.drives[-1]), len(graph.drives) - COMPARED)
        path = np.array([*graph.odometry[begin:], pose])
        return bool(jumps(path, np.array([*graph.stamps[begin:], stamp]))[-1])

    def _measured(
        self, query: int, match: int | None, image: np.ndarray, newest: tuple[np.ndarray, int]
    ) -> Loop | None:
        """Measure a loop; ``image`` has the size of all images, ``newest`` is the pose and drive of its keyframe."""
        assert match is not None
        camera = self.camera.of_size(image.shape[1], image.shape[0])
        first, second = (View(self.detector.local_features(frame), camera) for frame in (match, query))
        assert self.detector.check is not None
        path, drives = [*self._graph.odometry, newest[0]], [*self._graph.drives, newest[1]]

        def around(frame: int) -> Iterator[tuple[View, float]]:
            begin = max(0, frame - FARTHEST)
            near = slice(begin, frame + FARTHEST + 1)
            for number, length in neighbors(np.array(path[near]), frame - begin, np.array(drives[near])):
                yield View(self.detector.local_features(begin + number), camera), length

        relative = measured((first, second), (around(match), around(query)), self.detector.check.matches)
        return None if relative is None else Loop(query, match, relative)

    def path(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the stamps (N,) of all keyframes, and the corrected poses (N, 7) of the robot in the map."""
        with self._lock:
            stamps, poses = np.array(self._graph.stamps), self._corrected(self._odometry())
        return stamps, after(poses, _inverse(self.mount))

    def stamp(self, keyframe: int) -> float:
        """Return when the image of a keyframe was taken, in seconds."""
        return self._graph.stamps[keyframe]

    def by_loop(self, loop: Loop) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose (7,) of the robot in the map by one loop, and its covariance (6, 6): x y z, then rotation.

        The covariance is that of the measured loop, about the axes of the map, as in messages of ROS; errors of the
        corrected path come on top. The position is that of the path where the length of the loop's translation is not
        known, and its variance is UNKNOWN there.
        """
        assert loop.relative is not None
        with self._lock:
            poses = self._corrected(self._odometry())
        pose = after(poses[loop.match], loop.relative.pose)
        if loop.relative.kind != METRIC:
            pose[:3] = poses[loop.query, :3]
        robot = after(pose, _inverse(self.mount))
        # The measured directions are those in which the edge of the loop has information.
        values, vectors = np.linalg.eigh(constraint(loop.relative)[1])
        variances = 1 / np.maximum(values, 1 / UNKNOWN)
        # From the frame of the camera to the axes of the map, at the position of the robot.
        turn = Rotation.from_quat(pose[3:]).as_matrix()
        moving = np.eye(6)
        moving[:3, 3:] = cross_matrices((pose[:3] - robot[:3])[None])[0]
        moving = moving @ np.kron(np.eye(2), turn)
        return robot, moving @ (vectors * variances) @ vectors.T @ moving.T

    def _corrected(self, odometry: np.ndarray) -> np.ndarray:
        return np.concatenate([self._solved, after(self.correction, odometry[len(self._solved) :])])

    def closed(self) -> Closed:
        """Solve the graph, and return the path and the loops, which ``write_closed`` writes."""
        self.solve()
        with self._lock:
            graph = self._graph
            count = len(self._solved)
            kept = graph.loops[: len(self._accepted)]
            return Closed(
                np.arange(count),
                self._odometry()[:count],
                self._solved,
                [step for step in graph.steps if step.second < count],
                loop_edges(kept, range(count)),
                kept,
                self._accepted,
                0,
            )

    def solve(self) -> None:
        """Solve the graph of all keyframes so far, and set the correction."""
        with self._solving:  # one after the other: an incremental solver continues from the one before
            with self._lock:
                odometry, steps, loops = self._odometry(), list(self._graph.steps), list(self._graph.loops)
                start = self._corrected(odometry)
            if not len(odometry):
                return
            found = self._solve(start, steps, loop_edges(loops, range(len(odometry))))
            with self._lock:
                self._solved, self._accepted = found.poses, found.accepted
                # The robot's, not the camera's: both have the same motion, so the mount cancels out.
                self.correction = after(found.poses[-1], _inverse(odometry[-1]))
                self.solutions += 1

    def _odometry(self) -> np.ndarray:
        return np.array(self._graph.odometry).reshape(-1, 7)

    def start(self) -> LoopCloser:
        """Start the thread that solves the graph when a loop is new, at most half of the time; return the closer."""
        self._thread = Thread(target=self._run, name="pose graph", daemon=True)
        self._thread.start()
        return self

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._new.wait(0.2):
                self._new.clear()
                begin = time.monotonic()
                try:
                    self.solve()
                except Exception as fault:  # a robot drives on, with the solution before
                    self.warn(f"the pose graph was not solved: {type(fault).__name__}: {fault}")
                self._stop.wait(time.monotonic() - begin)

    def stop(self) -> None:
        """End the thread, after the solution that it works on."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()


def _inverse(pose: np.ndarray) -> np.ndarray:
    return relative_pose(pose, STILL)
