"""SSD's data augmentation of images and boxes: colors, a larger canvas, a window, another size, a mirror.

Images are uint8 (H, W, C), blue first. Boxes are rows (label, instance, xmin, ymin, xmax, ymax, difficult), float32;
the corners are relative to the image. The fork encodes the image as JPEG after each step; here all steps are lossless.
Fork: weiliu89/caffe (ssd), src/caffe/data_transformer.cpp, src/caffe/util/sampler.cpp, im_transforms.cpp
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

import numpy as np

from netspec.data.datum import planar, shape_text
from netspec.data.mean import read_mean
from netspec.data.resize import resized
from netspec.data.transformer import contradictions
from netspec.dialects.boxes import Array, coverage, overlaps, sizes
from netspec.errors import SpecError, Where
from netspec.files.opencv import cv2
from netspec.layers.contract.base import Shape
from netspec.proto.schema import TRAIN, has, value

CORNERS, COLUMNS = slice(2, 6), 7
WHOLE = np.array([0, 0, 1, 1], np.float32)

# ssd.py: enums of ResizeParameter and of EmitConstraint
FIT_SMALL_SIZE, FIT_LARGE_SIZE_AND_PAD = 2, 3
PADDING = {1: cv2.BORDER_CONSTANT, 2: cv2.BORDER_REFLECT_101, 3: cv2.BORDER_REPLICATE}
INTERPOLATION = {
    1: cv2.INTER_LINEAR,
    2: cv2.INTER_AREA,
    3: cv2.INTER_NEAREST,
    4: cv2.INTER_CUBIC,
    5: cv2.INTER_LANCZOS4,
}
CENTER = 0
SUM_TOLERANCE = 0.01  # maximum difference from 1 of the sum of the probabilities of several resize_param


def wrong_settings(transform: Any, samplers: Sequence[Any], at: Callable[..., Where]) -> Iterator[SpecError]:
    """Yield the errors in a transform_param and in batch samplers that do not depend on the images."""

    def fault(message: str, *path: str | int) -> SpecError:
        return SpecError(message, at(*path))

    yield from contradictions(transform, at)
    resizes = value(transform, "resize_param")
    for i, resize in enumerate(resizes):
        if not (resize.height and resize.width):
            yield fault("height and width must both be above 0", "transform_param", "resize_param", i)
    if len(resizes) > 1 and abs(sum(resize.prob for resize in resizes) - 1) > SUM_TOLERANCE:
        total = sum(resize.prob for resize in resizes)
        message = f"found {len(resizes)} resize_param with a sum of prob of {total:g}, expected 1"
        yield fault(message, "transform_param", "resize_param")
    if has(transform, "expand_param"):
        if value(transform, "expand_param").max_expand_ratio <= 1:
            yield fault("max_expand_ratio must be above 1", "transform_param", "expand_param")
        if transform.mean_file:
            message = "a canvas is filled with mean_value; it cannot be used with mean_file"
            yield fault(message, "transform_param", "expand_param")
    distort = value(transform, "distort_param")
    for name in ("contrast", "saturation"):
        low, high = getattr(distort, f"{name}_lower"), getattr(distort, f"{name}_upper")
        if not 0 <= low <= high:
            message = f"found {name} from {low:g} to {high:g}, expected 0 <= {name}_lower <= {name}_upper"
            yield fault(message, "transform_param", "distort_param")
    for i, sampler in enumerate(samplers):
        s, field = sampler.sampler, ("annotated_data_param", "batch_sampler", i, "sampler")
        if not 0 < s.min_scale <= s.max_scale <= 1:
            yield fault(f"found scales {s.min_scale:g} to {s.max_scale:g}, expected 0 < min <= max <= 1", *field)
        if not 0 < s.min_aspect_ratio <= s.max_aspect_ratio:
            ratios = f"{s.min_aspect_ratio:g} to {s.max_aspect_ratio:g}"
            yield fault(f"found aspect ratios {ratios}, expected 0 < min <= max", *field)


def fixed_size(transform: Any) -> tuple[int, int] | None:
    """Return the height and width of all images, if the transform_param determines them."""
    resizes, crop = value(transform, "resize_param"), (value(transform, "crop_h"), value(transform, "crop_w"))
    if transform.crop_size or all(crop):
        return (transform.crop_size,) * 2 if transform.crop_size else crop
    if resizes and resizes[0].resize_mode != FIT_SMALL_SIZE:
        return resizes[0].height, resizes[0].width
    return None


class Augmenter:
    """Applies a ``transform_param`` with SSD's fields, after the batch samplers. ``at(*path)`` is a field's position.

    ``resize`` is its resize_param, or one of them, or None. With ``jitter``, one window is drawn without the
    samplers. Raises SpecError for a mean file that cannot be read.
    """

    def __init__(
        self,
        transform: Any,
        samplers: Sequence[Any],
        phase: int,
        at: Callable[..., Where],
        resize: Any = None,
        jitter: float = 0.0,
    ) -> None:
        self._at, self._samplers, self._jitter = at, list(samplers), jitter
        self._scale, self._mirror = np.float32(transform.scale), transform.mirror
        self._random_crop = phase == TRAIN
        crop = (value(transform, "crop_h"), value(transform, "crop_w"))
        self.crop: tuple[int, int] = (transform.crop_size,) * 2 if transform.crop_size else crop
        self.color: bool | None = True if transform.force_color else False if transform.force_gray else None
        self._mean_values = np.array(transform.mean_value, np.float32)
        self._mean: Array | None = None
        if transform.mean_file:
            self._mean = read_mean(transform.mean_file, at("transform_param", "mean_file"))

        def value_if_given(name: str) -> Any:
            return value(transform, name) if has(transform, name) else None

        self._distort, self._expand = value_if_given("distort_param"), value_if_given("expand_param")
        self.resize, self._emit = resize, value_if_given("emit_constraint")

    def __call__(self, image: Array, boxes: Array, draw: Random) -> tuple[Array, Array]:
        """Return an image as float32 (C, H', W') and its boxes; all random numbers come from ``draw``."""
        if self._distort is not None:
            image = distorted(image, self._distort, draw)
        if self._expand is not None and draw.random() <= self._expand.prob:
            image, boxes = self._expanded(image, boxes, draw)
        windows = [self._jittered(draw)] if self._jitter else list(self._windows(boxes[:, CORNERS], draw))
        if windows:
            image, boxes = self._cut(image, boxes, draw.choice(windows))
        return self.transformed(image, boxes, draw)

    def size(self, image: Shape) -> tuple[int, int]:
        """Return the height and width of an image of shape (H, W, ...) after resizing, without the samplers."""
        if all(self.crop):
            return self.crop
        return self._resized_to(*image[:2]) if self.resize is not None else (image[0], image[1])

    def _error(self, message: str, field: str) -> SpecError:
        return SpecError(message, self._at("transform_param", field))

    # Windows

    def _expanded(self, image: Array, boxes: Array, draw: Random) -> tuple[Array, Array]:
        """Put the image at a random position on a larger canvas with the color of the mean."""
        ratio = draw.uniform(1, self._expand.max_expand_ratio)
        height, width = image.shape[:2]
        tall, wide = int(height * ratio), int(width * ratio)
        top, left = (math.floor(draw.uniform(0, spare)) for spare in (tall - height, wide - width))
        canvas = np.empty((tall, wide, image.shape[2]), np.uint8)
        canvas[:] = np.clip(np.rint(self._means(image.shape[2])), 0, 255)
        canvas[top : top + height, left : left + width] = image
        window = [-left / width, -top / height, (wide - left) / width, (tall - top) / height]
        return canvas, self._projected(boxes, np.array(window, np.float32))

    def _means(self, channels: int) -> Array:
        if len(self._mean_values) not in (0, 1, channels):
            message = f"found {len(self._mean_values)} mean_value for {channels} channels, expected 1 or {channels}"
            raise self._error(message, "mean_value")
        return np.resize(self._mean_values, channels) if len(self._mean_values) else np.zeros(channels, np.float32)

    def _windows(self, boxes: Array, draw: Random) -> Iterator[Array]:
        """Yield the windows that the samplers draw."""
        for sampler in self._samplers:
            wanted = sampler.max_sample if sampler.HasField("max_sample") else math.inf
            found = 0
            for _ in range(sampler.max_trials if sampler.use_original_image else 0):
                if found >= wanted:
                    break
                window = drawn_window(sampler.sampler, draw)
                if suits(window, boxes, sampler.sample_constraint):
                    found += 1
                    yield window

    def _jittered(self, draw: Random) -> Array:
        """Return YOLO's window: the whole image or, in 8 of 10 cases, sides shortened by up to jitter or half of it.

        Images that are padded to a size keep their proportions.
        """
        (shorter,) = draw.choices((0, self._jitter / 2, self._jitter), (0.2, 0.2, 0.6))
        width = draw.uniform(1 - shorter, 1)
        keeps = self.resize is not None and self.resize.resize_mode == FIT_LARGE_SIZE_AND_PAD
        height = width if keeps else draw.uniform(1 - shorter, 1)
        left, top = draw.uniform(0, 1 - width), draw.uniform(0, 1 - height)
        return np.array([left, top, left + width, top + height], np.float32).clip(0, 1)

    def _cut(self, image: Array, boxes: Array, window: Array) -> tuple[Array, Array]:
        height, width = image.shape[:2]
        left, top, right, bottom = window * np.array([width, height] * 2, np.float32)
        rows, columns = max(1, int(bottom - top)), max(1, int(right - left))
        y, x = min(int(top), height - rows), min(int(left), width - columns)
        return image[y : y + rows, x : x + columns], self._projected(boxes, window)

    def _projected(self, boxes: Array, window: Array) -> Array:
        """Return the boxes of a window, relative to it and clipped to it."""
        corners = boxes[:, CORNERS]
        boxes = boxes[self._belong(corners, window)]
        origin, extent = np.tile(window[:2], 2), np.tile(window[2:] - window[:2], 2)
        boxes[:, CORNERS] = ((boxes[:, CORNERS] - origin) / extent).clip(0, 1)
        return boxes[sizes(boxes[:, CORNERS]) > 0]

    def _belong(self, corners: Array, window: Array) -> Array:
        low, high = corners[:, :2], corners[:, 2:]
        belong = (low < window[2:]) & (high > window[:2])
        if self._emit is not None and self._emit.emit_type == CENTER:
            center = (low + high) / np.float32(2)
            belong &= (center >= window[:2]) & (center <= window[2:])
        elif self._emit is not None:
            belong &= coverage(corners, window)[:, None] > self._emit.emit_overlap
        return np.asarray(belong.all(axis=1))

    # Size, window, mirror, mean, scale

    def transformed(self, image: Array, boxes: Array, draw: Random) -> tuple[Array, Array]:
        """Apply only the second half: size, crop, mirror, mean and scale."""
        mirror = self._mirror and draw.randrange(2) == 1
        old = image.shape[:2]
        if self.resize is not None:
            image = self._resized(image, draw)
            boxes = self._boxes_resized(boxes, *old)
        height, width = image.shape[:2]
        rows, columns = self.crop if all(self.crop) else (height, width)
        if rows > height or columns > width:
            raise self._error(f"the crop is {rows} x {columns}, larger than the image, {height} x {width}", "crop_size")
        spare = (height - rows, width - columns)
        top, left = (draw.randrange(n + 1) for n in spare) if self._random_crop else (n // 2 for n in spare)
        window = np.array([left / width, top / height, (left + columns) / width, (top + rows) / height], np.float32)
        boxes = self._projected(boxes, window)
        pixels = planar(image[top : top + rows, left : left + columns])
        if mirror:
            pixels = pixels[:, :, ::-1]
            boxes[:, 2], boxes[:, 4] = 1 - boxes[:, 4], 1 - boxes[:, 2].copy()
        if self.resize is not None:
            self._extrapolate(boxes, old, window)
        return self._normalized(pixels), boxes

    def _normalized(self, pixels: Array) -> Array:
        mean = self._means(len(pixels))[:, None, None] if self._mean is None else self._mean
        if self._mean is not None and self._mean.shape != pixels.shape:
            found = f"the mean has shape {shape_text(self._mean.shape)}, the image {shape_text(pixels.shape)}"
            raise self._error(f"{found}; expected the same", "mean_file")
        return (pixels.astype(np.float32) - mean) * self._scale

    def _resized_to(self, height: int, width: int) -> tuple[int, int]:
        """Return the size of an image after resizing, including padding."""
        if self.resize.resize_mode == FIT_SMALL_SIZE:
            return _fitted(height, width, self.resize, inside=False)
        return self.resize.height, self.resize.width

    def _resized(self, image: Array, draw: Random) -> Array:
        param, (height, width) = self.resize, image.shape[:2]
        modes = list(param.interp_mode) or [1]
        interpolation = INTERPOLATION[modes[draw.randrange(len(modes))]]
        pads = param.resize_mode == FIT_LARGE_SIZE_AND_PAD
        rows, columns = _fitted(height, width, param, inside=True) if pads else self._resized_to(height, width)
        channels = image.shape[2]
        if interpolation == cv2.INTER_LINEAR:
            image = resized(image, rows, columns)
        else:
            image = cv2.resize(image, (columns, rows), interpolation=interpolation)
        image = image.reshape(rows, columns, channels)
        if not pads:
            return image
        top, left = (param.height - rows) // 2, (param.width - columns) // 2
        values = list(param.pad_value)
        if len(values) not in (0, 1, channels):
            message = f"found {len(values)} pad_value for {channels} channels, expected 1 or {channels}"
            raise self._error(message, "resize_param")
        border = (top, param.height - rows - top, left, param.width - columns - left)
        color = values * channels if len(values) == 1 else values or [0] * channels
        padded = cv2.copyMakeBorder(image, *border, PADDING[param.pad_mode], value=color)
        return padded.reshape(param.height, param.width, channels)

    def _boxes_resized(self, boxes: Array, height: int, width: int) -> Array:
        """Return the boxes of an image relative to its new size."""
        boxes, param = boxes.copy(), self.resize
        corners = boxes[:, CORNERS]
        corners[:, :2], corners[:, 2:] = corners[:, :2].clip(min=0), corners[:, 2:].clip(max=1)
        if param.resize_mode == FIT_LARGE_SIZE_AND_PAD:
            aspect = width / height
            if aspect > param.width / param.height:
                share, axes = param.width / aspect / param.height, slice(1, 4, 2)
            else:
                share, axes = aspect * param.height / param.width, slice(0, 3, 2)
            corners[:, axes] = corners[:, axes] * np.float32(share) + np.float32((1 - share) / 2)
        return boxes

    def _extrapolate(self, boxes: Array, old: tuple[int, int], window: Array) -> None:
        """Make boxes of FIT_SMALL_SIZE relative to ``width_scale`` and ``height_scale``, if these are given."""
        param = self.resize
        if param.resize_mode == FIT_SMALL_SIZE and param.height_scale and param.width_scale:
            height, width = _fitted(*old, param, inside=False, whole=False)
            across = width * (window[2] - window[0]) / param.width_scale
            down = height * (window[3] - window[1]) / param.height_scale
            boxes[:, CORNERS] *= np.array([across, down] * 2, np.float32)


def _fitted(height: int, width: int, param: Any, inside: bool, whole: bool = True) -> Any:
    """Return the size (rows, columns) with the same proportions that fits into the given one, or around it."""
    aspect = width / height
    if (aspect > param.width / param.height) == inside:
        rows, columns = param.width / aspect, float(param.width)
    else:
        rows, columns = float(param.height), aspect * param.height
    return (math.floor(rows), math.floor(columns)) if whole else (rows, columns)


def drawn_window(sampler: Any, draw: Random) -> Array:
    """Return a random window (xmin, ymin, xmax, ymax) with the scales and aspect ratios of a Sampler."""
    scale = draw.uniform(sampler.min_scale, sampler.max_scale)
    ratio = draw.uniform(sampler.min_aspect_ratio, sampler.max_aspect_ratio)
    ratio = min(max(ratio, scale**2), scale**-2)
    width, height = min(scale * math.sqrt(ratio), 1), min(scale / math.sqrt(ratio), 1)
    left, top = draw.uniform(0, 1 - width), draw.uniform(0, 1 - height)
    return np.array([left, top, left + width, top + height], np.float32).clip(0, 1)


def suits(window: Array, boxes: Array, constraint: Any) -> bool:
    """Return whether a window meets a SampleConstraint with one of the boxes (n, 4).

    If there are several kinds of constraints, only the first is used, as in the fork.
    """
    measures = {
        "jaccard_overlap": lambda: overlaps(window, boxes),
        "sample_coverage": lambda: coverage(window, boxes),
        "object_coverage": lambda: coverage(boxes, window),
    }
    for name, measure in measures.items():
        ends = [f"{end}_{name}" for end in ("min", "max")]
        least, most = (getattr(constraint, end) if constraint.HasField(end) else None for end in ends)
        if least is not None or most is not None:
            found = measure()
            fits = np.ones(len(boxes), bool) if least is None else found >= least
            return bool((fits if most is None else fits & (found <= most)).any())
    return True


def distorted(image: Array, param: Any, draw: Random) -> Array:
    """Return an image with colors changed according to a DistortionParameter."""
    order = ("brightness", "contrast", "saturation", "hue")
    if draw.random() <= 0.5:
        order = ("brightness", "saturation", "hue", "contrast")
    for name in order:
        if draw.random() < getattr(param, f"{name}_prob"):
            if name in ("brightness", "hue"):
                delta = getattr(param, f"{name}_delta")
                ends = -delta, delta
            else:
                ends = getattr(param, f"{name}_lower"), getattr(param, f"{name}_upper")
            image = _COLORS[name](image, draw.uniform(*ends))
    if draw.random() < param.random_order_prob:
        image = image[:, :, draw.sample(range(image.shape[2]), image.shape[2])]
    return image


_COLORS: dict[str, Callable[[Array, float], Array]] = {
    "brightness": lambda image, by: _linear(image, 1, by),
    "contrast": lambda image, by: _linear(image, by, 0),
    "saturation": lambda image, by: _in_hsv(image, 1, by, 0),
    "hue": lambda image, by: _in_hsv(image, 0, 1, by),
}


def _in_hsv(image: Array, channel: int, factor: float, shift: float) -> Array:
    """Return an image with one HSV channel changed; gray images have none."""
    if image.shape[2] != 3:
        return image
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    hsv[:, :, channel] = _linear(hsv[:, :, channel], factor, shift)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)


def _linear(values: Array, factor: float, shift: float) -> Array:
    """Return ``values * factor + shift`` of uint8 values, rounded, 0 to 255."""
    changed = values.astype(np.float32) * np.float32(factor) + np.float32(shift)
    return np.clip(np.rint(changed), 0, 255).astype(np.uint8)
