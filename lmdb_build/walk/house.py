"""The synthetic house: a ring of furnished rooms, as textured rectangles in space, and the path through them.

World: meters, x and y on the floor, z up. Everything follows from the seed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lmdb_build.walk import textures as paint
from lmdb_build.walk.furniture import THEMES, Box, Piece, Theme
from lmdb_build.walk.textures import PIXELS_PER_METER, Image, Texture
from netspec.files.opencv import cv2

Vector = NDArray[np.float64]
Glow = Literal["daylight", "lamp"] | None

HEIGHT_M = 2.6
DOOR_WIDTH_M, DOOR_HEIGHT_M = 1.1, 2.05
HALF_WALL_M = 0.1
CLEARANCE_M = 0.55  # between the path and furniture
LONGEST_QUAD_M = 2.5  # longer ones are cut, so that each part is drawn at a resolution for its distance


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: its upper left corner (3,), and the edges (3,) along the texture's rows and columns.

    It is visible from the side to which ``down`` x ``right`` points. ``glow``: the light that it emits.
    ``shell``: wall, floor or ceiling, which are darker near their edges. ``draw``: the function that drew a picture on
    a wall, so that another season can hang another one.
    """

    origin: Vector
    right: Vector
    down: Vector
    texture: Image
    room: int
    glow: Glow = None
    shell: bool = False
    draw: Texture | None = None


@dataclass(frozen=True)
class Wall:
    """A wall as seen from inside: its left end (2,), unit directions (2,) to the right and inward, its length in m."""

    start: Vector
    right: Vector
    inward: Vector
    length: float

    def at(self, along: float, inward: float, z: float) -> Vector:
        """Return the point (3,) in the world of coordinates along the wall."""
        return np.append(self.start + along * self.right + inward * self.inward, z)


@dataclass
class Room:
    """A room's floor rectangle (x0, y0, x1, y1) in meters, its lights and the occupied parts of its walls."""

    index: int
    bounds: tuple[float, float, float, float]
    lamp: Vector = field(init=False)
    windows: list[Vector] = field(default_factory=list)
    taken: list[tuple[int, float, float, float]] = field(default_factory=list)  # wall, from, to, top
    footprints: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.bounds
        self.lamp = np.array([(x0 + x1) / 2, (y0 + y1) / 2, HEIGHT_M - 0.02])

    @property
    def walls(self) -> list[Wall]:
        """South, east, north, west: the four walls as seen from inside."""
        x0, y0, x1, y1 = self.bounds
        ends = [((x1, y0), (0.0, 1.0)), ((x1, y1), (-1.0, 0.0)), ((x0, y1), (0.0, -1.0)), ((x0, y0), (1.0, 0.0))]
        lengths = [x1 - x0, y1 - y0, x1 - x0, y1 - y0]
        walls = []
        for (start, inward), length in zip(ends, lengths, strict=True):
            # From inside, the view is along -inward; right is that direction crossed with up.
            walls.append(Wall(np.array(start), np.array([-inward[1], inward[0]]), np.array(inward), length))
        return walls


@dataclass(frozen=True)
class House:
    """All surfaces, the rooms, and the closed path (P, 2) through every room at equal steps of ``step_m`` meters."""

    quads: list[Quad]
    rooms: list[Room]
    way: Vector
    step_m: float

    @property
    def way_length_m(self) -> float:
        """Length of one lap in meters."""
        return len(self.way) * self.step_m


def build_house(seed: int, rooms: int = 4) -> House:
    """Make a house of an even number of ``rooms`` (4 or more) in two rows, joined by doors into a ring."""
    assert rooms >= 4
    assert rooms % 2 == 0
    rng = np.random.default_rng([seed, 1])
    columns = rooms // 2
    xs = np.concatenate([[0], np.cumsum(rng.uniform(3.8, 5.2, columns))])
    ys = np.concatenate([[0], np.cumsum(rng.uniform(3.7, 4.8, 2))])
    cells = [(column, 0) for column in range(columns)] + [(column, 1) for column in reversed(range(columns))]
    plan = [
        Room(
            index,
            (
                xs[column] + HALF_WALL_M,
                ys[row] + HALF_WALL_M,
                xs[column + 1] - HALF_WALL_M,
                ys[row + 1] - HALF_WALL_M,
            ),
        )
        for index, (column, row) in enumerate(cells)
    ]
    doors = [_place_door(rng, room, plan[(room.index + 1) % rooms]) for room in plan]
    way, step = _way(rng, plan, doors)
    quads: list[Quad] = []
    themes = rng.permutation(len(THEMES))
    hue = rng.uniform()
    for room in plan:
        theme = THEMES[themes[room.index % len(THEMES)]]
        # Hues are spread evenly over the house, so that no two rooms have the same color.
        room_hue = hue + room.index / rooms + rng.uniform(-0.04, 0.04)
        quads += _furnish(np.random.default_rng([seed, 2, room.index]), room, theme, room_hue, doors, way)
    for room, door in zip(plan, doors, strict=True):
        quads += _jamb(room.index, *door)
    return House([part for quad in quads for part in _cut(quad)], plan, way, step)


