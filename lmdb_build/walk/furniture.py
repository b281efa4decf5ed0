"""The furniture of the synthetic house, as textured boxes, and the kinds of rooms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lmdb_build.walk import textures as paint
from lmdb_build.walk.textures import Texture, color


@dataclass(frozen=True)
class Box:
    """A box in meters: ``left`` to ``right`` along the wall, ``near`` to ``far`` from it, ``low`` to ``high``."""

    left: float
    right: float
    near: float
    far: float
    low: float
    high: float
    front: Texture
    side: Texture
    top: Texture


@dataclass(frozen=True)
class Piece:
    """A piece of furniture: its size along the wall and away from it, its height (meters), its boxes."""

    width: float
    depth: float
    height: float
    boxes: tuple[Box, ...]


Furniture = Callable[[np.random.Generator, float], Piece]
Finish = Callable[[np.random.Generator, float], Texture]


@dataclass(frozen=True)
class Theme:
    """A kind of room: its walls and floor, drawn in the room's hue, and its furniture, largest first."""

    wall: Finish
    floor: Finish
    furniture: tuple[Furniture, ...]


def _timber(rng: np.random.Generator) -> paint.Color:
    return color(rng.uniform(0.03, 0.1), rng.uniform(0.3, 0.75), rng.uniform(0.25, 0.75))


def _solid(rng: np.random.Generator, width: float, depth: float, height: float, front: Texture) -> Piece:
    body = paint.plain(_timber(rng), 0.12)
    return Piece(width, depth, height, (Box(0, width, 0, depth, 0, height, front, body, body),))


def bookcase(rng: np.random.Generator, hue: float) -> Piece:
    """A tall bookcase, full of books."""
    return _solid(rng, rng.uniform(0.9, 1.7), 0.3, rng.uniform(1.7, 2.2), paint.shelf)


def chest(rng: np.random.Generator, hue: float) -> Piece:
    """A low chest of drawers."""
    front = paint.drawers(_timber(rng), int(rng.integers(1, 4)), int(rng.integers(2, 5)))
    return _solid(rng, rng.uniform(0.8, 1.3), 0.45, rng.uniform(0.8, 1.1), front)


def wardrobe(rng: np.random.Generator, hue: float) -> Piece:
    """A wardrobe with doors, in a color that goes with the room."""
    tint = color(hue + rng.choice([0.08, 0.5]), rng.uniform(0.15, 0.5), rng.uniform(0.5, 0.9))
    return _solid(rng, rng.uniform(1.1, 1.6), 0.6, 2.1, paint.drawers(tint, int(rng.integers(2, 4)), 1))


def fridge(rng: np.random.Generator, hue: float) -> Piece:
    """A tall and narrow refrigerator, white or colored."""
    tint = color(hue + 0.45, rng.choice([0.02, 0.6]), 0.9)
    body = paint.plain(tint, 0.03)
    return Piece(0.65, 0.65, 1.8, (Box(0, 0.65, 0, 0.65, 0, 1.8, paint.drawers(tint, 1, 2), body, body),))


def counter(rng: np.random.Generator, hue: float) -> Piece:
    """Kitchen cupboards with a stove among them, and a row of cupboards above."""
    tint = color(hue + 0.1, rng.uniform(0.3, 0.7), rng.uniform(0.5, 0.9))
    board, body = paint.plain((70, 75, 80), 0.2), paint.plain(tint)
    cupboards = paint.drawers(tint, 2, 1)
    boxes = (
        Box(0, 0.9, 0, 0.6, 0, 0.9, cupboards, body, board),
        Box(0.9, 1.5, 0, 0.6, 0, 0.9, paint.appliance, paint.plain((220, 220, 220)), paint.plain((40, 40, 40), 0.2)),
        Box(1.5, 2.4, 0, 0.6, 0, 0.9, paint.drawers(tint, 1, 3), body, board),
        Box(0, 2.4, 0, 0.33, 1.45, 2.1, paint.drawers(tint, 4, 1), body, body),
    )
    return Piece(2.4, 0.6, 2.1, boxes)


def washer(rng: np.random.Generator, hue: float) -> Piece:
    """A washing machine."""
    white = paint.plain((235, 235, 230), 0.03)
    return Piece(0.6, 0.6, 0.85, (Box(0, 0.6, 0, 0.6, 0, 0.85, paint.appliance, white, white),))


def tub(rng: np.random.Generator, hue: float) -> Piece:
    """A bathtub with water in it."""
    white, water = paint.plain((240, 240, 238), 0.03), paint.plain(color(0.52, 0.4, 0.85), 0.1)
    skirt = paint.tiles((240, 240, 240), color(hue, 0.6, 0.7), 0.15)
    boxes = (
        Box(0, 1.7, 0, 0.75, 0, 0.55, skirt, white, white),
        Box(0.1, 1.6, 0.1, 0.65, 0.54, 0.56, white, white, water),
    )
    return Piece(1.7, 0.75, 0.6, boxes)


