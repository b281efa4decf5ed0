"""The synthetic house: a ring of furnished rooms, as textured rectangles in space, and the path through them.

World: meters, x and y on the floor, z up. Everything follows from the seed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdb_build.walk import textures as paint
from lmdb_build.walk.textures import Image, Texture, color

Vector = NDArray[np.float64]
Door = tuple[Vector, Vector]  # its center (2,), and the direction (2,) through it

HEIGHT_M = 2.6
DOOR_WIDTH_M, DOOR_HEIGHT_M = 1.1, 2.05
CLEARANCE_M = 0.55  # between the path and furniture
PICTURES = 7  # in a room, at most
LONGEST_QUAD_M = 2.5  # longer ones are cut, so that each part is drawn at a resolution for its distance


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


class Box(NamedTuple):
    """A part of a piece of furniture: meters along the wall, away from it, and above the floor; its surfaces."""

    left: float
    right: float
    near: float
    far: float
    low: float
    high: float
    front: Texture
    body: Texture


class Wall(NamedTuple):
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
    """A room's floor rectangle (x0, y0, x1, y1) in meters, and the occupied parts of its walls and floor."""

    index: int
    bounds: tuple[float, float, float, float]
    taken: list[tuple[int, float, float, float]] = field(default_factory=list)  # wall, from, to, top
    footprints: list[tuple[float, float, float, float]] = field(default_factory=list)

    @property
    def walls(self) -> list[Wall]:
        """South, east, north, west: the four walls as seen from inside."""
        x0, y0, x1, y1 = self.bounds
        ends = [((x1, y0), (0.0, 1.0)), ((x1, y1), (-1.0, 0.0)), ((x0, y1), (0.0, -1.0)), ((x0, y0), (1.0, 0.0))]
        # From inside, the view is along -inward; right is that direction crossed with up.
        return [
            Wall(np.array(start), np.array([-inward[1], inward[0]]), np.array(inward), length)
            for (start, inward), length in zip(ends, [x1 - x0, y1 - y0] * 2, strict=True)
        ]

    def is_taken(self, wall: int, low: float, high: float, bottom: float) -> bool:
        """Return whether something hangs or stands at this part of a wall, above ``bottom``."""
        return any(k == wall and low < end and start < high and bottom < top for k, start, end, top in self.taken)


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
    plan = [Room(i, (xs[x], ys[y], xs[x + 1], ys[y + 1])) for i, (x, y) in enumerate(cells)]
    doors = [_place_door(rng, room, plan[(room.index + 1) % rooms]) for room in plan]
    way, step = _way(rng, plan, doors)
    quads: list[Quad] = []
    first, hue = rng.integers(100), rng.uniform()
    for room in plan:
        # Hues are spread evenly over the house, so that no two rooms have the same color.
        own = np.random.default_rng([seed, 2, room.index])
        quads += _furnished(own, room, int(first) + room.index, hue + room.index / rooms, doors, way)
    return House([part for quad in quads for part in _cut(quad)], plan, way, step)


def _place_door(rng: np.random.Generator, room: Room, following: Room) -> Door:
    """Choose where the door between two neighbors is."""
    margin = DOOR_WIDTH_M / 2 + 0.5
    for axis in (0, 1):  # rooms one above the other, then side by side
        low = max(room.bounds[axis], following.bounds[axis]) + margin
        high = min(room.bounds[axis + 2], following.bounds[axis + 2]) - margin
        if high > low:
            break
    sign = 1.0 if following.bounds[1 - axis] > room.bounds[1 - axis] else -1.0
    center, through = (rng.uniform(low, high), room.bounds[3 - axis if sign > 0 else 1 - axis]), (0.0, sign)
    return np.array(center if axis == 0 else center[::-1]), np.array(through if axis == 0 else through[::-1])


