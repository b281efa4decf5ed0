"""The synthetic house: a ring of rooms, as textured rectangles in space, and the path through them.

World: meters, x and y on the floor, z up. Everything follows from the seed.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netspec.files.opencv import cv2

Image = NDArray[Any]  # (H, W, 3) uint8, BGR; OpenCV does not declare its type
Vector = NDArray[np.float64]
Color = tuple[float, float, float]

PIXELS_PER_METER = 96
HEIGHT_M = 2.6
DOOR_WIDTH_M = 1.1
STEP_M = 0.05  # between the points of the path
CLEARANCE_M = 0.55  # between the path and boxes
PLACE_M = 1.0  # along a wall, for a box and a picture above it


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: its upper left corner (3,), and the edges (3,) along the texture's rows and columns.

    It is visible from the side to which ``down`` x ``right`` points.
    """

    origin: Vector
    right: Vector
    down: Vector
    texture: Image
    room: int


class Wall(NamedTuple):
    """A wall as seen from inside: its left end (2,), unit directions (2,) to the right and inward, its length in m."""

    start: Vector
    right: Vector
    inward: Vector
    length: float
    door: bool  # in its middle

    def at(self, along: float, inward: float, z: float) -> Vector:
        """Return the point (3,) in the world of coordinates along the wall."""
        return np.append(self.start + along * self.right + inward * self.inward, z)