def sofa(rng: np.random.Generator, hue: float) -> Piece:
    """A sofa with a cushion."""
    width = rng.uniform(1.6, 2.2)
    base = color(hue + rng.choice([0.33, 0.5, 0.67]), rng.uniform(0.4, 0.8), rng.uniform(0.35, 0.8))
    cloth = paint.plaid(base, color(hue, 0.4, 0.8)) if rng.uniform() < 0.5 else paint.plain(base, 0.08)
    cushion = paint.plain(color(rng.uniform(), 0.8, 0.9), 0.05)
    at = rng.uniform(0.3, width - 0.7)
    boxes = (
        Box(0, width, 0, 0.85, 0, 0.42, cloth, cloth, cloth),
        Box(0, width, 0, 0.22, 0.42, 0.85, cloth, cloth, cloth),
        Box(0, 0.2, 0.22, 0.85, 0.42, 0.62, cloth, cloth, cloth),
        Box(width - 0.2, width, 0.22, 0.85, 0.42, 0.62, cloth, cloth, cloth),
        Box(at, at + 0.4, 0.24, 0.38, 0.42, 0.78, cushion, cushion, cushion),
    )
    return Piece(width, 0.85, 0.85, boxes)


def television(rng: np.random.Generator, hue: float) -> Piece:
    """A low cupboard with a television on it."""
    timber = _timber(rng)
    body, dark = paint.plain(timber, 0.1), paint.plain((30, 30, 30))
    boxes = (
        Box(0, 1.4, 0, 0.4, 0, 0.5, paint.drawers(timber, 3, 1), body, body),
        Box(0.2, 1.2, 0.15, 0.2, 0.55, 1.15, paint.screen, dark, dark),
    )
    return Piece(1.4, 0.4, 1.2, boxes)


def bed(rng: np.random.Generator, hue: float) -> Piece:
    """A bed with its head at the wall."""
    width = rng.uniform(1.0, 1.6)
    timber = paint.plain(_timber(rng), 0.1)
    cover = paint.plaid(color(hue + 0.5, 0.5, 0.7), color(hue + 0.15, 0.6, 0.9))
    pillow = paint.plain((240, 240, 245), 0.05)
    boxes = (
        Box(0, width, 0, 2.0, 0, 0.3, timber, timber, timber),
        Box(0.02, width - 0.02, 0.08, 1.98, 0.3, 0.55, cover, cover, cover),
        Box(0, width, 0, 0.08, 0.3, 1.05, timber, timber, timber),
        Box(0.1, width - 0.1, 0.1, 0.5, 0.55, 0.68, pillow, pillow, pillow),
    )
    return Piece(width, 2.0, 1.05, boxes)


def desk(rng: np.random.Generator, hue: float) -> Piece:
    """A desk with a monitor."""
    timber = paint.plain(_timber(rng), 0.1)
    dark = paint.plain((30, 30, 30))
    boxes = (
        Box(0, 1.4, 0, 0.7, 0.7, 0.74, timber, timber, timber),
        Box(0, 0.04, 0, 0.7, 0, 0.7, timber, timber, timber),
        Box(0.95, 1.4, 0, 0.65, 0, 0.7, paint.drawers(_timber(rng), 1, 3), timber, timber),
        Box(0.35, 0.95, 0.15, 0.19, 0.85, 1.22, paint.screen, dark, dark),
        Box(0.6, 0.7, 0.15, 0.25, 0.74, 0.85, dark, dark, dark),
    )
    return Piece(1.4, 0.7, 1.25, boxes)


def table(rng: np.random.Generator, hue: float) -> Piece:
    """A table on four legs with a cloth."""
    timber = paint.plain(_timber(rng), 0.1)
    cloth = paint.plaid((235, 235, 240), color(hue + 0.5, 0.8, 0.7))
    boxes = [Box(0, 1.2, 0.1, 0.9, 0.7, 0.76, cloth, cloth, cloth)]
    for left in (0.03, 1.11):
        boxes += [Box(left, left + 0.06, near, near + 0.06, 0, 0.7, timber, timber, timber) for near in (0.13, 0.81)]
    return Piece(1.2, 0.9, 0.8, tuple(boxes))


def crates(rng: np.random.Generator, hue: float) -> Piece:
    """A stack of colored crates."""
    boxes = []
    for level, left in ((0, 0.0), (0, 0.55), (1, rng.uniform(0, 0.5))):
        tint = color(rng.uniform(), 0.75, 0.75)
        face = paint.stripes(tint, paint.shade(tint, 0.6), 0.1)
        boxes.append(Box(left, left + 0.5, 0, 0.5, 0.45 * level, 0.45 * level + 0.44, face, face, paint.plain(tint)))
    return Piece(1.05, 0.5, 0.9, tuple(boxes))


