"""Changes how a view looks: light, season, weather, and objects in front of it."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[Any]  # (H, W, 3) float32, BGR, 0 to 1 for black to white

# For each change: its probability for a view, and its strength.
OCCLUDED, PARTS, PART_HEIGHT, PART_WIDTH = 0.3, (1, 2), (0.12, 0.45), (0.1, 0.4)  # shares of the view's size
FADED, SATURATION, TINT = 0.6, (0.0, 1.3), 0.15
MIXED, MIX = 0.4, 0.15  # for faded views: colors mixed by a random matrix
GAMMA_DRAWN, GAMMA = 0.7, 0.45
TONED, TONE_STEPS, TONE = 0.3, 5, 0.25  # a tone curve that may fall: snow, wet ground, lit windows
UNEVEN, UNEVEN_LIGHT = 0.5, 0.45  # light that differs over the view, in 3 cells of height
SHADED, SHADE = 0.3, (0.3, 0.7)
FOGGED, FOG, FOG_LIGHT = 0.2, (0.2, 0.8), (0.4, 1.0)
CONTRAST, BRIGHTNESS = 0.3, 0.12
BLURRED, BLUR = 0.35, (0.4, 1.8)  # in pixels
NOISE = 4 / 255  # mean of an exponential distribution of standard deviations

GRAY = np.array([0.114, 0.587, 0.299], np.float32)  # of blue, green, red: Rec. 601


def change_light(
    view: NDArray[np.uint8], other: Callable[[], NDArray], rng: np.random.Generator, calm: float = 0.0
) -> NDArray[np.uint8]:
    """Return the view (H, W, 3), BGR, as it might look at another time.

    Parts of the picture that ``other`` returns may cover it. With probability ``calm``, its colors and tones do not
    change, nothing covers it, and there is no fog.
    """
    x = view.astype(np.float32) / 255
    changes = not (calm and rng.random() < calm)
    if changes and rng.random() < OCCLUDED:
        _occlude(x, other(), rng)
    if changes and rng.random() < FADED:
        x = _other_colors(x, rng)
    if rng.random() < GAMMA_DRAWN:
        x = np.clip(x, 0, 1) ** np.float32(np.exp(rng.normal(0, GAMMA)))
    if changes and rng.random() < TONED:
        x = _other_tones(x, rng)
    if rng.random() < UNEVEN:
        x = x * np.exp(UNEVEN_LIGHT * _clouds(x, 3, rng))
    if rng.random() < SHADED:
        x = x * (1 - rng.uniform(*SHADE) * _shadow(x, rng))
    if changes and rng.random() < FOGGED:
        fog = np.clip(rng.uniform(*FOG) + 0.2 * _clouds(x, 2, rng), 0, 0.9)
        x = x * (1 - fog) + fog * rng.uniform(*FOG_LIGHT)
    mean = x.mean()
    x = (x - mean) * np.exp(rng.normal(0, CONTRAST)) + np.clip(mean + rng.normal(0, BRIGHTNESS), 0.05, 0.95)
    if rng.random() < BLURRED:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(*BLUR))
    x = x + rng.exponential(NOISE) * rng.standard_normal((*x.shape[:2], 1), np.float32)
    return np.clip(np.round(x * 255), 0, 255).astype(np.uint8)


def _occlude(x: Picture, other: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Copy one or two rectangles of another picture into ``x``, to simulate people, cars or furniture."""
    for _ in range(rng.integers(PARTS[0], PARTS[1] + 1)):
        size = [
            int(side * rng.uniform(*share)) for side, share in zip(x.shape, (PART_HEIGHT, PART_WIDTH), strict=False)
        ]
        height, width = (max(1, min(side, most)) for side, most in zip(size, other.shape, strict=False))
        top, left = (rng.integers(most - side + 1) for side, most in zip((height, width), other.shape, strict=False))
        part = other[top : top + height, left : left + width]
        top, left = (rng.integers(most - side + 1) for side, most in zip((height, width), x.shape, strict=False))
        x[top : top + height, left : left + width] = part.astype(np.float32) / 255


def _other_colors(x: Picture, rng: np.random.Generator) -> Picture:
    share = np.float32(rng.uniform(*SATURATION))
    x = (x @ GRAY)[..., None] * (1 - share) + x * share
    if rng.random() < MIXED:
        mix = np.eye(3) + rng.normal(0, MIX, (3, 3))
        x = x @ (mix / mix.sum(axis=1, keepdims=True)).T.astype(np.float32)
    return x * np.exp(rng.normal(0, TINT, 3)).astype(np.float32)


def _other_tones(x: Picture, rng: np.random.Generator) -> Picture:
    steps = np.linspace(0, 1, TONE_STEPS)
    curve = np.interp(np.linspace(0, 1, 256), steps, steps + rng.normal(0, TONE, TONE_STEPS))
    curve = cv2.GaussianBlur(curve.reshape(1, -1), (0, 0), 12).ravel().astype(np.float32)
    return curve[np.clip(x * 255, 0, 255).astype(np.uint8)]


def _clouds(x: Picture, cells: int, rng: np.random.Generator) -> Picture:
    """Return smooth random numbers (H, W, 1), mean 0, about ``cells`` bumps over the height."""
    coarse = rng.standard_normal((cells, cells + 1)).astype(np.float32)
    return cv2.resize(coarse, x.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]


def _shadow(x: Picture, rng: np.random.Generator) -> Picture:
    """Return the shape of a shadow (H, W, 1): 1 inside of a random polygon, 0 outside, with a soft edge."""
    height, width = x.shape[:2]
    corners = rng.integers([-width // 2, -height // 2], [width * 3 // 2, height * 3 // 2], (rng.integers(3, 6), 2))
    shape = np.zeros((height, width), np.float32)
    cv2.fillPoly(shape, [corners.astype(np.int32)], 1.0)
    return cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.5, 4))[..., None]
