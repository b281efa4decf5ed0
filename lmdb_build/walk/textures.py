"""Surfaces of the synthetic house: floors, walls, pictures and furniture fronts, drawn from a seed.

Every function takes a random generator and the surface's size in meters, and returns a BGR picture (H, W, 3) uint8 at
``PIXELS_PER_METER``. The first row is the top of a wall, or the far edge of a floor.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netspec.files.opencv import cv2

Image = NDArray[Any]  # (H, W, 3) uint8, BGR; OpenCV does not declare its type
Color = tuple[float, float, float]
Texture = Callable[[np.random.Generator, float, float], Image]

PIXELS_PER_METER = 96


def color(hue: float, saturation: float, value: float) -> Color:
    """BGR, each 0 to 255, of a hue in turns (0 to 1, wrapping), a saturation and a value of 0 to 1."""
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, min(max(saturation, 0), 1), min(max(value, 0), 1))
    return 255 * blue, 255 * green, 255 * red


def shade(base: Color, factor: float) -> Color:
    """Return a darker (factor below 1) or lighter color."""
    return min(base[0] * factor, 255), min(base[1] * factor, 255), min(base[2] * factor, 255)


def plain(base: Color, roughness: float = 0.05) -> Texture:
    """Paint or plaster: one color with faint clouds and grain."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, base)
        return _modulate(picture, _cloud(rng, picture, 0.6) * roughness + _grain(rng, picture) * roughness / 3)

    return draw


def planks(base: Color, plank_width: float = 0.14) -> Texture:
    """Floor boards along the picture's width, each with its own tint, joints and grain."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, base)
        rows, columns = picture.shape[:2]
        step = max(4, round(plank_width * PIXELS_PER_METER))
        for top in range(0, rows, step):
            left = -int(rng.integers(0, PIXELS_PER_METER))
            while left < columns:
                right = left + int(rng.uniform(0.8, 1.8) * PIXELS_PER_METER)
                tint = shade(base, rng.uniform(0.75, 1.15))
                cv2.rectangle(picture, (left, top), (right, top + step - 1), tint, -1)
                cv2.rectangle(picture, (left, top), (right, top + step - 1), shade(base, 0.45), 1)
                left = right
        streaks = cv2.resize(rng.normal(size=(rows, max(2, columns // 24))), (columns, rows))
        return _modulate(picture, 0.06 * streaks + 0.05 * _cloud(rng, picture, 0.5))

    return draw


def tiles(light: Color, dark: Color, size: float = 0.3, joint: Color = (150, 150, 150)) -> Texture:
    """A checkerboard of two kinds of tiles with joints."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, joint)
        step = round(size * PIXELS_PER_METER)
        for row, top in enumerate(range(0, picture.shape[0], step)):
            for column, left in enumerate(range(0, picture.shape[1], step)):
                tint = shade(light if (row + column) % 2 else dark, rng.uniform(0.93, 1.07))
                cv2.rectangle(picture, (left + 1, top + 1), (left + step - 2, top + step - 2), tint, -1)
        return _modulate(picture, 0.04 * _cloud(rng, picture, 0.3))

    return draw


def carpet(base: Color, accent: Color) -> Texture:
    """A carpet with a lattice of small polygons."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, base)
        step = int(rng.uniform(0.35, 0.6) * PIXELS_PER_METER)
        sides = int(rng.integers(3, 7))
        for row, y in enumerate(range(step // 2, picture.shape[0], step)):
            for x in range(step // 2 + (row % 2) * step // 2, picture.shape[1], step):
                _polygon(picture, (x, y), 0.3 * step, sides, 0.4 * row, accent)
        return _modulate(picture, 0.12 * _grain(rng, picture) + 0.05 * _cloud(rng, picture, 0.8))

    return draw


def stripes(first: Color, second: Color, period: float) -> Texture:
    """Wallpaper with vertical stripes."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, first)
        step = period * PIXELS_PER_METER
        for left in np.arange(0, picture.shape[1], step):
            cv2.rectangle(picture, (int(left), 0), (int(left + 0.45 * step), picture.shape[0]), second, -1)
            cv2.line(picture, (int(left + 0.7 * step), 0), (int(left + 0.7 * step), picture.shape[0]), second, 1)
        return _modulate(picture, 0.04 * _cloud(rng, picture, 0.5))

    return draw