@dataclass(frozen=True)
class Room:
    """A room: its number, its corners [[x0, y0], [x1, y1]] in meters, the directions (2,) in and out by its doors."""

    index: int
    corners: Vector
    entry: Vector
    exit: Vector

    @property
    def walls(self) -> list[Wall]:
        """South, east, north, west."""
        (x0, y0), (x1, y1) = self.corners
        inward = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
        starts = np.array([[x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        # From inside, the view is along -inward; right is that direction crossed with up.
        rights = np.column_stack([-inward[:, 1], inward[:, 0]])
        doors = (inward @ self.entry > 0) | (inward @ self.exit < 0)
        return [Wall(*each) for each in zip(starts, rights, inward, [x1 - x0, y1 - y0] * 2, doors, strict=True)]


@dataclass(frozen=True)
class House:
    """All surfaces, the rooms, and the closed path (P, 2) of ``lap_m`` meters through every room, at equal steps."""

    quads: list[Quad]
    rooms: list[Room]
    way: Vector
    lap_m: float


def build_house(seed: int, rooms: int = 4) -> House:
    """Make a house of an even number of ``rooms`` (4 or more) in two rows, joined by doors into a ring."""
    assert rooms >= 4
    assert rooms % 2 == 0
    rng = np.random.default_rng([seed, 1])
    size = rng.uniform(3.9, 5.0, 2)
    columns = range(rooms // 2)
    cells = np.array([(column, 0) for column in columns] + [(column, 1) for column in reversed(columns)], float)
    out = np.roll(cells, -1, axis=0) - cells  # the direction from each room to the next
    corners = [np.array([cell, cell + 1]) * size for cell in cells]
    plan = [Room(i, corners[i], out[i - 1], out[i]) for i in range(rooms)]
    way, lap_m = _way(rng, plan)
    kind, hue = int(rng.integers(6)), rng.uniform()
    quads: list[Quad] = []
    for room in plan:
        # Hues are spread evenly over the house, so that no two rooms have the same color.
        own = np.random.default_rng([seed, 2, room.index])
        quads += _surfaces(own, room, kind + room.index, hue + room.index / rooms, way)
    return House(quads, plan, way, lap_m)


def _way(rng: np.random.Generator, plan: list[Room]) -> tuple[Vector, float]:
    """Return a path straight through each door and around each room: (P, 2) points, and its length in m."""
    stops = []
    for room in plan:
        middle, half = room.corners.mean(axis=0), np.ptp(room.corners, axis=0) / 2
        # Not straight from door to door, so that each room is seen from several sides.
        corner = middle + 0.35 * (room.entry - room.exit) + rng.uniform(-0.2, 0.2, 2)
        enter, leave = middle - half * room.entry, middle + half * room.exit
        stops += [enter + 0.7 * room.entry, corner, leave - 0.7 * room.exit, leave]
    line = np.array(stops)
    for _ in range(4):  # Chaikin: cutting corners gives a smooth closed curve
        following = np.roll(line, -1, axis=0)
        line = np.stack([0.75 * line + 0.25 * following, 0.25 * line + 0.75 * following], axis=1).reshape(-1, 2)
    closed = np.vstack([line, line[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = round(along[-1] / STEP_M)
    at = np.arange(count) * along[-1] / count
    return np.column_stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)]), along[-1]


def _surfaces(rng: np.random.Generator, room: Room, kind: int, hue: float, way: Vector) -> list[Quad]:
    """Return all surfaces of one room: walls with boxes and pictures, floor and ceiling."""
    base, deep = color(hue, 0.35, 0.85), color(hue, 0.55, 0.6)
    tints, size = (((base, deep), (0.3, HEIGHT_M)), ((deep,), (0.25, 0.085)), ((base, deep), (0.33, 0.33)))[kind % 3]
    quads = []
    for wall in room.walls:
        quads += _wall(room.index, wall, tiles(rng, wall.length, HEIGHT_M, tints, size))
        for middle in np.arange(1.3, wall.length - 1.25, PLACE_M):  # away from the corners and from a door
            if not wall.door or abs(middle - wall.length / 2) > (DOOR_WIDTH_M + PLACE_M) / 2:
                quads += _box(rng, room.index, wall, middle, hue, way)
                quads += _picture(rng, room.index, wall, middle)
    (x0, y0), (x1, y1) = room.corners
    across, along = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
    boards = tiles(rng, x1 - x0, y1 - y0, (color(rng.uniform(0.03, 0.1), 0.5, 0.6),), (1.3, 0.14))
    carpet = tiles(rng, x1 - x0, y1 - y0, (color(hue + 0.4, 0.35, 0.65), base), (0.5, 0.5))
    ceiling = plain(rng, x1 - x0, y1 - y0, (235, 238, 240))
    floor = Quad(np.array([x0, y1, 0]), across, -along, (boards, carpet)[kind % 2], room.index)
    return [*quads, floor, Quad(np.array([x0, y0, HEIGHT_M]), across, along, ceiling, room.index)]


def _wall(room: int, wall: Wall, texture: Image) -> list[Quad]:
    """Return a wall, in two parts if it has a door."""
    middle, scale = wall.length / 2, texture.shape[1] / wall.length
    ends = [0, middle - DOOR_WIDTH_M / 2, middle + DOOR_WIDTH_M / 2, wall.length] if wall.door else [0, wall.length]
    down = np.array([0, 0, -HEIGHT_M])
    return [
        Quad(
            wall.at(low, 0, HEIGHT_M),
            np.append((high - low) * wall.right, 0),
            down,
            texture[:, round(low * scale) : round(high * scale)],
            room,
        )
        for low, high in zip(ends[::2], ends[1::2], strict=True)
    ]


def _box(rng: np.random.Generator, room: int, wall: Wall, middle: float, hue: float, way: Vector) -> list[Quad]:
    """Return a cupboard or shelf at a wall, or nothing: by chance, and where it would be in the way."""
    wide, deep, tall = rng.uniform(0.6, PLACE_M), rng.uniform(0.3, 0.6), rng.choice([0, 0.45, 0.8, 1.15])
    low = middle - wide / 2
    ends = np.array([wall.at(low, 0, 0)[:2], wall.at(low + wide, deep, 0)[:2]])
    gaps = np.maximum(np.maximum(ends.min(axis=0) - way, way - ends.max(axis=0)), 0)
    if not tall or np.linalg.norm(gaps, axis=1).min() < CLEARANCE_M:
        return []
    tint = color(hue + rng.choice([0.1, 0.33, 0.5]), rng.uniform(0.3, 0.8), rng.uniform(0.4, 0.9))
    books = tuple(color(rng.uniform(), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.95)) for _ in range(7))
    front = tiles(rng, wide, tall, *((books, (0.06, 0.3)) if rng.integers(2) else ((tint,), (wide / 2, 0.4))))
    right, inward = np.append(wide * wall.right, 0), np.append(deep * wall.inward, 0)
    down, side = np.array([0, 0, -tall]), plain(rng, deep, tall, tint)
    return [
        Quad(wall.at(low, deep, tall), right, down, front, room),
        Quad(wall.at(low, 0, tall), inward, down, side, room),
        Quad(wall.at(low + wide, deep, tall), -inward, down, side, room),
        Quad(wall.at(low, 0, tall), right, inward, plain(rng, wide, deep, tint), room),
    ]


def _picture(rng: np.random.Generator, room: int, wall: Wall, middle: float) -> list[Quad]:
    """Return a picture on a wall, slightly in front of it, or nothing, by chance."""
    wide, tall = rng.uniform(0.5, PLACE_M - 0.1), rng.uniform(0.45, 1.0)
    right, down = np.append(wide * wall.right, 0), np.array([0, 0, -tall])
    quad = Quad(wall.at(middle - wide / 2, 0.02, 1.25 + tall), right, down, framed(rng, wide, tall), room)
    return [quad] if rng.uniform() < 0.7 else []


def color(hue: float, saturation: float, value: float) -> Color:
    """BGR, each 0 to 255, of a hue in turns (0 to 1, wrapping), a saturation and a value of 0 to 1."""
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, saturation, value)
    return 255 * blue, 255 * green, 255 * red


def plain(rng: np.random.Generator, width: float, height: float, base: Color) -> Image:
    """Return a surface of ``width`` x ``height`` meters, one color with faint clouds and grain: BGR (H, W, 3) uint8."""
    shape = (max(8, round(height * PIXELS_PER_METER)), max(8, round(width * PIXELS_PER_METER)))
    coarse = rng.normal(size=(shape[0] // 60 + 3, shape[1] // 60 + 3))
    clouds = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    light = 1 + 0.05 * clouds + 0.02 * rng.normal(size=shape)
    return np.clip(light[..., None] * np.array(base), 0, 255).astype(np.uint8)


def tiles(
    rng: np.random.Generator, width: float, height: float, tints: tuple[Color, ...], size: tuple[float, float]
) -> Image:
    """Tiles, bricks, boards, doors or books of ``size`` (width, height) in m; each row begins half a tile later."""
    picture = plain(rng, width, height, (110, 115, 120))
    wide, tall = (max(4, round(side * PIXELS_PER_METER)) for side in size)
    for row, top in enumerate(range(0, picture.shape[0], tall)):
        for column, left in enumerate(range(-(row % 2) * wide // 2, picture.shape[1], wide)):
            tint = np.array(tints[(row + column) % len(tints)]) * rng.uniform(0.7, 1.1)
            cv2.rectangle(picture, (left + 1, top + 1), (left + wide - 2, top + tall - 2), tint.tolist(), -1)
    return picture


def framed(rng: np.random.Generator, width: float, height: float) -> Image:
    """A picture in a frame: discs and a word. No two are the same."""
    picture = plain(rng, width, height, color(rng.uniform(), rng.uniform(0.1, 0.7), rng.uniform(0.3, 1)))
    rows, columns = picture.shape[:2]
    for _ in range(int(rng.integers(3, 8))):
        center = (int(rng.integers(columns)), int(rng.integers(rows)))
        for radius in range(int(rng.integers(rows // 8, rows // 3)), 2, -max(3, rows // 14)):
            cv2.circle(picture, center, radius, color(rng.uniform(), 0.8, 0.9), -1, cv2.LINE_AA)
    word, ink = "".join(chr(65 + int(code)) for code in rng.integers(0, 26, 4)), color(rng.uniform(), 0.9, 0.25)
    cv2.putText(picture, word, (columns // 9, rows * 5 // 8), cv2.FONT_HERSHEY_DUPLEX, columns / 95, ink, 2)
    timber = color(rng.uniform(0.02, 0.12), rng.uniform(0.2, 0.9), rng.choice([0.15, 0.35, 0.6, 0.95]))
    cv2.rectangle(picture, (0, 0), (columns - 1, rows - 1), timber, 10)
    return picture