def _way(rng: np.random.Generator, plan: list[Room], doors: list[Door]) -> tuple[Vector, float]:
    """Return a path straight through each door and around each room: (P, 2) points, and their step in m."""
    stops = []
    for room in plan:
        (entry, into), (exit_, out) = doors[room.index - 1], doors[room.index]
        # Not straight from door to door, so that each room is seen from several sides.
        middle = np.reshape(room.bounds, (2, 2)).mean(axis=0)
        corner = middle + 0.35 * (into - out) + rng.uniform(-0.2, 0.2, 2)
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


def _furniture(rng: np.random.Generator, hue: float) -> dict[str, list[Box]]:
    """Return one of each piece of furniture, in colors that go with the hue of a room."""
    timber = color(rng.uniform(0.03, 0.1), rng.uniform(0.3, 0.75), rng.uniform(0.25, 0.75))
    tint = color(hue + rng.choice([0.1, 0.33, 0.5]), rng.uniform(0.3, 0.8), rng.uniform(0.4, 0.9))
    wood, paper = partial(paint.plain, base=timber, roughness=0.12), partial(paint.plain, base=(240, 240, 245))
    painted, dark = partial(paint.plain, base=tint), partial(paint.plain, base=(30, 30, 30))
    cloth = partial(paint.bands, colors=(tint, color(hue, 0.4, 0.8)), period=rng.uniform(0.12, 0.3), across=True)
    leaves = partial(paint.motif, base=color(0.33, 0.7, 0.35), accent=color(0.3, 0.8, 0.6), step_m=0.1)
    wide, tall, at = rng.uniform(0.9, 1.7), rng.uniform(1.7, 2.2), rng.uniform(0.3, 1.1)

    def doors(columns: int, rows: int, base: paint.Color = tint) -> Texture:
        return partial(paint.doors, base=base, columns=columns, rows=rows)

    return {
        "bookcase": [Box(0, wide, 0, 0.3, 0, tall, paint.shelf, wood)],
        "chest": [Box(0, 0.7 * wide, 0, 0.45, 0, 0.5 * tall, doors(2, int(rng.integers(2, 5)), timber), wood)],
        "wardrobe": [Box(0, 1.4, 0, 0.6, 0, 2.1, doors(int(rng.integers(2, 4)), 1), painted)],
        "counter": [
            Box(0, 1.5, 0, 0.6, 0, 0.9, doors(3, 1), painted),
            Box(1.5, 2.4, 0, 0.6, 0, 0.9, doors(1, 3), painted),
            Box(0, 2.4, 0, 0.33, 1.45, 2.1, doors(4, 1), painted),
        ],
        "sofa": [
            Box(0, 1.9, 0, 0.85, 0, 0.42, cloth, cloth),
            Box(0, 1.9, 0, 0.22, 0.42, 0.85, cloth, cloth),
            Box(at, at + 0.4, 0.24, 0.38, 0.42, 0.78, leaves, paper),
        ],
        "bed": [
            Box(0, wide, 0, 2.0, 0, 0.5, cloth, cloth),
            Box(0, wide, 0, 0.08, 0.5, 1.05, wood, wood),
            Box(0.1, wide - 0.1, 0.1, 0.5, 0.5, 0.65, paper, paper),
        ],
        "desk": [
            Box(0, 1.4, 0, 0.7, 0.7, 0.74, wood, wood),
            Box(0, 0.04, 0, 0.7, 0, 0.7, wood, wood),
            Box(0.95, 1.4, 0, 0.65, 0, 0.7, doors(1, 3), wood),
            Box(0.35, 0.95, 0.15, 0.25, 0.74, 1.22, paint.framed, dark),
        ],
        "crates": [
            Box(0, 0.5, 0, 0.5, 0, 0.44, cloth, painted),
            Box(0.55, 1.05, 0, 0.5, 0, 0.44, leaves, wood),
            Box(0.4 * at, 0.4 * at + 0.5, 0, 0.5, 0.45, 0.89, doors(1, 3, timber), wood),
        ],
    }