def _place_door(rng: np.random.Generator, room: Room, following: Room) -> tuple[Vector, Vector]:
    """Choose where the door between two neighbors is: its center (2,) and the direction (2,) through it."""
    x0, y0, x1, y1 = room.bounds
    u0, v0, u1, v1 = following.bounds
    margin = DOOR_WIDTH_M / 2 + 0.5
    low, high = (max(x0, u0) + margin, min(x1, u1) - margin)
    if high > low:  # one above the other
        sign = 1.0 if v0 > y0 else -1.0
        return np.array([rng.uniform(low, high), (y1 if sign > 0 else y0) + sign * HALF_WALL_M]), np.array([0, sign])
    low, high = (max(y0, v0) + margin, min(y1, v1) - margin)
    sign = 1.0 if u0 > x0 else -1.0
    return np.array([(x1 if sign > 0 else x0) + sign * HALF_WALL_M, rng.uniform(low, high)]), np.array([sign, 0])


def _way(rng: np.random.Generator, plan: list[Room], doors: list[tuple[Vector, Vector]]) -> tuple[Vector, float]:
    """Return a path straight through each door and around each room: (P, 2) points, and their step in m."""
    stops = []
    for room in plan:
        (entry, into), (exit_, out) = doors[room.index - 1], doors[room.index]
        x0, y0, x1, y1 = room.bounds
        # Not straight from door to door, so that each room is seen from several sides.
        corner = np.array([(x0 + x1) / 2, (y0 + y1) / 2]) + 0.35 * (into - out) + rng.uniform(-0.2, 0.2, 2)
        stops += [entry + 0.7 * into, corner, exit_ - 0.7 * out, exit_]
    line = np.array(stops)
    for _ in range(4):  # Chaikin: cutting corners gives a smooth closed curve
        following = np.roll(line, -1, axis=0)
        line = np.stack([0.75 * line + 0.25 * following, 0.25 * line + 0.75 * following], axis=1).reshape(-1, 2)
    closed = np.vstack([line, line[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = round(along[-1] / 0.05)
    at = np.arange(count) * along[-1] / count
    return np.column_stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)]), along[-1] / count


def _furnish(
    rng: np.random.Generator,
    room: Room,
    theme: Theme,
    hue: float,
    doors: list[tuple[Vector, Vector]],
    way: Vector,
) -> list[Quad]:
    """Return all surfaces of one room."""
    quads: list[Quad] = []
    walls = room.walls
    openings = [_openings(wall, doors) for wall in walls]
    for number, gaps in enumerate(openings):
        room.taken += [(number, low - 0.1, high + 0.1, HEIGHT_M) for low, high in gaps]
    for make in theme.furniture:
        quads += _place_piece(rng, room, make(rng, hue), way)
    quads += _hang(rng, room, paint.window, (1.1, 1.6), (1.1, 1.3), 0.95, 1, glow="daylight", walls=_outer(room, doors))
    quads += _hang(rng, room, paint.framed, (0.5, 1.0), (0.45, 0.8), 1.2, 5)

    finish = theme.wall(rng, hue)
    for wall, gaps in zip(walls, openings, strict=True):
        quads += _wall_with_doors(room.index, wall, gaps, finish(rng, wall.length, HEIGHT_M))
    x0, y0, x1, y1 = room.bounds
    floor = theme.floor(rng, hue)(rng, x1 - x0, y1 - y0)
    _shadows(floor, room)
    edge_x, edge_y = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
    quads.append(Quad(np.array([x0, y1, 0]), edge_x, -edge_y, floor, room.index, shell=True))
    ceiling = paint.plain((235, 238, 240), 0.03)(rng, x1 - x0, y1 - y0)
    quads.append(Quad(np.array([x0, y0, HEIGHT_M]), edge_x, edge_y, ceiling, room.index, shell=True))
    size = rng.uniform(0.4, 0.7, 2)
    lamp = np.full((48, 48, 3), 255, np.uint8)
    corner = room.lamp - np.append(size / 2, 0)
    quads.append(Quad(corner, np.array([size[0], 0, 0]), np.array([0, size[1], 0]), lamp, room.index, glow="lamp"))
    return quads


