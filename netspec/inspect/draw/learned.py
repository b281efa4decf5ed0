"""Drawings of what a net has learned: filters, maps of a blob, saliency, descriptors in two dimensions."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnnotationBbox, OffsetImage

from netspec.data.datum import shape_text
from netspec.files.figures import COLORS, PALE
from netspec.files.opencv import cv2
from netspec.inspect.draw.style import STYLE, split
from netspec.log import number

WIDTH = 9.0  # inches
MOST_FILTERS, MOST_CHANNELS, MOST_MAPS = 256, 24, 256
THUMBNAIL = 0.52  # inches on the longer side
_TILES_WIDE = 16
_BAR = 0.7  # inches of height for the title and the color bar


def filters_figure(filters: np.ndarray, title: str, of_images: bool = True, rgb: bool = False) -> Figure:
    """Draw filters (O, I, h, w): those for images side by side (``of_images``), others as a table of maps.

    Gray (in color) or white (in maps) is zero, and all have the same scale. Filters with 3 channels are in color:
    blue, green, red unless ``rgb``. Filters with 2 or 6 channels are for two images.
    """
    images = 2 if of_images and filters.shape[1] in (2, 6) else 1
    shown = filters[:MOST_FILTERS]
    in_color = of_images and filters.shape[1] // images == 3
    limit = float(np.abs(filters[np.isfinite(filters)]).max(initial=0)) or 1.0
    if in_color or filters.shape[1] // images == 1:
        parts = [part for each in shown for part in split(each, images)]
        tiles = [(_in_color(part, limit, rgb) if in_color else part[0]) for part in parts]
        columns = min(_TILES_WIDE, int(np.ceil(np.sqrt(2 * len(tiles)))))
    else:
        shown = filters[:MOST_CHANNELS, :MOST_CHANNELS]
        tiles = [part for each in shown for part in each]
        columns = shown.shape[1]
    words = f"{title}: {shape_text(filters.shape)}"
    if len(shown) < len(filters) or shown.shape[1] < filters.shape[1]:
        words += f" ({shape_text(shown.shape[:2])} of them shown)"
    if not in_color and filters.shape[1] > images:
        words += "; a row is a filter, a column an input channel"
    scale = None if in_color else ("RdBu_r", -limit, limit)
    return _mosaic(tiles, columns - columns % images or 1, words, scale)


def maps_figure(maps: np.ndarray, image: np.ndarray, title: str) -> Figure:
    """Draw the maps (C, H, W) or values (D,) of a blob, next to its image (H, W, 3) or (H, W).

    All maps have the same scale, which excludes the largest and the smallest half percent of the values.
    """
    if maps.ndim < 3 or maps.shape[-2:] == (1, 1):
        return _numbers(maps.reshape(-1), image, title)
    shown = maps.reshape(-1, *maps.shape[-2:])[:MOST_MAPS]
    finite = shown[np.isfinite(shown)]
    low, high = np.percentile(finite, [0.5, 99.5]) if finite.size else (0.0, 1.0)
    words = f"{title}: {shape_text(maps.shape)}"
    count = int(np.prod(maps.shape[:-2]))
    words += f" ({len(shown)} of them shown)" if count > len(shown) else ""
    still = int((np.ptp(maps.reshape(count, -1), axis=1) == 0).sum())
    words += f"; {still} constant" if still else ""
    columns = min(_TILES_WIDE, int(np.ceil(np.sqrt(len(shown)))))
    return _mosaic(list(shown), columns, words, ("viridis", float(low), float(high)), image)


def saliency_figure(images: Sequence[np.ndarray], maps: Sequence[np.ndarray], title: str) -> Figure:
    """Draw the saliency (h, w) of each image (H, W, 3) BGR or (H, W), uint8: the image, the map, and both together."""
    with matplotlib.rc_context(STYLE):
        ratio = images[0].shape[0] / images[0].shape[1]
        lines = textwrap.wrap(title, 110)
        figure = Figure(
            figsize=(WIDTH, len(images) * WIDTH / 3 * ratio + 0.35 + 0.2 * len(lines)), layout="constrained"
        )
        grid = figure.subplots(len(images), 3, squeeze=False)
        limit = max(float(np.percentile(map_, 99.5)) for map_ in maps) or 1.0
        for row, (image, map_) in enumerate(zip(images, maps, strict=True)):
            picture = rgb_of(image)
            large = np.clip(cv2.resize(map_.astype(np.float32), picture.shape[1::-1]) / limit, 0, 1)
            heat = matplotlib.colormaps["inferno"](large)[..., :3]
            dim = 0.2 + 0.8 * np.sqrt(large[..., None])
            for axis, shown, name in zip(
                grid[row],
                (picture, heat, picture / 255 * dim),
                ("image", "saliency", "bright pixels matter most"),
                strict=True,
            ):
                axis.imshow(shown)
                axis.set_axis_off()
                if row == 0:
                    axis.set_title(name)
        figure.suptitle("\n".join(lines), fontsize=10, parse_math=False, x=0.01, ha="left")
        return figure


def embedding_figure(
    points: np.ndarray,
    title: str,
    labels: Sequence[float | None] | None = None,
    images: Mapping[int, np.ndarray] | None = None,
) -> Figure:
    """Draw points (N, 2). Points with an image (BGR or gray, uint8) are drawn as the image if there is room.

    Colors show the ``labels`` or, without them, the order of the points.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, WIDTH * 0.86), layout="constrained")
        axis = figure.subplots()
        axis.set_title("\n".join(textwrap.wrap(title, 100)), parse_math=False)
        axis.set_aspect("equal", adjustable="datalim")
        axis.margins(0.06)
        colors = _point_colors(figure, axis, points, labels)
        axis.tick_params(labelsize=8, colors=PALE)
        figure.draw_without_rendering()
        _put_images(axis, points, colors, images or {})
        return figure


