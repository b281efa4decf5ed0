"""A synthetic walk through textured rooms, in the layout of the TUM RGB-D benchmark.

The quick start and the tests use it instead of a data set to download. The camera is carried around a house
(:mod:`lmdb_build.walk.house`) several times, so that places are seen again: each lap at another time of day, with small
changes of position and direction. Poses are exact and the geometry is correct, so the paper's rule of the same place
means the same as with real images. The same seed gives the same pictures.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lmdb_build.picture import write_depth, write_jpeg
from lmdb_build.walk.house import HEIGHT_M, House, build_house
from lmdb_build.walk.render import Camera, Light, Renderer
from lmdb_build.walk.textures import Image
from loopclosure.errors import InputError
from loopclosure.places.trajectory import Poses, Trajectory, write_rgb_list, write_trajectory
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

Array = NDArray[np.float64]

SPEED_M_S = 1.2
POSES_PER_IMAGE = 10
POSE_STEP_S = 0.09  # at most; an image has no pose if the nearest one is more than 0.03 s away
EYE_HEIGHT_M = 1.5
# On laps after the first: the greatest distance and rotation from the path.
SIDE_STEP_M, TURN_DEG = 0.25, 5.0
GLANCE_DEG = 22.0  # the camera turns from side to side, in the same places on every lap
NOISE = 3.0  # standard deviation of the sensor's noise, in gray levels


@dataclass(frozen=True)
class Walk:
    """A walk of ``laps`` laps in a house of ``rooms`` rooms, with ``frames`` pictures of ``width`` x ``height`` pixels.

    ``start_s`` is the time of the first picture, in seconds. With ``depth``, each picture's depth is written too.
    """

    frames: int = 400
    width: int = 320
    height: int = 240
    laps: int = 3
    rooms: int = 4
    seed: int = 1
    start_s: float = 1000.0
    depth: bool = False

    def check(self) -> None:
        """Raise InputError for numbers out of range."""
        limits = {"frames": (2, 1_000_000), "width": (32, 4096), "height": (32, 4096), "laps": (1, 1000)}
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"a walk's {name} must be {low} to {high}, not {getattr(self, name)}")
        if not 4 <= self.rooms <= 40 or self.rooms % 2:
            raise InputError(f"a house must have an even number of rooms, 4 to 40, not {self.rooms}")
        if self.seed < 0:
            raise InputError(f"a seed must be 0 or more, not {self.seed}")

    @property
    def camera(self) -> Camera:
        """The camera, with the field of view of the benchmark's (525 pixels at a width of 640)."""
        return Camera(self.width, self.height, 525 / 640 * self.width)


def write_walk(folder: str | os.PathLike[str], walk: Walk) -> Iterator[Path]:
    """Render ``walk`` into ``folder`` (rgb/, rgb.txt, groundtruth.txt, calibration.txt), yielding each picture's path.

    Raises InputError if numbers are out of range, or if the folder has a sequence already.
    """
    walk.check()
    folder = Path(folder)
    if (folder / "rgb.txt").exists():
        raise InputError("holds a sequence already; give another folder or remove this one", folder)
    (folder / "rgb").mkdir(parents=True, exist_ok=True)
    house = build_house(walk.seed, walk.rooms)
    motion = _Motion(house, walk)
    step_s = float(motion.duration_s) / walk.frames
    times = step_s * np.arange(walk.frames, dtype=np.float64)
    # Poses are more frequent than pictures and never at the same time, as with motion capture.
    per_image = max(POSES_PER_IMAGE, math.ceil(step_s / POSE_STEP_S))
    pose_times = step_s * (np.arange(-per_image, (walk.frames + 1) * per_image) + 0.3) / per_image
    poses = motion.poses(pose_times)
    stamps = [walk.start_s + time for time in times]
    frames = [(stamp, f"rgb/{stamp:.6f}.jpg") for stamp in stamps]
    depths = [(stamp, f"depth/{stamp:.6f}.png") for stamp in stamps] if walk.depth else []
    if depths:
        (folder / "depth").mkdir(exist_ok=True)
    for number, (picture, depth) in enumerate(_pictures(house, walk, motion, times)):
        path = folder / frames[number][1]
        write_jpeg(path, picture)
        if depths:
            write_depth(folder / depths[number][1], depth)
        yield path
    camera = walk.camera
    calibration = f"# fx fy cx cy width height\n{camera.focal:g} {camera.focal:g} "
    calibration += f"{camera.center[0]:g} {camera.center[1]:g} {camera.width} {camera.height}\n"
    write_whole(folder / "calibration.txt", calibration)
    write_trajectory(
        folder / "groundtruth.txt", Trajectory(walk.start_s + pose_times, poses.positions, poses.quaternions)
    )
    if depths:
        write_rgb_list(folder / "depth.txt", depths, "depth maps")
    write_rgb_list(folder / "rgb.txt", frames)  # last: it makes the sequence complete