def _openings(wall: Wall, doors: list[tuple[Vector, Vector]]) -> list[tuple[float, float]]:
    """Return the doors in the wall, as intervals along it in meters."""
    gaps = []
    for center, through in doors:
        offset = center - wall.start
        along = float(offset @ wall.right)
        if abs(offset @ wall.inward) < 2 * HALF_WALL_M and abs(through @ wall.inward) > 0.5 and 0 < along < wall.length:
            gaps.append((along - DOOR_WIDTH_M / 2, along + DOOR_WIDTH_M / 2))
    return sorted(gaps)


def _outer(room: Room, doors: list[tuple[Vector, Vector]]) -> list[int]:
    """Return the walls without a door: most of them are outer walls."""
    return [number for number, wall in enumerate(room.walls) if not _openings(wall, doors)]


def _wall_with_doors(room: int, wall: Wall, gaps: list[tuple[float, float]], texture: Image) -> list[Quad]:
    quads = []
    edges = [0.0, *(edge for gap in gaps for edge in gap), wall.length]
    scale = texture.shape[1] / wall.length
    lintel = round((HEIGHT_M - DOOR_HEIGHT_M) / HEIGHT_M * texture.shape[0])
    for number, (low, high) in enumerate(pairwise(edges)):
        part = texture[:, round(low * scale) : round(high * scale)]
        tall = HEIGHT_M
        if number % 2:  # above a door
            part, tall = part[:lintel], HEIGHT_M - DOOR_HEIGHT_M
        right = np.append((high - low) * wall.right, 0)
        quads.append(Quad(wall.at(low, 0, HEIGHT_M), right, np.array([0, 0, -tall]), part, room, shell=True))
    return quads


def _jamb(room: int, center: Vector, through: Vector) -> list[Quad]:
    """Return the four faces of the wall's thickness in a doorway."""
    across = np.array([through[1], -through[0]])  # to the right when walking through
    timber = np.full((64, 16, 3), (90, 130, 170), np.uint8)
    depth, down = np.append(2 * HALF_WALL_M * through, 0), np.array([0, 0, -DOOR_HEIGHT_M])
    left = np.append(center - DOOR_WIDTH_M / 2 * across - HALF_WALL_M * through, DOOR_HEIGHT_M)
    right = np.append(center + DOOR_WIDTH_M / 2 * across + HALF_WALL_M * through, DOOR_HEIGHT_M)
    width = np.append(DOOR_WIDTH_M * across, 0)
    return [
        Quad(left, depth, down, timber, room),
        Quad(right, -depth, down, timber, room),
        Quad(left, width, depth, timber, room),
        Quad(left + depth + down, width, -depth, timber, room),
    ]


def _place_piece(rng: np.random.Generator, room: Room, piece: Piece, way: Vector) -> list[Quad]:
    """Place a piece of furniture at a wall where it does not block the path or other things, if there is space."""
    for _ in range(40):
        number = int(rng.integers(4))
        wall = room.walls[number]
        if wall.length < piece.width + 0.1:
            continue
        low = rng.uniform(0.02, wall.length - piece.width - 0.02)
        corner_a, corner_b = wall.at(low, 0, 0)[:2], wall.at(low + piece.width, piece.depth, 0)[:2]
        x0, y0 = np.minimum(corner_a, corner_b)
        x1, y1 = np.maximum(corner_a, corner_b)
        apart = np.maximum(np.maximum([x0, y0] - way, way - [x1, y1]), 0)
        if np.linalg.norm(apart, axis=1).min() < CLEARANCE_M:
            continue
        if any(x0 < q1 and p0 < x1 and y0 < r1 and o0 < y1 for p0, o0, q1, r1 in room.footprints):
            continue
        if _overlaps(room, number, low, low + piece.width, 0):
            continue
        room.footprints.append((x0, y0, x1, y1))
        room.taken.append((number, low, low + piece.width, piece.height))
        return [quad for box in piece.boxes for quad in _faces(rng, room.index, wall, low, box)]
    return []


