"""A synthetic walk through textured rooms, in the layout of the TUM RGB-D benchmark.

The quick start and the tests use it instead of a data set to download. The camera is carried around a house
(:mod:`lmdb_build.walk.house`) several times, so that places are seen again: each lap at another time of day, with small
changes of position and direction. Poses are exact and the geometry is correct, so the paper's rule of the same place
means the same as with real images. The same seed gives the same pictures.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lmdb_build.picture import write_depth, write_jpeg
from lmdb_build.walk.house import House, build_house
from lmdb_build.walk.render import Renderer
from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics, write_calibration
from loopclosure.places.trajectory import write_rgb_list, write_trajectory
from netspec.files.opencv import cv2

Array = NDArray[np.float64]

SPEED_M_S = 1.2
EYE_HEIGHT_M = 1.5
# On laps after the first: the greatest distance and rotation from the path.
SIDE_STEP_M, TURN_DEG = 0.25, 5.0
GLANCE_DEG, GLANCES = 22.0, 9  # the camera turns from side to side, in the same places on every lap
PITCH_DEG = 6.0  # down
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
        limits = {"frames": (2, 10**6), "width": (32, 4096), "height": (32, 4096), "laps": (1, 1000), "rooms": (4, 40)}
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"a walk's {name} must be {low} to {high}, not {getattr(self, name)}")
        if self.rooms % 2:
            raise InputError(f"a house must have an even number of rooms, not {self.rooms}")

    @property
    def camera(self) -> Intrinsics:
        """The camera, with the field of view of the benchmark's (525 pixels at a width of 640)."""
        focal = 525 / 640 * self.width
        return Intrinsics(focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, size=(self.width, self.height))


def write_walk(folder: str | os.PathLike[str], walk: Walk) -> Iterator[Path]:
    """Render ``walk`` into ``folder`` (rgb/, rgb.txt, groundtruth.txt, calibration.txt), yielding each picture's path.

    Raises InputError if numbers are out of range, or if the folder has a sequence already.
    """
    walk.check()
    folder = Path(folder)
    if (folder / "rgb.txt").exists():
        raise InputError("holds a sequence already; give another folder or remove this one", folder)
    for name in ("rgb", "depth") if walk.depth else ("rgb",):
        (folder / name).mkdir(parents=True, exist_ok=True)
    house = build_house(walk.seed, walk.rooms)
    walked = np.arange(walk.frames) * walk.laps * house.lap_m / walk.frames
    poses = _poses(house, walk, walked)
    rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
    stamps = walk.start_s + walked / SPEED_M_S
    frames = [(stamp, f"rgb/{stamp:.6f}.jpg") for stamp in stamps]
    depths = [(stamp, f"depth/{stamp:.6f}.png") for stamp in stamps]
    rng, lap_before, renderer = np.random.default_rng([walk.seed, 4]), -1, None
    for i, lap in enumerate((walked // house.lap_m).astype(int)):
        if renderer is None or lap != lap_before:
            renderer, lap_before = Renderer(house, walk.camera, _light(walk, lap)), lap
        picture, depth = renderer.draw(poses[i, :3], rotations[i])
        noise = rng.normal(0, NOISE, picture.shape).astype(np.int8)
        write_jpeg(folder / frames[i][1], cv2.add(picture, noise, dtype=cv2.CV_8U))
        if walk.depth:
            write_depth(folder / depths[i][1], depth)
        yield folder / frames[i][1]
    write_calibration(folder / "calibration.txt", walk.camera)
    write_trajectory(folder / "groundtruth.txt", stamps, poses)
    if walk.depth:
        write_rgb_list(folder / "depth.txt", depths, "depth maps")
    write_rgb_list(folder / "rgb.txt", frames)  # last: it makes the sequence complete


def _light(walk: Walk, lap: int) -> Array:
    """Return the light of a lap (rooms, 3): the first is bright, each later one has another time of day."""
    rng = np.random.default_rng([walk.seed, 3, lap])
    warmth = rng.uniform(-0.15, 0.15)  # blue sky or evening sun
    lamps = rng.uniform(0.5, 1.2, (walk.rooms, 1)) if lap else np.ones((walk.rooms, 1))
    return lamps * np.array([1 - warmth, 1, 1 + warmth])


def _poses(house: House, walk: Walk, walked: Array) -> Array:
    """Return the camera's poses (N, 7) after so many meters (N,)."""
    rng = np.random.default_rng([walk.seed, 5])
    lap_m, count = house.lap_m, len(house.way)

    def position(meters: Array) -> Array:
        at = meters / lap_m * count
        return np.column_stack([np.interp(at % count, np.arange(count + 1), [*x, x[0]]) for x in house.way.T])

    ahead = position(walked + 0.4) - position(walked - 0.4)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    later = np.clip(walked / lap_m - 0.9, 0, 0.1) / 0.1  # 0 on the first lap, and 1 on the others
    aside, sway = later * np.sin(2 * np.pi * walked / np.array([[7.3], [9.7]]) + rng.uniform(0, 6, (2, 1)))
    x, y = position(walked).T
    glance = GLANCE_DEG * np.sin(2 * np.pi * GLANCES * walked / lap_m)
    aside *= SIDE_STEP_M
    positions = np.column_stack([x - aside * np.sin(yaw), y + aside * np.cos(yaw), np.full(len(x), EYE_HEIGHT_M)])
    # Of a camera that looks along +x: to the right is -y, down is -z. It looks down, then turns about the vertical.
    level = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    angles = np.degrees(yaw) + TURN_DEG * sway + glance, np.full(len(x), PITCH_DEG)
    turned = Rotation.from_euler("ZY", np.column_stack(angles), degrees=True)
    return np.hstack([positions, (turned * level).as_quat(canonical=True)])