def rgb_of(image: np.ndarray) -> np.ndarray:
    """Return an image (H, W, 3) BGR or (H, W), uint8, as (H, W, 3) RGB."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)


def _in_color(filter_: np.ndarray, limit: float, rgb: bool) -> np.ndarray:
    ordered = filter_ if rgb else filter_[::-1]
    return np.clip(0.5 + np.nan_to_num(ordered.transpose(1, 2, 0)) / (2 * limit), 0, 1)


def _mosaic(
    tiles: Sequence[np.ndarray],
    columns: int,
    title: str,
    scale: tuple[str, float, float] | None,
    image: np.ndarray | None = None,
) -> Figure:
    """Draw tiles of equal size in rows, after ``image``; ``scale`` is a color map with the values of its ends."""
    rows = -(-len(tiles) // columns)
    height, width = tiles[0].shape[:2]
    seam = max(1, round(max(height, width) / 14))
    empty = (rows * (height + seam) - seam, columns * (width + seam) - seam)
    whole = np.full((*empty, *tiles[0].shape[2:]), np.nan)
    for place, tile in enumerate(tiles):
        row, column = divmod(place, columns)
        top, left = row * (height + seam), column * (width + seam)
        whole[top : top + height, left : left + width] = tile
    if scale is None:
        whole = np.where(np.isnan(whole), 1.0, whole)
    image_width = 0 if image is None else 2.2
    drawn = WIDTH - image_width - 0.3
    lines = textwrap.wrap(title, 105)
    high = max(drawn * whole.shape[0] / whole.shape[1], 1.6 if image_width else 0.4)
    with matplotlib.rc_context(STYLE):
        size = (WIDTH, high + (_BAR if scale else 0.2) + 0.2 * len(lines))
        figure = Figure(figsize=size, layout="constrained")
        figure.suptitle("\n".join(lines), fontsize=10, parse_math=False, x=0.01, ha="left")
        axes = (
            figure.subplots(1, 2, squeeze=False, width_ratios=(image_width, drawn))[0]
            if image_width
            else [figure.subplots()]
        )
        if image is not None:
            axes[0].imshow(rgb_of(image))
            axes[0].set_title("image")
            axes[0].set_axis_off()
            axes[0].set_anchor("N")
        axis = axes[-1]
        colors = scale and matplotlib.colormaps[scale[0]].with_extremes(bad="#cfcfcf" if image is None else "white")
        options = {} if scale is None else {"cmap": colors, "vmin": scale[1], "vmax": scale[2]}
        axis.imshow(whole, interpolation="nearest", **options)  # pyright: ignore[reportArgumentType]
        axis.set_axis_off()
        axis.set_anchor("N")
        if scale is not None:
            norm = Normalize(scale[1], scale[2] if scale[2] > scale[1] else scale[1] + 1)
            bar = figure.colorbar(ScalarMappable(norm, scale[0]), ax=axis, orientation="horizontal", fraction=0.04,
                                  aspect=50, pad=0.02)  # fmt: skip
            bar.ax.tick_params(labelsize=8)
        return figure


def _numbers(values: np.ndarray, image: np.ndarray, title: str) -> Figure:
    """Draw values as bars, the five largest with their index."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
        left, axis = figure.subplots(1, 2, width_ratios=(2.2, WIDTH - 2.2))
        left.imshow(rgb_of(image))
        left.set_axis_off()
        left.set_title("image")
        axis.bar(range(len(values)), values, width=1.0, color=COLORS[0])
        axis.axhline(0, color="black", linewidth=0.6)
        axis.margins(x=0.01)
        greatest = np.argsort(-values)[:5]
        listed = ", ".join(f"{k} ({number(float(f'{values[k]:.3g}'))})" for k in greatest)
        words = textwrap.wrap(f"{title}: {len(values)} values; largest: {listed}", 105)
        figure.suptitle("\n".join(words), fontsize=10, parse_math=False, x=0.01, ha="left")
        return figure


