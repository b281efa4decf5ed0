"""Surfaces of the synthetic house: floors, walls, pictures and fronts of furniture, drawn from a seed.

Every function takes a random generator and the surface's size in meters, then what it may look like, and returns a BGR
picture (H, W, 3) uint8 at ``PIXELS_PER_METER``. The first row is the top of a wall, or the far edge of a floor.
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
    red, green, blue = colorsys.hsv_to_rgb(hue % 1, saturation, value)
    return 255 * blue, 255 * green, 255 * red


def plain(rng: np.random.Generator, width: float, height: float, base: Color, roughness: float = 0.05) -> Image:
    """Paint or plaster: one color with faint clouds and grain."""
    shape = (max(8, round(height * PIXELS_PER_METER)), max(8, round(width * PIXELS_PER_METER)))
    cell = 0.6 * PIXELS_PER_METER
    coarse = rng.normal(size=(int(shape[0] / cell) + 3, int(shape[1] / cell) + 3))
    clouds = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    light = 1 + roughness * clouds + roughness / 3 * rng.normal(size=shape)
    return np.clip(light[..., None] * np.array(base), 0, 255).astype(np.uint8)


def courses(
    rng: np.random.Generator, width: float, height: float, tints: tuple[Color, ...], size: tuple[float, float]
) -> Image:
    """Bricks, boards or tiles of ``size`` (width, height) in m, with joints; each row begins half a brick later."""
    picture = plain(rng, width, height, (120, 125, 130))
    wide, tall = (max(5, round(side * PIXELS_PER_METER)) for side in size)
    for row, top in enumerate(range(0, picture.shape[0], tall)):
        for column, left in enumerate(range(-(row % 2) * wide // 2, picture.shape[1], wide)):
            tint = np.array(tints[(row + column) % len(tints)]) * rng.uniform(0.7, 1.1)
            cv2.rectangle(picture, (left + 1, top + 1), (left + wide - 2, top + tall - 2), tint.tolist(), -1)
    return picture


def bands(
    rng: np.random.Generator, width: float, height: float, colors: tuple[Color, Color], period: float, across: bool
) -> Image:
    """Wallpaper with vertical stripes every ``period`` meters; or cloth, which also has stripes ``across``.

    ``colors``: of the ground, and of the stripes.
    """
    base, accent = colors
    picture = plain(rng, width, height, base)
    step = max(4, round(period * PIXELS_PER_METER))
    share = 0.6 * (np.arange(picture.shape[1]) % step < step // 3)[None]
    share = share + 0.35 * across * (np.arange(picture.shape[0]) % step < step // 3)[:, None]
    return (picture * (1 - share[..., None]) + share[..., None] * np.array(accent)).astype(np.uint8)


def motif(rng: np.random.Generator, width: float, height: float, base: Color, accent: Color, step_m: float) -> Image:
    """Wallpaper or carpet with a polygon repeated on a lattice."""
    picture = plain(rng, width, height, base)
    step, sides, turn = round(step_m * PIXELS_PER_METER), int(rng.integers(3, 9)), rng.uniform(0, 3)
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    outline = np.round(0.32 * step * np.column_stack([np.cos(angles), np.sin(angles)])).astype(np.int32)
    for row, y in enumerate(range(step // 2, picture.shape[0] + step, step)):
        for x in range((row % 2) * step // 2, picture.shape[1] + step, step):
            cv2.fillPoly(picture, [outline + np.array([x, y], np.int32)], accent, cv2.LINE_AA)
            cv2.circle(picture, (x, y), max(1, round(0.12 * step)), base, -1, cv2.LINE_AA)
    return picture


def paneled(
    rng: np.random.Generator, width: float, height: float, upper: Texture, lower: Texture, height_m: float
) -> Image:
    """One wall finish above another, ``height_m`` above the floor, with a dark rail between them."""
    picture, bottom = upper(rng, width, height), lower(rng, width, height)
    edge = max(0, len(picture) - round(height_m * PIXELS_PER_METER))
    picture[edge:] = bottom[edge:]
    picture[edge : edge + 6] = picture[-6:] = 60
    return picture


def framed(rng: np.random.Generator, width: float, height: float) -> Image:
    """A picture for the wall in a frame: a landscape, blocks, discs or letters. No two are the same."""
    picture = (_landscape, _blocks, _discs, _letters)[rng.integers(4)](rng, width, height)
    rows, columns = picture.shape[:2]
    timber = color(rng.uniform(0.02, 0.12), rng.uniform(0.2, 0.9), rng.choice([0.15, 0.35, 0.6, 0.95]))
    cv2.rectangle(picture, (0, 0), (columns - 1, rows - 1), timber, 10)
    return picture


def shelf(rng: np.random.Generator, width: float, height: float) -> Image:
    """A bookcase: boards and the spines of books."""
    timber = color(rng.uniform(0.04, 0.1), rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.6))
    picture = (0.4 * plain(rng, width, height, timber)).astype(np.uint8)
    rows, columns = picture.shape[:2]
    boards = max(2, round(height / 0.36))
    for top, bottom in zip(rows * np.arange(boards) // boards, rows * np.arange(1, boards + 1) // boards, strict=True):
        x = 3
        while x < columns - 3:
            thick, tall = int(rng.integers(3, 8)), int((bottom - top) * rng.uniform(0.55, 0.9))
            spine = color(rng.uniform(), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.95))
            cv2.rectangle(picture, (x, int(bottom) - tall), (x + thick - 1, int(bottom)), spine, -1)
            x += thick
        cv2.line(picture, (0, int(bottom) - 1), (columns, int(bottom) - 1), timber, 3)
    cv2.rectangle(picture, (0, 0), (columns - 1, rows - 1), timber, 6)
    return picture


def doors(rng: np.random.Generator, width: float, height: float, base: Color, columns: int, rows: int) -> Image:
    """The front of a chest or cupboard: a grid of doors or drawers with knobs."""
    picture = plain(rng, width, height, base)
    tall, wide = picture.shape[:2]
    for row in range(rows):
        for column in range(columns):
            left, right = wide * column // columns + 3, wide * (column + 1) // columns - 4
            top, bottom = tall * row // rows + 3, tall * (row + 1) // rows - 4
            tint = np.array(base) * rng.uniform(0.8, 1.1)
            cv2.rectangle(picture, (left, top), (right, bottom), tint.tolist(), -1)
            cv2.rectangle(picture, (left, top), (right, bottom), (tint / 2).tolist(), 1)
            cv2.circle(picture, ((left + right) // 2, (2 * top + bottom) // 3), 3, (60, 200, 220), -1, cv2.LINE_AA)
    return picture


def _landscape(rng: np.random.Generator, width: float, height: float) -> Image:
    sky = color(rng.choice([0.55, 0.58, 0.62, 0.07]), rng.uniform(0.2, 0.6), 0.95)
    picture = plain(rng, width, height, sky)
    rows, columns = picture.shape[:2]
    x, ground = np.arange(columns), rng.uniform(0.25, 0.45)
    sun = (int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.1, 0.35) * rows))
    cv2.circle(picture, sun, max(3, rows // 12), (210, 245, 255), -1, cv2.LINE_AA)
    for hill in range(3):
        waves = np.sin(x * rng.uniform(2, 6) * (hill + 1) / columns + rng.uniform(0, 6))
        outline = np.column_stack([x, rows * (0.4 + 0.18 * hill + 0.1 * waves)])
        outline = np.vstack([outline, [[columns, rows], [0, rows]]]).astype(np.int32)
        cv2.fillPoly(picture, [outline], color(ground, 0.35 + 0.15 * hill, 0.7 - 0.15 * hill), cv2.LINE_AA)
    for _ in range(int(rng.integers(1, 4))):  # houses and trees
        foot, base = int(rng.uniform(0.1, 0.9) * columns), int(rng.uniform(0.7, 0.9) * rows)
        corners = (foot - columns // 16, base - rows // 3), (foot + columns // 16, base)
        cv2.rectangle(picture, *corners, color(rng.uniform(), 0.5, 0.7), -1)
        cv2.circle(picture, (foot, base - rows // 3), rows // 10, color(rng.uniform(), 0.8, 0.4), -1, cv2.LINE_AA)
    return picture


def _blocks(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = plain(rng, width, height, (235, 240, 240))
    rows, columns = picture.shape[:2]
    for _ in range(9):
        left, top = int(rng.integers(columns)), int(rng.integers(rows))
        corner = (left + int(rng.integers(columns // 6, columns // 2)), top + int(rng.integers(rows // 6, rows // 2)))
        cv2.rectangle(picture, (left, top), corner, color(rng.uniform(), 0.85, 0.9), -1)
        cv2.rectangle(picture, (left, top), corner, (20, 20, 20), 3)
    return picture


def _discs(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = plain(rng, width, height, color(rng.uniform(), 0.5, rng.uniform(0.3, 1)))
    rows, columns = picture.shape[:2]
    for _ in range(7):
        center = (int(rng.integers(columns)), int(rng.integers(rows)))
        for radius in range(int(rng.integers(rows // 8, rows // 3)), 2, -max(3, rows // 14)):
            cv2.circle(picture, center, radius, color(rng.uniform(), 0.8, 0.9), -1, cv2.LINE_AA)
    return picture


def _letters(rng: np.random.Generator, width: float, height: float) -> Image:
    picture = plain(rng, width, height, color(rng.uniform(), rng.uniform(0.1, 0.9), 0.95))
    rows, columns = picture.shape[:2]
    for line in range(3):
        word = "".join(chr(65 + int(code)) for code in rng.integers(0, 26, 4))
        foot = (columns // 9, rows * (line + 1) // 4 + rows // 12)
        size, ink = min(columns / 95, rows / 95), color(rng.uniform(), 0.9, 0.25)
        cv2.putText(picture, word, foot, cv2.FONT_HERSHEY_DUPLEX, size, ink, 2)
    return picture