def motif(base: Color, accent: Color, step_m: float) -> Texture:
    """Wallpaper with a polygon repeated on a lattice."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, base)
        step = round(step_m * PIXELS_PER_METER)
        sides, turn, core = int(rng.integers(3, 9)), rng.uniform(0, 3), shade(base, 0.7)
        for row, y in enumerate(range(step // 2, picture.shape[0] + step, step)):
            for x in range((row % 2) * step // 2, picture.shape[1] + step, step):
                _polygon(picture, (x, y), 0.32 * step, sides, turn, accent)
                cv2.circle(picture, (x, y), max(1, round(0.12 * step)), core, -1, cv2.LINE_AA)
        return _modulate(picture, 0.04 * _cloud(rng, picture, 0.5))

    return draw


def bricks(base: Color) -> Texture:
    """A brick wall in stretcher bond."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, (165, 175, 180))
        length, course = round(0.25 * PIXELS_PER_METER), round(0.085 * PIXELS_PER_METER)
        for row, top in enumerate(range(0, picture.shape[0], course)):
            for left in range(-(row % 2) * length // 2, picture.shape[1], length):
                tint = shade(base, rng.uniform(0.65, 1.2))
                cv2.rectangle(picture, (left + 1, top + 1), (left + length - 2, top + course - 2), tint, -1)
        return _modulate(picture, 0.06 * _grain(rng, picture) + 0.06 * _cloud(rng, picture, 0.6))

    return draw


def wainscot(upper: Texture, lower: Texture, rail: Color, height_m: float = 1.1) -> Texture:
    """One wall finish above another, a rail between them and a skirting board at the floor."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        top, bottom = upper(rng, width, height), lower(rng, width, height)
        edge = max(0, top.shape[0] - round(height_m * PIXELS_PER_METER))
        top[edge:] = bottom[edge:]
        thickness = round(0.07 * PIXELS_PER_METER)
        cv2.rectangle(top, (0, edge - thickness // 2), (top.shape[1], edge + thickness // 2), rail, -1)
        cv2.rectangle(top, (0, top.shape[0] - thickness), (top.shape[1], top.shape[0]), rail, -1)
        return top

    return draw


def framed(rng: np.random.Generator, width: float, height: float) -> Image:
    """A picture for the wall: a landscape, blocks, discs, letters or a head, in a frame; all are different."""
    kinds = (_landscape, _blocks, _discs, _letters, _head)
    picture = kinds[rng.integers(len(kinds))](rng, width, height)
    border = max(3, round(0.05 * PIXELS_PER_METER))
    timber = color(rng.uniform(0.02, 0.12), rng.uniform(0.2, 0.9), rng.choice([0.15, 0.35, 0.6, 0.95]))
    cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), timber, 2 * border)
    return picture


def window(rng: np.random.Generator, width: float, height: float) -> Image:
    """A window: sky, hills and a tree or a tower behind white bars, with curtains at the sides."""
    picture = _landscape(rng, width, height)
    rows, columns = picture.shape[:2]
    bar = max(3, round(0.05 * PIXELS_PER_METER))
    for x in (0, columns // 2, columns):
        cv2.line(picture, (x, 0), (x, rows), (240, 245, 245), bar)
    for y in (0, rows // 3, rows):
        cv2.line(picture, (0, y), (columns, y), (240, 245, 245), bar)
    cloth = color(rng.uniform(), rng.uniform(0.3, 0.8), 0.8)
    drape = int(0.16 * columns)
    folds = 0.8 + 0.2 * np.sin(np.arange(drape) * rng.uniform(0.5, 0.9))
    curtain = np.broadcast_to(folds[None, :, None] * np.array(cloth), (rows, drape, 3)).astype(np.uint8)
    picture[:, :drape], picture[:, columns - drape :] = curtain, curtain[:, ::-1]
    return picture


def shelf(rng: np.random.Generator, width: float, height: float) -> Image:
    """A bookcase: boards and the spines of books."""
    timber = color(rng.uniform(0.04, 0.1), rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.6))
    picture = _canvas(width, height, shade(timber, 0.4))
    rows, columns = picture.shape[:2]
    board = max(2, round(0.03 * PIXELS_PER_METER))
    boards = max(2, round(height / 0.36))
    for index in range(boards):
        top, bottom = rows * index // boards, rows * (index + 1) // boards - board
        x = board
        while x < columns - board:
            thickness = int(rng.integers(3, 8))
            if rng.uniform() < 0.93:
                tall = int((bottom - top) * rng.uniform(0.6, 0.92))
                spine = color(rng.uniform(), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.95))
                cv2.rectangle(picture, (x, bottom - tall), (x + thickness - 1, bottom), spine, -1)
                cv2.line(picture, (x, bottom - tall * 2 // 3), (x + thickness - 1, bottom - tall * 2 // 3), (220,) * 3)
            x += thickness
        cv2.rectangle(picture, (0, bottom), (columns, bottom + board), timber, -1)
    cv2.rectangle(picture, (0, 0), (columns - 1, rows - 1), timber, 2 * board)
    return picture


def drawers(base: Color, columns: int, rows: int) -> Texture:
    """A chest's or a cupboard's front: a grid of doors or drawers with knobs."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = plain(base)(rng, width, height)
        tall, wide = picture.shape[:2]
        for row in range(rows):
            for column in range(columns):
                left, right = wide * column // columns + 3, wide * (column + 1) // columns - 4
                top, bottom = tall * row // rows + 3, tall * (row + 1) // rows - 4
                cv2.rectangle(picture, (left, top), (right, bottom), shade(base, rng.uniform(0.85, 1.1)), -1)
                cv2.rectangle(picture, (left, top), (right, bottom), shade(base, 0.5), 1)
                cv2.circle(picture, ((left + right) // 2, (2 * top + bottom) // 3), 3, (60, 200, 220), -1, cv2.LINE_AA)
        return picture

    return draw


def plaid(base: Color, accent: Color) -> Texture:
    """Cloth with crossing bands."""

    def draw(rng: np.random.Generator, width: float, height: float) -> Image:
        picture = _canvas(width, height, base).astype(np.float32)
        step = int(rng.uniform(0.12, 0.3) * PIXELS_PER_METER)
        rows, columns = np.arange(picture.shape[0]) % step, np.arange(picture.shape[1]) % step
        bands = 0.35 * (rows < step // 3)[:, None] + 0.35 * (columns < step // 3)[None]
        mixed = picture * (1 - bands[..., None]) + np.array(accent, np.float32) * bands[..., None]
        return _modulate(mixed.astype(np.uint8), 0.06 * _grain(rng, picture))

    return draw


def appliance(rng: np.random.Generator, width: float, height: float) -> Image:
    """A stove, oven or washing machine: a white front with a dark round or square window and knobs."""
    picture = plain((235, 235, 230), 0.03)(rng, width, height)
    rows, columns = picture.shape[:2]
    for index in range(5):
        x = (2 * index + 1) * columns // 10
        cv2.circle(picture, (x, rows // 9), max(2, columns // 22), (40, 40, 40), -1, cv2.LINE_AA)
    if rng.uniform() < 0.5:
        cv2.circle(picture, (columns // 2, rows * 3 // 5), int(0.32 * columns), (60, 50, 45), -1, cv2.LINE_AA)
        cv2.circle(picture, (columns // 2, rows * 3 // 5), int(0.32 * columns), (160, 160, 160), 3, cv2.LINE_AA)
    else:
        cv2.rectangle(picture, (columns // 8, rows // 4), (columns * 7 // 8, rows * 4 // 5), (50, 45, 40), -1)
        cv2.line(picture, (columns // 8, rows // 4 - 4), (columns * 7 // 8, rows // 4 - 4), (150, 150, 150), 4)
    return picture


def screen(rng: np.random.Generator, width: float, height: float) -> Image:
    """A monitor or television, switched on: windows with lines of text."""
    picture = _canvas(width, height, color(rng.uniform(), 0.6, 0.5))
    rows, columns = picture.shape[:2]
    for _ in range(3):
        x, y = int(rng.uniform(0, 0.6) * columns), int(rng.uniform(0, 0.5) * rows)
        right, bottom = x + columns // 3, y + rows // 2
        cv2.rectangle(picture, (x, y), (right, bottom), color(rng.uniform(), 0.2, 0.95), -1)
        for line in range(y + 5, bottom - 2, 4):
            cv2.line(picture, (x + 3, line), (x + 3 + int(rng.uniform(0.3, 0.9) * columns / 3), line), (60, 60, 60), 1)
    cv2.rectangle(picture, (0, 0), (columns - 1, rows - 1), (25, 25, 25), 5)
    return picture


def _landscape(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = _canvas(width, height, (0, 0, 0))
    rows, columns = picture.shape[:2]
    hue = rng.choice([0.55, 0.58, 0.62, 0.07])
    top, bottom = np.array(color(hue, 0.7, 0.9)), np.array(color(hue, 0.15, 1.0))
    ramp = np.linspace(0, 1, rows)[:, None, None]
    picture[:] = (top * (1 - ramp) + bottom * ramp).astype(np.uint8)
    sun = (int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.1, 0.35) * rows))
    cv2.circle(picture, sun, max(3, rows // 12), (210, 245, 255), -1, cv2.LINE_AA)
    x = np.arange(columns)
    ground = rng.uniform(0.25, 0.45)
    for layer in range(3):
        waves = np.sin(x * rng.uniform(2, 6) * (layer + 1) / columns + rng.uniform(0, 6))
        edge = (rows * (0.4 + 0.18 * layer) + 0.1 * rows * waves).astype(int)
        hill = color(ground + rng.uniform(-0.06, 0.06), 0.35 + 0.15 * layer, 0.7 - 0.15 * layer)
        outline = np.vstack([np.column_stack([x, edge]), [[columns, rows], [0, rows]]])
        cv2.fillPoly(picture, [outline.astype(np.int32)], hill, cv2.LINE_AA)
    for _ in range(int(rng.integers(1, 4))):
        foot, base = int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.7, 0.9) * rows)
        if rng.uniform() < 0.5:
            cv2.line(picture, (foot, base), (foot, base - rows // 5), (30, 50, 70), max(2, columns // 50))
            cv2.circle(picture, (foot, base - rows // 4), rows // 8, color(0.3, 0.8, 0.4), -1, cv2.LINE_AA)
        else:
            half = columns // 16
            cv2.rectangle(picture, (foot - half, base - rows // 3), (foot + half, base), (120, 140, 190), -1)
            eaves = base - rows // 3
            roof = np.array([[foot - 2 * half, eaves], [foot, base - rows // 2], [foot + 2 * half, eaves]])
            cv2.fillPoly(picture, [roof], (40, 40, 150), cv2.LINE_AA)
    return picture


def _blocks(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = _canvas(width, height, (235, 240, 240))
    rows, columns = picture.shape[:2]
    xs = np.sort(rng.integers(0, columns, 4)).tolist()
    ys = np.sort(rng.integers(0, rows, 4)).tolist()
    for left, right in zip([0, *xs], [*xs, columns], strict=True):
        for top, bottom in zip([0, *ys], [*ys, rows], strict=True):
            if rng.uniform() < 0.55:
                fill = color(rng.choice([0.0, 0.13, 0.6, rng.uniform()]), 0.85, 0.9)
                cv2.rectangle(picture, (left, top), (right, bottom), fill, -1)
            cv2.rectangle(picture, (left, top), (right, bottom), (20, 20, 20), 3)
    return picture


def _discs(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = _canvas(width, height, color(rng.uniform(), 0.5, rng.uniform(0.3, 1)))
    rows, columns = picture.shape[:2]
    for _ in range(7):
        center = (int(rng.integers(columns)), int(rng.integers(rows)))
        for radius in range(int(rng.integers(rows // 8, rows // 3)), 2, -max(3, rows // 14)):
            cv2.circle(picture, center, radius, color(rng.uniform(), 0.8, 0.9), -1, cv2.LINE_AA)
    return picture


def _letters(rng: np.random.Generator, width: float, height: float) -> Image:
    paper = color(rng.uniform(), rng.uniform(0.1, 0.9), 0.95)
    picture = _canvas(width, height, paper)
    rows, columns = picture.shape[:2]
    for line in range(3):
        word = "".join(chr(65 + int(code)) for code in rng.integers(0, 26, 4))
        ink = color(rng.uniform(), 0.9, 0.25)
        foot = (columns // 9, rows * (line + 1) // 4 + rows // 12)
        cv2.putText(picture, word, foot, cv2.FONT_HERSHEY_DUPLEX, min(columns / 95, rows / 95), ink, 2)
    return picture


def _head(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = _canvas(width, height, color(rng.uniform(), 0.6, 0.6))
    rows, columns = picture.shape[:2]
    skin, coat = color(rng.uniform(0.02, 0.1), 0.45, rng.uniform(0.5, 0.95)), color(rng.uniform(), 0.7, 0.5)
    cv2.ellipse(picture, (columns // 2, rows), (columns * 2 // 5, rows * 2 // 5), 0, 0, 360, coat, -1, cv2.LINE_AA)
    hair = color(rng.uniform(), 0.5, 0.3)
    cv2.ellipse(picture, (columns // 2, rows * 2 // 5), (columns // 5, rows // 4), 0, 0, 360, hair, -1, cv2.LINE_AA)
    cv2.ellipse(picture, (columns // 2, rows * 9 // 20), (columns // 6, rows // 5), 0, 0, 360, skin, -1, cv2.LINE_AA)
    for side in (-1, 1):
        cv2.circle(picture, (columns // 2 + side * columns // 14, rows * 2 // 5), 2, (30, 30, 30), -1)
    return picture


def _canvas(width: float, height: float, base: Color) -> Image:
    shape = (max(8, round(height * PIXELS_PER_METER)), max(8, round(width * PIXELS_PER_METER)), 3)
    return np.full(shape, base, np.float32).astype(np.uint8)


def _cloud(rng: np.random.Generator, picture: NDArray, scale_m: float) -> NDArray[np.float64]:
    """Smooth noise (H, W) of about unit size, its blobs ``scale_m`` wide."""
    rows, columns = picture.shape[:2]
    cell = scale_m * PIXELS_PER_METER
    coarse = rng.normal(size=(int(rows / cell) + 3, int(columns / cell) + 3))
    return np.asarray(cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC), float)


def _grain(rng: np.random.Generator, picture: NDArray) -> NDArray[np.float64]:
    return rng.normal(size=picture.shape[:2])


def _modulate(picture: Image, relative: NDArray[np.float64]) -> Image:
    """Brighten each pixel by a factor of 1 + ``relative`` (H, W)."""
    return np.clip(picture * (1 + relative[..., None]), 0, 255).astype(np.uint8)


def _polygon(picture: Image, center: tuple[int, int], radius: float, sides: int, turn: float, fill: Color) -> None:
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    corners = np.column_stack([center[0] + radius * np.cos(angles), center[1] + radius * np.sin(angles)])
    cv2.fillPoly(picture, [np.round(corners).astype(np.int32)], fill, cv2.LINE_AA)