def _point_colors(
    figure: Figure, axis: Axes, points: np.ndarray, labels: Sequence[float | None] | None
) -> list[tuple[float, ...] | str]:
    """Draw the points with a legend or a color bar; return their colors."""
    known = sorted({label for label in labels or () if label is not None})
    if labels is not None and 1 < len(known) <= len(COLORS):
        without = [None] if None in labels else []
        for label, color in [*zip(known, COLORS, strict=False), *((label, PALE) for label in without)]:
            mine = [k for k, each in enumerate(labels) if each == label]
            name = "no label" if label is None else f"label {label:g}"
            axis.plot(points[mine, 0], points[mine, 1], "o", color=color, markersize=4, label=name)
        axis.legend(loc="upper right", fontsize=9)
        return [COLORS[known.index(label)] if label is not None else PALE for label in labels]
    by_label = labels is not None and len(known) > 1
    values = np.array(
        [np.nan if v is None else v for v in labels] if by_label and labels else range(len(points)), float
    )
    norm = Normalize(np.nanmin(values), max(float(np.nanmax(values)), float(np.nanmin(values)) + 1))
    drawn = axis.scatter(points[:, 0], points[:, 1], c=values, cmap="viridis", norm=norm, s=14)
    bar = figure.colorbar(drawn, ax=axis, fraction=0.03, pad=0.01, aspect=40)
    bar.set_label("label" if by_label else "index of the image")
    return [tuple(color) for color in matplotlib.colormaps["viridis"](norm(values))]


def _put_images(
    axis: Axes, points: np.ndarray, colors: Sequence[tuple[float, ...] | str], images: Mapping[int, np.ndarray]
) -> None:
    """Put images at their points, one after the other, without overlaps."""
    places = axis.transData.transform(points) / axis.figure.dpi  # inches
    taken: list[tuple[np.ndarray, np.ndarray]] = []  # centers and sizes
    for index in _spread_order(places, list(images)):
        picture = rgb_of(images[index])
        size = np.array(picture.shape[1::-1]) * THUMBNAIL / max(picture.shape[:2]) + 0.08
        if any((np.abs(places[index] - other) < (size + its) / 2).all() for other, its in taken):
            continue
        taken.append((places[index], size))
        zoom = THUMBNAIL * 72 / max(picture.shape[:2])  # points: OffsetImage draws a pixel as a point
        box = AnnotationBbox(
            OffsetImage(picture, zoom=zoom),
            (float(points[index, 0]), float(points[index, 1])),
            pad=0.1,
            bboxprops={"edgecolor": colors[index], "linewidth": 1.6},
        )
        axis.add_artist(box)


def _spread_order(places: np.ndarray, chosen: list[int]) -> list[int]:
    """Order the points so that each is far from the previous ones, starting with the outer ones."""
    if not chosen:
        return []
    spots = places[chosen]
    distance = np.linalg.norm(spots - spots.mean(axis=0), axis=1)
    order = [int(distance.argmax())]
    nearest = np.linalg.norm(spots - spots[order[0]], axis=1)
    while len(order) < min(len(chosen), 400):
        order.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(spots - spots[order[-1]], axis=1))
    return [chosen[k] for k in order]