def plant(rng: np.random.Generator, hue: float) -> Piece:
    """A rectangular shrub in a pot."""
    leaves = paint.motif(color(0.33, 0.7, 0.35), color(rng.uniform(0.25, 0.4), 0.8, 0.6), 0.1)
    pot = paint.plain(color(0.04, 0.7, rng.uniform(0.5, 0.8)))
    tall = rng.uniform(1.0, 1.5)
    boxes = (
        Box(0.08, 0.42, 0.08, 0.42, 0, 0.4, pot, pot, pot),
        Box(0, 0.5, 0.06, 0.5, 0.4, tall, leaves, leaves, leaves),
    )
    return Piece(0.5, 0.5, tall, boxes)


def _tint(hue: float, saturation: float = 0.35, value: float = 0.85) -> paint.Color:
    return color(hue, saturation, value)


LIVING_ROOM = Theme(
    wall=lambda rng, hue: paint.stripes(_tint(hue), _tint(hue, 0.5, 0.75), rng.uniform(0.2, 0.4)),
    floor=lambda rng, hue: paint.planks(_timber(rng)),
    furniture=(sofa, television, bookcase, plant, chest),
)
KITCHEN = Theme(
    wall=lambda rng, hue: paint.wainscot(
        paint.plain(_tint(hue, 0.3, 0.9)), paint.tiles((240, 240, 240), _tint(hue, 0.6, 0.8), 0.15), (90, 90, 90), 1.4
    ),
    floor=lambda rng, hue: paint.tiles(_tint(hue, 0.1, 0.9), _tint(hue + 0.5, 0.4, 0.35), 0.33),
    furniture=(counter, fridge, table, washer, plant),
)
LIBRARY = Theme(
    wall=lambda rng, hue: paint.wainscot(
        paint.plain(_tint(hue, 0.55, 0.5)), paint.planks(_timber(rng), 0.2), _timber(rng), rng.uniform(0.9, 1.2)
    ),
    floor=lambda rng, hue: paint.carpet(_tint(hue, 0.6, 0.4), _tint(hue + 0.1, 0.5, 0.8)),
    furniture=(bookcase, bookcase, bookcase, desk, chest),
)
BEDROOM = Theme(
    wall=lambda rng, hue: paint.motif(_tint(hue, 0.2, 0.95), _tint(hue, 0.5, 0.75), rng.uniform(0.25, 0.5)),
    floor=lambda rng, hue: paint.carpet(_tint(hue + 0.4, 0.3, 0.6), _tint(hue + 0.4, 0.3, 0.75)),
    furniture=(bed, wardrobe, chest, plant),
)
BATHROOM = Theme(
    wall=lambda rng, hue: paint.wainscot(
        paint.plain((235, 235, 235)),
        paint.tiles(_tint(hue, 0.45, 0.8), _tint(hue, 0.3, 0.9), 0.2),
        (230, 230, 230),
        1.7,
    ),
    floor=lambda rng, hue: paint.tiles(_tint(hue, 0.7, 0.4), (240, 240, 240), 0.2),
    furniture=(tub, washer, wardrobe, crates),
)
OFFICE = Theme(
    wall=lambda rng, hue: paint.plain(_tint(hue, 0.3, 0.9), 0.08),
    floor=lambda rng, hue: paint.plain(_tint(hue, 0.25, 0.4), 0.15),
    furniture=(desk, desk, bookcase, wardrobe, plant),
)
WORKSHOP = Theme(
    wall=lambda rng, hue: paint.bricks(_tint(hue, 0.45, 0.7)),
    floor=lambda rng, hue: paint.plain((150, 150, 150), 0.2),
    furniture=(counter, crates, crates, chest, fridge),
)
NURSERY = Theme(
    wall=lambda rng, hue: paint.wainscot(
        paint.motif(_tint(hue, 0.3, 0.95), _tint(hue + 0.5, 0.6, 0.9), 0.35),
        paint.stripes(_tint(hue + 0.1, 0.5, 0.9), (245, 245, 245), 0.2),
        (240, 240, 240),
    ),
    floor=lambda rng, hue: paint.tiles(_tint(hue + 0.3, 0.6, 0.9), _tint(hue + 0.6, 0.6, 0.9), 0.5),
    furniture=(bed, crates, chest, table),
)
THEMES = (LIVING_ROOM, KITCHEN, LIBRARY, BEDROOM, BATHROOM, OFFICE, WORKSHOP, NURSERY)
