"""Sources of batches. The batch of iteration i depends only on i.

Caffe: src/caffe/layers/data_layer.cpp, src/caffe/layers/image_data_layer.cpp
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from typing_extensions import override

from netspec.data.database import Reader
from netspec.data.datum import parse_datum, shape_text
from netspec.data.images import ListedImage, read_image
from netspec.data.random_words import permutation, words
from netspec.data.transformer import Shape, Transformer
from netspec.errors import SpecError, Where

Arrays = tuple[np.ndarray, ...]
AtOnce = Callable[[Sequence[bytes]], tuple[np.ndarray, np.ndarray] | None]  # see DatabaseSource


@dataclass(frozen=True)
class Draws:
    """The seed and stream of a reader's random numbers; the reader is number ``rank`` of ``ranks`` parallel ones.

    All nets that read the same data must have the same seed.
    """

    seed: int = 0
    stream: str = ""
    rank: int = 0
    ranks: int = 1


ALONE = Draws()


class Cursor:
    """The records that each iteration reads: batch after batch, starting again after the last record.

    The first ``skip`` records are skipped once, at the start. With ``shuffle``, each epoch has a different order that
    depends on its number. Each of several ranks reads every ``ranks``-th record (Caffe: DataLayer::Skip).
    """

    def __init__(self, count: int, batch_size: int, skip: int = 0, shuffle: bool = False, draws: Draws = ALONE) -> None:
        self.count, self.batch_size, self.skip = count, batch_size, skip
        self._rank, self._ranks = draws.rank, draws.ranks
        self._shuffle = shuffle
        seed, stream = draws.seed, draws.stream
        self._order = lru_cache(maxsize=2)(lambda epoch: permutation(seed, f"{stream}/shuffle/{epoch}", count))

    def records(self, iteration: int, count: int = 1) -> list[int]:
        """Return the indices of the records of ``count`` iterations, starting at this one."""
        return [self._record(position) for position in self.positions(iteration, count)]

    def first(self) -> int:
        """Return the index of the first record."""
        return self._record(self.positions(0)[0])

    def _record(self, position: int) -> int:
        epoch, i = divmod(position, self.count)
        return int(self._order(epoch)[i]) if self._shuffle else i

    def positions(self, iteration: int, count: int = 1) -> range:
        """Return the positions of the records in the endless sequence that all ranks read; see :meth:`records`."""
        start, end = self._span(iteration, count)
        return range(start + self._rank, end, self._ranks)

    def wraps(self, iteration: int) -> int:
        """Return how often an iteration starts again after the last record."""
        start, end = self._span(iteration)
        return end // self.count - start // self.count

    def _span(self, iteration: int, count: int = 1) -> tuple[int, int]:
        """Return the first and the end position of the records that all ranks read in iterations."""
        width = self.batch_size * self._ranks
        start = self.skip + iteration * width
        return start, start + count * width


def draw_skip(rand_skip: int, seed: int, stream: str) -> int:
    """Return the number of records to skip at the start: below ``rand_skip``, or 0 if that is 0."""
    return int(words(seed, f"{stream}/rand_skip", 0, 1)[0, 0]) % rand_skip if rand_skip else 0


class Source(Protocol):
    """The interface between a data layer and its data."""

    cursor: Cursor

    @property
    def shapes(self) -> Sequence[Shape]:
        """The shapes of all tops."""
        ...

    def batch(self, iteration: int) -> Arrays:
        """Return the tops of an iteration, float32."""
        ...

    def keys(self, iteration: int) -> list[str]:
        """Return the names of the records of an iteration."""
        ...


def batches(source: Source, iteration: int, count: int) -> list[Arrays]:
    """Return the tops of ``count`` iterations, made together if the source has ``together`` and can do so."""
    arrays = source.together(iteration, count) if count > 1 and isinstance(source, Together) else None
    if arrays is None:
        return [source.batch(i) for i in range(iteration, iteration + count)]
    size = source.cursor.batch_size
    return [tuple(array[k : k + size].copy() for array in arrays) for k in range(0, count * size, size)]


@runtime_checkable
class Together(Protocol):
    """A source that can make the batches of several iterations together."""

    def together(self, iteration: int, count: int) -> Arrays | None:
        """Return the concatenated tops of ``count`` iterations; None if this is not possible."""
        ...


@dataclass(frozen=True)
class Item:
    """A record of an ImageSource; ``where`` is its position in a list, or that of the database in the prototxt."""

    name: str
    image: np.ndarray
    label: int
    where: Where | None


class ImageSource:
    """Images with labels, read one at a time and made into batches by a Transformer.

    With a batch size of 1, images can have different sizes. Otherwise all transformed images must have the shape of the
    first; raises SpecError with the name of the record if one does not.
    """

    label_axes: Shape = ()  # further axes of the labels

    def __init__(self, cursor: Cursor, transformer: Transformer) -> None:
        self.cursor = cursor
        self._transform = transformer
        first = self.item(cursor.first(), cursor.positions(0)[0])
        self._first_name = first.name
        self._shape = transformer.output_shape(first.image.shape)

    def item(self, record: int, position: int) -> Item:
        """Read a record for this position in the endless sequence of records."""
        raise NotImplementedError

    @property
    def shapes(self) -> Sequence[Shape]:
        """The shapes of images and labels."""
        return (self.cursor.batch_size, *self._shape), (self.cursor.batch_size, *self.label_axes)

    def batch(self, iteration: int) -> Arrays:
        """Return images (N, C, H, W) and labels (N,)."""
        positions = self.cursor.positions(iteration)
        items = [self.item(*each) for each in zip(self.cursor.records(iteration), positions, strict=True)]
        if len(items) > 1:
            for item in items:
                self._check_shape(item)
        labels = np.array([item.label for item in items], np.float32).reshape(-1, *self.label_axes)
        return self._transform([item.image for item in items], positions), labels

    def _check_shape(self, item: Item) -> None:
        shape = self._transform.output_shape(item.image.shape)
        if shape != self._shape:
            first = f'the first record, "{self._first_name}", gives {shape_text(self._shape)}'
            advice = "all records must have the same size (or set batch_size: 1)"
            raise SpecError(f'record "{item.name}" gives {shape_text(shape)}, but {first}; {advice}', item.where)


class DatabaseSource(ImageSource):
    """The Datums of a database, as in Caffe's Data layer. Records are named by their keys.

    ``at_once`` reads many records faster than one by one: it returns their images (N, C, H, W), uint8 or float32, and
    labels (N,), float32, or None where it cannot read these.
    """

    def __init__(
        self,
        reader: Reader,
        cursor: Cursor,
        transformer: Transformer,
        where: Where | None = None,
        at_once: AtOnce | None = None,
    ) -> None:
        self._reader, self._where = reader, where
        super().__init__(cursor, transformer)
        suits = at_once is not None and at_once(reader.records((cursor.first(),))) is not None
        self._at_once = at_once if suits else None

    def batch(self, iteration: int) -> Arrays:
        """Return images (N, C, H, W) and labels (N,)."""
        return self.together(iteration, 1) or super().batch(iteration)

    def together(self, iteration: int, count: int) -> Arrays | None:
        """Return the concatenated tops of small records; None if records must be read one by one."""
        if self._at_once is None:
            return None
        try:
            found = self._at_once(self._reader.records(self.cursor.records(iteration, count)))
        except SpecError:
            return None  # reading one by one gives an error that names the record
        if found is None:
            return None
        images, labels = found
        if self.cursor.batch_size > 1 and self._transform.output_shape(images.shape[1:]) != self._shape:
            return None
        return self._transform(images, self.cursor.positions(iteration, count)), labels

    def keys(self, iteration: int) -> list[str]:
        """Return the keys of the records of an iteration."""
        return [self._name(record) for record in self.cursor.records(iteration)]

    def _name(self, record: int) -> str:
        return self._reader.key(record).decode(errors="backslashreplace")

    @override
    def item(self, record: int, position: int) -> Item:
        try:
            datum = parse_datum(self._reader.record(record))
            return Item(self._name(record), self._transform.decode(datum), datum.label, self._where)
        except SpecError as fault:  # an error of the database itself
            raise SpecError(fault.message, fault.where or self._where) from None
        except ValueError as fault:
            raise SpecError(f'record "{self._name(record)}" {fault}', self._where) from None


class ImageListSource(ImageSource):
    """Image files of a list, as in Caffe's ImageData layer. Records are named as in the list.

    Images are resized to ``size`` (height, width), unless it is None; ``root`` is prepended to each name.
    """

    def __init__(
        self,
        images: Sequence[ListedImage],
        root: str,
        color: bool,
        size: tuple[int, int] | None,
        cursor: Cursor,
        transformer: Transformer,
    ) -> None:
        self._images, self._root, self._color, self._size = images, root, color, size
        super().__init__(cursor, transformer)

    def keys(self, iteration: int) -> list[str]:
        """Return the names of the images of an iteration."""
        return [self._images[record].name for record in self.cursor.records(iteration)]

    @override
    def item(self, record: int, position: int) -> Item:
        listed = self._images[record]
        try:
            image = read_image(self._root + listed.name, self._color, self._size)
        except ValueError as fault:
            raise SpecError(str(fault), listed.where) from None
        return Item(listed.name, image, listed.label, listed.where)