def _pictures(house: House, walk: Walk, motion: _Motion, times: Array) -> Iterator[tuple[Image, NDArray[np.float32]]]:
    """Yield each picture (H, W, 3), and its depth (H, W) in meters."""
    rng = np.random.default_rng([walk.seed, 4])
    noise = rng.normal(0, NOISE, (walk.height + 64, walk.width + 64, 3)).astype(np.int8)
    poses = motion.poses(times)
    rotations = Rotation.from_quat(poses.quaternions).as_matrix()
    laps = np.minimum(motion.walked_m(times) // house.way_length_m, walk.laps - 1).astype(int)
    renderer = Renderer(house, walk.camera, lap_light(walk, house, 0))
    for index, (position, rotation) in enumerate(zip(poses.positions, rotations, strict=True)):
        if index and laps[index] != laps[index - 1]:
            renderer.relight(lap_light(walk, house, laps[index]))
        picture = cv2.GaussianBlur(renderer.draw(position, rotation), (3, 3), 0.5)
        y, x = rng.integers(0, 64, 2)
        yield cv2.add(picture, noise[y : y + walk.height, x : x + walk.width], dtype=cv2.CV_8U), renderer.depth


def lap_light(walk: Walk, house: House, lap: int) -> Light:
    """Return the light of a lap. The first lap is bright; each later one has another time of day and other lamps."""
    rng = np.random.default_rng([walk.seed, 3, lap])
    day = 0.9 if lap == 0 else rng.uniform(0.25, 1.1)
    warmth = rng.uniform(-0.12, 0.12)  # blue sky or evening sun
    ambient = 0.22 + 0.45 * day * np.array([1 - warmth, 1, 1 + warmth])
    lamps = rng.uniform(0.3, 1.4, walk.rooms)[:, None] * np.array([0.78, 0.94, 1.05])
    low, high = np.reshape([room.bounds for room in house.rooms], (-1, 2, 2)).swapaxes(0, 1)
    places = np.column_stack([rng.uniform(low, high), rng.uniform(1, HEIGHT_M, walk.rooms)])
    return Light(ambient, lamps, places)


class _Motion:
    """The motion of the camera: its position and direction at any time."""

    def __init__(self, house: House, walk: Walk) -> None:
        self.house = house
        self.duration_s = walk.laps * house.way_length_m / SPEED_M_S
        rng = np.random.default_rng([walk.seed, 5])
        self._phases = rng.uniform(0, 2 * np.pi, 6)
        self._glances = int(rng.integers(7, 12))
        step = np.roll(house.way, -1, axis=0) - np.roll(house.way, 1, axis=0)
        self._yaw = _smooth_angles(np.arctan2(step[:, 1], step[:, 0]), 0.35 / house.step_m)

    def walked_m(self, times: Array) -> Array:
        """Return the distance (N,) walked at ``times`` (N,). The speed varies."""
        sway = 0.3 * np.sin(2 * np.pi * times / 11 + self._phases[0]) - 0.3 * np.sin(self._phases[0])
        return np.clip(SPEED_M_S * times + sway, 0, None)

    def poses(self, times: Array) -> Poses:
        """Return the camera's poses at ``times`` (N,) in seconds."""
        walked = self.walked_m(times)
        lap_m = self.house.way_length_m
        at = walked / self.house.step_m % len(self.house.way)
        x, y = _periodic(at, self.house.way[:, 0]), _periodic(at, self.house.way[:, 1])
        # Interpolate the direction as a vector, because the angle jumps from pi to -pi.
        along = np.arctan2(_periodic(at, np.sin(self._yaw)), _periodic(at, np.cos(self._yaw)))
        # 0 on the first lap, and 1 on the others.
        later = np.clip(walked / lap_m - 0.9, 0, 0.1) / 0.1
        side = later * SIDE_STEP_M * _sway(walked, (7.3, 17.1), self._phases[1:3])
        turn = later * TURN_DEG * _sway(walked, (9.7, 23.9), self._phases[3:5])
        glance = GLANCE_DEG * np.sin(2 * np.pi * self._glances * walked / lap_m)
        yaw = along + np.radians(turn + glance)
        stride = 2 * np.pi * times * 1.8  # 1.8 steps a second
        positions = np.column_stack(
            [x - side * np.sin(along), y + side * np.cos(along), EYE_HEIGHT_M + 0.02 * np.sin(stride)]
        )
        roll, pitch = np.radians(0.8 * np.sin(stride / 2)), np.radians(6 + 0.6 * np.sin(stride + 1))
        return Poses(positions, Rotation.from_matrix(_rotations(yaw, pitch, roll)).as_quat(canonical=True))


def _rotations(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Camera-to-world rotations (N, 3, 3): ``yaw`` from +x toward +y, ``pitch`` down, ``roll`` clockwise."""
    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    ahead = np.stack([cos * np.cos(pitch), sin * np.cos(pitch), -np.sin(pitch)], axis=-1)
    right = np.stack([sin, -cos, zero], axis=-1)
    down = np.cross(ahead, right)
    cos_roll, sin_roll = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cos_roll * right + sin_roll * down, cos_roll * down - sin_roll * right, ahead], axis=-1)


def _sway(walked: Array, periods_m: tuple[float, float], phases: Array) -> Array:
    """Return numbers (N,) from -1 to 1 that vary with the distance walked (N,).

    A lap is not a multiple of the periods, so laps differ.
    """
    return 0.6 * np.sin(2 * np.pi * walked / periods_m[0] + phases[0]) + 0.4 * np.sin(
        2 * np.pi * walked / periods_m[1] + phases[1]
    )


def _periodic(at: Array, values: Array) -> Array:
    """Interpolate a closed sequence of ``values`` (P,) at fractional indices (N,)."""
    return np.interp(at, np.arange(len(values) + 1), np.append(values, values[0]))


def _smooth_angles(angles: Array, sigma: float) -> Array:
    """Smooth a closed sequence of directions (P,) in radians with a Gaussian of ``sigma`` samples."""
    reach = np.arange(-int(4 * sigma), int(4 * sigma) + 1)
    kernel = np.exp(-0.5 * (reach / sigma) ** 2)
    vector = np.exp(1j * angles)
    rolled = np.stack([np.roll(vector, offset) for offset in reach])
    return np.angle(kernel @ rolled)
