"""Images with label images, from a list of pairs; both are mirrored and cropped in the same way.

Forks: alexgkendall/caffe-segnet, src/caffe/layers/dense_image_data_layer.cpp; s9xie/hed, yun-liu/rcf,
src/caffe/layers/image_labelmap_data_layer.cpp
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netspec.data.datum import shape_text
from netspec.data.images import list_lines, read_image
from netspec.data.sources import Arrays, Cursor
from netspec.data.transformer import Transformer
from netspec.errors import SpecError, Where
from netspec.layers.contract.base import Shape
from netspec.layers.data.files import ReadingLayer

Array = np.ndarray


@dataclass(frozen=True)
class Pair:
    """A line of the list: the names of an image and of its labels, and its position."""

    image: str
    labels: str
    where: Where


def read_pairs(path: str, where: Where | None = None) -> list[Pair]:
    """Read lines of two names. Raises SpecError for another line, and for a list without lines."""
    pairs = []
    for line, position in list_lines(path, where):
        names = line.split()
        if len(names) != 2:
            raise SpecError(f'found "{line}", expected the names of an image and of its labels', position)
        pairs.append(Pair(names[0], names[1], position))
    if not pairs:
        raise SpecError(f'the list "{path}" is empty', where or Where(path))
    return pairs


def read_labels(path: str, size: tuple[int, int] | None, nearest: bool) -> Array:
    """Return the gray image of a file (1, H, W), in a size (height, width) if given. Raises ValueError."""
    if size is None or not nearest:
        return read_image(path, False, size)
    from netspec.files.opencv import cv2

    height, width = size
    return cv2.resize(read_image(path, False)[0], (width, height), interpolation=cv2.INTER_NEAREST)[None]


def pair_source(
    layer: ReadingLayer,
    p: Any,
    cut: Callable[[Array, Array, int], tuple[Array, Array]],
    site: str,
    of_labels: Callable[[int], int] | None = None,
) -> PairSource | None:
    """Return the source of a layer with the settings ``p``, None if :meth:`ReadingLayer.attempt` caught an error.

    Labels are resized bilinearly like the images or, with ``of_labels``, by nearest neighbor, to the sides that it
    returns. ``cut`` is as in :class:`PairSource`; the size of a batch is logged from ``site``.
    """
    pairs = layer.attempt(read_pairs, p.source, layer.where)
    transformer = layer.attempt(layer.transformer)
    if pairs is None or transformer is None:
        return None
    size = (p.new_height, p.new_width) if p.new_height else None
    smaller = size if size is None or of_labels is None else (of_labels(size[0]), of_labels(size[1]))
    root, color = p.root_folder, p.is_color

    def read(pair: Pair) -> tuple[Array, Array]:
        image = read_image(root + pair.image, color, size)
        return image, read_labels(root + pair.labels, smaller, of_labels is not None)

    source = PairSource(pairs, layer.cursor(len(pairs), p.rand_skip, p.shuffle), read, cut, transformer)
    layer.log_size(source, site)
    return source


class PairSource:
    """Batches of images and labels (N, 1, H', W'); ``cut`` changes both in the same way before ``transform``.

    ``read(pair)`` returns the image (C, H, W) and its labels (1, H', W'), or raises ValueError. ``cut`` gets them and
    the record's position. With a batch size of 1, images can have different sizes. Raises SpecError for images that
    cannot be read or differ in size.
    """

    def __init__(
        self,
        pairs: Sequence[Pair],
        cursor: Cursor,
        read: Callable[[Pair], tuple[Array, Array]],
        cut: Callable[[Array, Array, int], tuple[Array, Array]],
        transform: Transformer,
    ) -> None:
        self.cursor, self._pairs, self._read_pair, self._cut, self._transform = cursor, pairs, read, cut, transform
        first = self._cut(*self._read(cursor.first()), cursor.positions(0)[0])
        self._found = [transform.output_shape(first[0].shape), first[1].shape]
        self.shapes: Sequence[Shape] = [(cursor.batch_size, *shape) for shape in self._found]

    def keys(self, iteration: int) -> list[str]:
        """Return the names of the images of an iteration."""
        return [self._pairs[record].image for record in self.cursor.records(iteration)]

    def batch(self, iteration: int) -> Arrays:
        """Return images (N, C, H, W) and labels (N, 1, H', W')."""
        images, labels = [], []
        positions = self.cursor.positions(iteration)
        for record, position in zip(self.cursor.records(iteration), positions, strict=True):
            image, label = self._cut(*self._read(record), position)
            found = [self._transform.output_shape(image.shape), label.shape]
            if found != self._found and self.cursor.batch_size > 1:
                sizes = " and ".join(map(shape_text, found)), " and ".join(map(shape_text, self._found))
                message = f"image and labels have sizes {sizes[0]}, the first {sizes[1]}; all must be alike"
                raise SpecError(f"{message} (or set batch_size: 1)", self._pairs[record].where)
            images.append(image)
            labels.append(label)
        return self._transform(images, positions), np.stack(labels).astype(np.float32)

    def _read(self, record: int) -> tuple[Array, Array]:
        try:
            return self._read_pair(self._pairs[record])
        except ValueError as fault:
            raise SpecError(str(fault), self._pairs[record].where) from None
