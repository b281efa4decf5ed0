"""Random windows of images with objects and background, the data of R-CNN.

Caffe: src/caffe/layers/window_data_layer.cpp
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from netspec import log
from netspec.data.datum import decode_pixels, planar
from netspec.data.mean import read_mean
from netspec.data.random_words import words_at
from netspec.data.resize import resized
from netspec.data.sources import Arrays, Cursor, Draws, Shape
from netspec.data.transformer import mean_contradictions
from netspec.errors import SpecError, Where
from netspec.files.limits import read_bytes

CHANNELS = 3  # images are always read in color


@dataclass(frozen=True)
class Window:
    """A box in an image, including its corners."""

    image: int
    label: int
    x1: int
    y1: int
    x2: int
    y2: int


@dataclass(frozen=True)
class WindowFile:
    """The contents of a window file: images, windows with an object (foreground), and windows without (background)."""

    images: list[str]
    foreground: list[Window]
    background: list[Window]


def read_window_file(param: Any, where: Where | None) -> WindowFile:
    """Read the window file of a window_data_param: images with their windows, one item per line.

    For each image: ``# index``, path, channels, height, width, number of windows; then ``label overlap x1 y1 x2 y2``. A
    window is foreground if its overlap is at least ``fg_threshold``, background if it is below ``bg_threshold``, and is
    otherwise ignored.
    """
    path: str = param.source
    try:
        lines = [(number, line.strip()) for number, line in enumerate(read_bytes(path).decode().splitlines(), 1)]
    except (OSError, UnicodeDecodeError) as fault:
        raise SpecError(f'window file "{path}" cannot be read: {fault}', where) from None
    remaining = iter([(number, line) for number, line in lines if line])
    position = Where(path)

    def numbers(count: int, what: str) -> list[float]:
        nonlocal position
        number, line = next(remaining, (len(lines), ""))
        position = Where(path, number, 1)
        try:
            values = [float(word) for word in line.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise SpecError(f'found "{line}", expected {what}', position)
        return values

    found = WindowFile([], [], [])
    for number, line in remaining:
        position = Where(path, number, 1)
        if line.split() != ["#", str(len(found.images))]:
            raise SpecError(f'found "{line}", expected "# {len(found.images)}", the number of the next image', position)
        image = len(found.images)
        found.images.append(param.root_folder + next(remaining, (number, ""))[1])
        for what in ("the image's channels", "its height", "its width"):
            numbers(1, what)
        for _ in range(int(numbers(1, "the number of windows")[0])):
            label, overlap, *corners = numbers(6, "label overlap x1 y1 x2 y2")
            x1, y1, x2, y2 = map(int, corners)
            if not (label.is_integer() and abs(label) < 2**31):
                raise SpecError(f"found label {label:.17g}, expected an integer of 32 bits", position)
            if overlap >= param.fg_threshold:
                if label <= 0:
                    raise SpecError(
                        f"found label {label:g} for a foreground window, expected a label above 0", position
                    )
                found.foreground.append(Window(image, int(label), x1, y1, x2, y2))
            elif overlap < param.bg_threshold:
                found.background.append(Window(image, 0, x1, y1, x2, y2))
    if not found.images:
        raise SpecError(f'the window file "{path}" is empty', where or Where(path))
    log.info("window_data_layer.cpp:160", f"Number of images: {len(found.images)}")
    return found


class WindowSource:
    """Batches of windows, background first, each warped to ``crop_size`` x ``crop_size`` with some context around it.

    ``file`` comes from :func:`read_window_file`, ``mean`` from :func:`window_mean`. As in Caffe,
    ``transform_param.scale`` is not used, and pixels outside of the image are 0 after the mean is subtracted.
    """

    def __init__(
        self, param: Any, transform: Any, file: WindowFile, mean: np.ndarray, at: Callable[..., Where], draws: Draws
    ) -> None:
        self._crop: int = transform.crop_size
        self._mirror: bool = transform.mirror
        self._pad: int = param.context_pad
        self._square = param.crop_mode == "square"
        self._scale = np.float32(param.scale)
        where = at("window_data_param", "source")
        self._file, self._mean = file, mean
        foreground = int(np.float32(param.batch_size) * np.float32(param.fg_fraction))
        self._kinds = [self._file.background] * (param.batch_size - foreground) + [self._file.foreground] * foreground
        for kind, name in ((self._file.background, "background"), (self._file.foreground, "foreground")):
            if not kind and any(wanted is kind for wanted in self._kinds):
                raise SpecError(f'"{param.source}" has no {name} windows, but each batch needs some', where)
        self._draws, self._where = draws, where
        count = len(self._file.foreground) + len(self._file.background)
        self.cursor = Cursor(count, param.batch_size, draws=draws)
        self._bytes = lru_cache(maxsize=None if param.cache_images else 0)(lambda path: Path(path).read_bytes())

    @property
    def shapes(self) -> Sequence[Shape]:
        """The shapes of all tops."""
        size = self.cursor.batch_size
        return (size, CHANNELS, self._crop, self._crop), (size,)

    def batch(self, iteration: int) -> Arrays:
        """Return the tops of an iteration, float32."""
        data = np.zeros(self.shapes[0], np.float32)
        drawn = self._draw(iteration)
        for out, (window, mirror) in zip(data, drawn, strict=True):
            self._cut(out, window, mirror)
        return data, np.array([window.label for window, _ in drawn], np.float32)

    def keys(self, iteration: int) -> list[str]:
        """Return ``image:x1,y1,x2,y2`` of each window of an iteration."""
        return [f"{self._file.images[w.image]}:{w.x1},{w.y1},{w.x2},{w.y2}" for w, _ in self._draw(iteration)]

    def _draw(self, iteration: int) -> list[tuple[Window, bool]]:
        draws = words_at(self._draws.seed, self._draws.stream, self.cursor.positions(iteration)).tolist()
        return [
            (kind[index % len(kind)], self._mirror and mirror % 2 == 1)
            for kind, (index, mirror, *_) in zip(self._kinds, draws, strict=True)
        ]

    def _cut(self, out: np.ndarray, window: Window, mirror: bool) -> None:
        path = self._file.images[window.image]
        try:
            pixels = decode_pixels(self._bytes(path), color=True)
        except (OSError, ValueError) as fault:
            raise SpecError(f'image "{path}" cannot be read: {fault}', self._where) from None
        box, (top, left), (height, width) = self._fit(window, pixels.shape[0], pixels.shape[1], mirror)
        x1, y1, x2, y2 = box
        if not (0 <= x1 <= x2 < pixels.shape[1] and 0 <= y1 <= y2 < pixels.shape[0]):
            raise SpecError(f'the window {window} is not inside image "{path}"', self._where)
        if not (height and width):
            return
        patch = resized(pixels[y1 : y2 + 1, x1 : x2 + 1], height, width)
        if mirror:
            patch = patch[:, ::-1]
        region = np.s_[:, top : top + height, left : left + width]
        out[region] = (planar(patch) - self._mean[region]) * self._scale

    def _fit(
        self, window: Window, rows: int, columns: int, mirror: bool
    ) -> tuple[tuple[int, int, int, int], tuple[int, int], tuple[int, int]]:
        """Return the box to crop from the image, and its position (top, left) and size (height, width) in the crop."""
        x1, y1, x2, y2 = window.x1, window.y1, window.x2, window.y2
        crop = self._crop
        if not (self._pad or self._square):
            return (x1, y1, x2, y2), (0, 0), (crop, crop)
        # Enlarge the box so that, after warping, there are `pad` pixels of context on each side.
        context = crop / (crop - 2 * self._pad)
        half_h, half_w = (y2 - y1 + 1) / 2, (x2 - x1 + 1) / 2
        center_x, center_y = x1 + half_w, y1 + half_h
        if self._square:
            half_h = half_w = max(half_h, half_w)
        x1, x2 = _round(center_x - half_w * context), _round(center_x + half_w * context)
        y1, y2 = _round(center_y - half_h * context), _round(center_y + half_h * context)
        scale_x, scale_y = crop / (x2 - x1 + 1), crop / (y2 - y1 + 1)
        beyond_left, beyond_right = max(0, -x1), max(0, x2 - columns + 1)
        beyond_top, beyond_bottom = max(0, -y1), max(0, y2 - rows + 1)
        box = (x1 + beyond_left, y1 + beyond_top, x2 - beyond_right, y2 - beyond_bottom)
        top = _round(beyond_top * scale_y)
        left = _round((beyond_right if mirror else beyond_left) * scale_x)  # mirror the margin too
        height = min(_round((box[3] - box[1] + 1) * scale_y), crop - top)
        width = min(_round((box[2] - box[0] + 1) * scale_x), crop - left)
        return box, (top, left), (height, width)


def wrong_means(transform: Any, at: Callable[..., Where]) -> Iterator[SpecError]:
    """Yield the errors in the mean of a transform_param, except for its file."""
    yield from mean_contradictions(transform, at)
    if len(transform.mean_value) not in (0, 1, CHANNELS):
        message = f"found {len(transform.mean_value)} mean_value, expected 1 or {CHANNELS}"
        yield SpecError(message, at("transform_param", "mean_value"))


def window_mean(transform: Any, at: Callable[..., Where]) -> np.ndarray:
    """Return the mean to subtract, float32 (3, crop, crop) or, from mean_value, (3, 1, 1) broadcast to it."""
    crop: int = transform.crop_size
    if transform.mean_file:
        where = at("transform_param", "mean_file")
        mean = read_mean(transform.mean_file, where)
        offset = (mean.shape[2] - crop) // 2
        if mean.shape[0] != CHANNELS or offset < 0 or mean.shape[1] < offset + crop:
            message = f'the mean of "{transform.mean_file}" is {mean.shape}, too small for crop_size {crop}'
            raise SpecError(message, where)
        return mean[:, offset : offset + crop, offset : offset + crop]
    values = np.array(transform.mean_value or [0.0], np.float32)
    return np.broadcast_to(values[:, None, None], (CHANNELS, crop, crop))


def _round(value: float) -> int:
    """Round halves away from zero, as C does."""
    return int(math.copysign(math.floor(abs(value) + 0.5), value))