def _finish(rng: np.random.Generator, hue: float, kind: int) -> tuple[Texture, Texture, str]:
    """Return the wall and the floor of a kind of room in its hue, and what stands in it, largest first."""
    base, deep, pale = color(hue, 0.35, 0.85), color(hue, 0.55, 0.6), color(hue, 0.2, 0.95)
    other, accent = color(hue + 0.4, 0.35, 0.65), color(hue + 0.5, 0.6, 0.85)
    timber = color(rng.uniform(0.03, 0.1), 0.5, rng.uniform(0.35, 0.7))
    stripes = partial(paint.bands, colors=(base, deep), period=rng.uniform(0.2, 0.4), across=False)
    flowers = partial(paint.motif, base=pale, accent=accent, step_m=rng.uniform(0.25, 0.5))
    small, large = (partial(paint.courses, tints=(pale, deep), size=(size, size)) for size in (0.15, 0.33))
    bricks = partial(paint.courses, tints=(deep,), size=(0.25, 0.085))
    boards = partial(paint.courses, tints=(timber,), size=(1.3, 0.14))
    carpet = partial(paint.motif, base=other, accent=base, step_m=rng.uniform(0.35, 0.6))
    plaster = partial(paint.plain, base=base, roughness=0.1)
    edge = rng.uniform(0.9, 1.5)
    kinds = (
        (stripes, boards, "sofa bookcase chest crates"),
        (partial(paint.paneled, upper=plaster, lower=small, height_m=edge), large, "counter wardrobe crates chest"),
        (partial(paint.paneled, upper=stripes, lower=boards, height_m=edge), carpet, "bookcase bookcase desk chest"),
        (flowers, carpet, "bed wardrobe chest"),
        (bricks, boards, "counter crates desk chest"),
        (partial(paint.paneled, upper=flowers, lower=small, height_m=edge), large, "bed crates bookcase wardrobe"),
    )
    return kinds[kind % len(kinds)]


def _furnished(
    rng: np.random.Generator, room: Room, kind: int, hue: float, doors: list[Door], way: Vector
) -> list[Quad]:
    """Return all surfaces of one room."""
    wall_finish, floor_finish, pieces = _finish(rng, hue, kind)
    openings = [_openings(wall, doors) for wall in room.walls]
    room.taken += [(k, low - 0.1, high + 0.1, HEIGHT_M) for k, gaps in enumerate(openings) for low, high in gaps]
    quads = [quad for name in pieces.split() for quad in _placed(rng, room, _furniture(rng, hue)[name], way)]
    quads += _pictures(rng, room)
    for wall, gaps in zip(room.walls, openings, strict=True):
        quads += _wall_with_doors(room.index, wall, gaps, wall_finish(rng, wall.length, HEIGHT_M))
    x0, y0, x1, y1 = room.bounds
    edge_x, edge_y = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
    floor, ceiling = floor_finish(rng, x1 - x0, y1 - y0), paint.plain(rng, x1 - x0, y1 - y0, (235, 238, 240), 0.03)
    quads.append(Quad(np.array([x0, y1, 0]), edge_x, -edge_y, floor, room.index))
    quads.append(Quad(np.array([x0, y0, HEIGHT_M]), edge_x, edge_y, ceiling, room.index))
    return quads


def _openings(wall: Wall, doors: list[Door]) -> list[tuple[float, float]]:
    """Return the doors in the wall, as intervals along it in meters."""
    gaps = []
    for center, through in doors:
        offset = center - wall.start
        along = float(offset @ wall.right)
        if abs(offset @ wall.inward) < 0.01 and abs(through @ wall.inward) > 0.5 and 0 < along < wall.length:
            gaps.append((along - DOOR_WIDTH_M / 2, along + DOOR_WIDTH_M / 2))
    return sorted(gaps)


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
        quads.append(Quad(wall.at(low, 0, HEIGHT_M), right, np.array([0, 0, -tall]), part, room))
    return quads