def _faces(rng: np.random.Generator, room: int, wall: Wall, left: float, box: Box) -> list[Quad]:
    """Return the visible faces of a box at ``left`` meters along the wall."""
    a, b = left + box.left, left + box.right
    across, depth, down = (
        np.append((b - a) * wall.right, 0),
        np.append((box.far - box.near) * wall.inward, 0),
        np.array([0, 0, box.low - box.high]),
    )
    wide, deep, tall = b - a, box.far - box.near, box.high - box.low
    faces = [
        Quad(wall.at(a, box.far, box.high), across, down, box.front(rng, wide, tall), room),
        Quad(wall.at(a, box.near, box.high), depth, down, box.side(rng, deep, tall), room),
        Quad(wall.at(b, box.far, box.high), -depth, down, box.side(rng, deep, tall), room),
        Quad(wall.at(a, box.near, box.high), across, depth, box.top(rng, wide, deep), room),
    ]
    if box.near > 0.05:
        faces.append(Quad(wall.at(b, box.near, box.high), -across, down, box.side(rng, wide, tall), room))
    return faces


def _overlaps(room: Room, wall: int, low: float, high: float, bottom: float) -> bool:
    return any(number == wall and low < end and start < high and bottom < top for number, start, end, top in room.taken)


def _hang(
    rng: np.random.Generator,
    room: Room,
    draw: Texture,
    widths: tuple[float, float],
    heights: tuple[float, float],
    bottom: float,
    count: int,
    glow: Glow = None,
    walls: list[int] | None = None,
) -> list[Quad]:
    """Hang up to ``count`` pictures (or windows) on free parts of the walls, slightly in front of them."""
    quads = []
    for _ in range(count):
        wide, tall = rng.uniform(*widths), rng.uniform(*heights)
        for _ in range(20):
            number = int(rng.choice(walls if walls else range(4)))
            wall = room.walls[number]
            low = rng.uniform(0.1, wall.length - wide - 0.1)
            if not _overlaps(room, number, low - 0.05, low + wide + 0.05, bottom):
                room.taken.append((number, low, low + wide, HEIGHT_M))
                right = np.append(wide * wall.right, 0)
                origin = wall.at(low, 0.02, bottom + tall)
                down = np.array([0, 0, -tall])
                quads.append(Quad(origin, right, down, draw(rng, wide, tall), room.index, glow=glow, draw=draw))
                if glow:
                    room.windows.append(wall.at(low + wide / 2, 0.1, bottom + tall / 2))
                break
    return quads


def _shadows(floor: Image, room: Room) -> None:
    """Darken the floor around furniture."""
    x0, _, _, y1 = room.bounds
    dark = np.zeros(floor.shape[:2], np.float32)
    for p0, o0, p1, o1 in room.footprints:
        corner = (round((p0 - x0) * PIXELS_PER_METER), round((y1 - o1) * PIXELS_PER_METER))
        opposite = (round((p1 - x0) * PIXELS_PER_METER), round((y1 - o0) * PIXELS_PER_METER))
        cv2.rectangle(dark, corner, opposite, 0.55, -1)
    dark = cv2.GaussianBlur(dark, (0, 0), 0.1 * PIXELS_PER_METER)
    floor[:] = (floor * (1 - dark[..., None])).astype(np.uint8)


def _cut(quad: Quad) -> list[Quad]:
    """Cut a long rectangle into parts of at most ``LONGEST_QUAD_M``."""
    columns = int(np.ceil(np.linalg.norm(quad.right) / LONGEST_QUAD_M))
    rows = int(np.ceil(np.linalg.norm(quad.down) / LONGEST_QUAD_M))
    tall, wide = quad.texture.shape[:2]
    parts = []
    for row in range(rows):
        for column in range(columns):
            # Cut between texels, so that each part is exactly where its texels are.
            top, bottom = tall * row // rows, tall * (row + 1) // rows
            left, right = wide * column // columns, wide * (column + 1) // columns
            parts.append(
                Quad(
                    quad.origin + quad.right * (left / wide) + quad.down * (top / tall),
                    quad.right * ((right - left) / wide),
                    quad.down * ((bottom - top) / tall),
                    quad.texture[top:bottom, left:right],
                    quad.room,
                    quad.glow,
                    quad.shell,
                    quad.draw,
                )
            )
    return parts
