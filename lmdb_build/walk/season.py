"""The same house in another season: repainted and redecorated, in other light and other weather.

Nothing moves: geometry and poses are those of season 1, so that the two walks are two traverses of one route.
Everything follows from the house's seed and the number of the season. Season 1 is the house as it is built.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lmdb_build.walk.house import House, Quad
from lmdb_build.walk.textures import Image
from netspec.files.opencv import cv2

REPAINTED = 0.5  # share of the rooms whose walls, floor and ceiling get another hue
REPAINT_TURNS = 0.5  # by at most this share of the color circle; everything else by at most FADE_TURNS
FADE_TURNS = 0.04
EXCHANGED = 0.5  # share of the pictures on the walls that are replaced by others
NIGHT = 0.3  # share of the seasons in which the walk is at night


@dataclass(frozen=True)
class Weather:
    """How the weather of a season changes a picture and the view through the windows.

    haze   share of white in the view through the windows (0 to 1)
    veil   share of uniform gray over the whole picture, as by a fogged or dirty lens
    blur   standard deviation in pixels
    noise  the sensor's noise, as a multiple of that of season 1
    day    factor of the brightness of daylight
    """

    haze: float = 0.0
    veil: float = 0.0
    blur: float = 0.5
    noise: float = 1.0
    day: float = 1.0


def weather(seed: int, season: int) -> Weather:
    """Return the weather of ``season``, from 1; that of season 1 changes nothing."""
    if season == 1:
        return Weather()
    rng = np.random.default_rng([seed, 6, season])
    night = rng.uniform() < NIGHT
    return Weather(
        haze=rng.uniform(0, 0.8),
        veil=rng.uniform(0, 0.25),
        blur=rng.uniform(0.5, 1.0),
        noise=rng.uniform(2, 3) if night else rng.uniform(1, 2),
        day=0.04 if night else rng.uniform(0.4, 1.0),
    )


def redecorate(house: House, seed: int, season: int) -> House:
    """Return the house with the surfaces that it has in ``season``; its geometry stays."""
    if season == 1:
        return house
    rng = np.random.default_rng([seed, 7, season])
    haze = weather(seed, season).haze
    repaints = [_paint(rng, REPAINT_TURNS if rng.uniform() < REPAINTED else FADE_TURNS) for _ in house.rooms]
    fades = [_paint(rng, FADE_TURNS) for _ in house.rooms]
    quads = []
    for quad in house.quads:
        if quad.glow == "daylight":
            texture = cv2.addWeighted(quad.texture, 1 - haze, np.full_like(quad.texture, 235), haze, 0)
        elif quad.glow:
            texture = quad.texture
        elif quad.draw and rng.uniform() < EXCHANGED:
            texture = _drawn_anew(quad, rng)
        else:
            texture = _recolored(quad.texture, *(repaints if quad.shell else fades)[quad.room])
        quads.append(replace(quad, texture=texture))
    return House(quads, house.rooms, house.way, house.step_m)


def _paint(rng: np.random.Generator, turns: float) -> tuple[float, float, float]:
    """Draw a change of hue (in turns) and factors of saturation and of value."""
    return rng.uniform(-turns, turns), np.exp(rng.uniform(-0.5, 0.3)), np.exp(rng.uniform(-0.25, 0.15))


def _drawn_anew(quad: Quad, rng: np.random.Generator) -> Image:
    assert quad.draw
    return quad.draw(rng, float(np.linalg.norm(quad.right)), float(np.linalg.norm(quad.down)))


def _recolored(texture: Image, turns: float, saturation: float, value: float) -> Image:
    hsv = cv2.cvtColor(texture.astype(np.float32) / 255, cv2.COLOR_BGR2HSV)
    hsv[..., 0] = (hsv[..., 0] + 360 * turns) % 360
    hsv[..., 1:] = np.minimum(hsv[..., 1:] * np.array([saturation, value], np.float32), 1)
    return np.round(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)).astype(np.uint8)