def _placed(rng: np.random.Generator, room: Room, piece: list[Box], way: Vector) -> list[Quad]:
    """Place a piece of furniture at a wall where it does not block the path or other things, if there is space."""
    width, depth, height = np.max([(box.right, box.far, box.high) for box in piece], axis=0)
    for _ in range(40):
        number = int(rng.integers(4))
        wall = room.walls[number]
        low = rng.uniform(0.02, wall.length - width - 0.02)
        ends = np.array([wall.at(low, 0, 0)[:2], wall.at(low + width, depth, 0)[:2]])
        (x0, y0), (x1, y1) = ends.min(axis=0), ends.max(axis=0)
        gaps = np.maximum(np.maximum([x0, y0] - way, way - [x1, y1]), 0)
        blocks = np.linalg.norm(gaps, axis=1).min() < CLEARANCE_M or room.is_taken(number, low, low + width, 0)
        if blocks or any(x0 < q1 and p0 < x1 and y0 < r1 and o0 < y1 for p0, o0, q1, r1 in room.footprints):
            continue
        room.footprints.append((x0, y0, x1, y1))
        room.taken.append((number, low, low + width, height))
        return [quad for box in piece for quad in _faces(rng, room.index, wall, low, box)]
    return []


def _faces(rng: np.random.Generator, room: int, wall: Wall, left: float, box: Box) -> list[Quad]:
    """Return the visible faces of a box at ``left`` meters along the wall."""
    a, b = left + box.left, left + box.right
    wide, deep, tall = box.right - box.left, box.far - box.near, box.high - box.low
    across, depth, down = np.append(wide * wall.right, 0), np.append(deep * wall.inward, 0), np.array([0, 0, -tall])
    faces = [
        Quad(wall.at(a, box.far, box.high), across, down, box.front(rng, wide, tall), room),
        Quad(wall.at(a, box.near, box.high), depth, down, box.body(rng, deep, tall), room),
        Quad(wall.at(b, box.far, box.high), -depth, down, box.body(rng, deep, tall), room),
        Quad(wall.at(a, box.near, box.high), across, depth, box.body(rng, wide, deep), room),
    ]
    if box.near > 0.05:
        faces.append(Quad(wall.at(b, box.near, box.high), -across, down, box.body(rng, wide, tall), room))
    return faces


def _pictures(rng: np.random.Generator, room: Room) -> list[Quad]:
    """Hang pictures on free parts of the walls, slightly in front of them."""
    quads: list[Quad] = []
    for _ in range(100):
        wide, tall, number = rng.uniform(0.5, 1.2), rng.uniform(0.45, 1.0), int(rng.integers(4))
        wall = room.walls[number]
        low = rng.uniform(0.1, wall.length - wide - 0.1)
        if len(quads) < PICTURES and not room.is_taken(number, low - 0.05, low + wide + 0.05, 1.2):
            room.taken.append((number, low, low + wide, HEIGHT_M))
            right, down = np.append(wide * wall.right, 0), np.array([0, 0, -tall])
            quads.append(Quad(wall.at(low, 0.02, 1.2 + tall), right, down, paint.framed(rng, wide, tall), room.index))
    return quads


def _cut(quad: Quad) -> list[Quad]:
    """Cut a long rectangle into parts of at most ``LONGEST_QUAD_M``."""
    columns, rows = (int(np.ceil(np.linalg.norm(edge) / LONGEST_QUAD_M)) for edge in (quad.right, quad.down))
    tall, wide = quad.texture.shape[:2]
    # Cut between texels, so that each part is exactly where its texels are.
    xs, ys = wide * np.arange(columns + 1) // columns, tall * np.arange(rows + 1) // rows
    return [
        replace(
            quad,
            origin=quad.origin + quad.right * (left / wide) + quad.down * (top / tall),
            right=quad.right * ((right - left) / wide),
            down=quad.down * ((bottom - top) / tall),
            texture=quad.texture[top:bottom, left:right],
        )
        for top, bottom in pairwise(ys)
        for left, right in pairwise(xs)
    ]
