"""Data layers that read and write files.

The layers that read make the batch of iteration i as a function of i alone (netspec.data.sources), so that
threads may read ahead.

Caffe: src/caffe/layers/base_data_layer.cpp
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import torch

from netspec import log
from netspec.data.database import open_reader
from netspec.data.images import read_image_list
from netspec.data.prefetch import Feed
from netspec.data.sources import Cursor, DatabaseSource, Draws, ImageListSource, Source, Together, batches, draw_skip
from netspec.data.transformer import Transformer, contradictions
from netspec.errors import SpecError, UnknownShape, Where
from netspec.layers.contract.base import Shape, State
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.registry import register
from netspec.proto.schema import PHASE_NAMES, value

BACKENDS = ("leveldb", "lmdb")  # caffe.proto: enum DataParameter.DB
# Fields that moved to transform_param; in a current layer they have no effect.
MOVED = ("scale", "mean_file", "crop_size", "mirror")
MOST_AT_ONCE = 1 << 16  # a thread makes at most so many numbers at once, and at most 32 batches
Batch = tuple[tuple[torch.Tensor, ...], int]
T = TypeVar("T")


class ReadingLayer(DataLayer):
    """Base of the layers that read records from files, some batches ahead of the net.

    Files are opened in the constructor. Threads start at the first forward pass. If data must not be opened, or the
    shape of the first top is given, the shapes of the tops are the given ones, or those that the prototxt determines.
    """

    in_order = False  # whether batches can be made only one after the other
    group: ClassVar[str]  # the field with the layer's own settings

    def __getstate__(self) -> dict[str, Any]:
        """Refuse to be copied or pickled with open files. Raises TypeError."""
        if self._source is not None:
            raise TypeError(f"{self.error('reads open files, so it cannot be copied or pickled; build its net again')}")
        return dict(self.__dict__)

    @classmethod
    def source_of(cls, param: Any) -> str:
        return value(param, cls.group).source

    def open(self) -> Source | None:
        """Open the files. Return None if :meth:`attempt` caught an error."""
        raise NotImplementedError

    def known_shape(self) -> Shape | None:
        """Return the shape of the first top, if the prototxt determines it."""
        return None

    def wrong_settings(self) -> Iterator[SpecError]:
        """Yield the errors in the settings that do not depend on the files."""
        p = value(self.param, self.group)
        if p.batch_size <= 0:
            yield self.error(f"batch_size must be above 0, found {p.batch_size}", self.group, "batch_size")
        if not p.source:
            yield self.error("source is missing; set it to the path of the data", self.group, "source")

    def construct(self) -> None:
        """Check the settings and collect all errors. If there are none, open the files."""
        self.faults = list(self.wrong_settings())
        self._sound = not self.faults
        given = any(top in self.context.options.given_shapes for top in self.param.top[:1])
        self.opens_data = self.context.options.open_data and not given

    def attempt(self, function: Callable[..., T], *arguments: Any) -> T | None:
        """Return the result of a function. If it raises a SpecError, keep the error and return None."""
        try:
            return function(*arguments)
        except SpecError as fault:
            self.faults.append(fault)
            return None

    def setup(self) -> None:
        self.batch_size: int = value(self.param, self.group).batch_size
        self._source: Source | None = None
        self._feed: Feed[Batch] | None = None
        if not self.opens_data:
            self.refuse(self.faults)
            self._shapes = self.shapes_without_data()
            self.ahead = self._batches_ahead()
            return
        if known := self.known_shape():
            self.possible(known)
        self._source = self.attempt(self.open) if self._sound else None
        self.refuse(self.faults)
        self._shapes = list(self.source.shapes)[: self.num_tops]
        make = partial(_make, self.source, self.num_tops, self.context.device.type == "cuda")
        self.ahead = self._batches_ahead()
        ahead: int = self.param.data_param.prefetch
        workers = 1 if self.in_order else max(1, min(ahead, os.cpu_count() or 1))
        size = sum(map(math.prod, self._shapes))
        at_once = MOST_AT_ONCE // max(size, MOST_AT_ONCE // 32) if isinstance(self.source, Together) else 1
        self._feed = Feed(make, ahead, workers, max(1, at_once))

    def _batches_ahead(self) -> int:
        """Return the bytes of the batches read ahead, float32."""
        return 4 * self.param.data_param.prefetch * sum(map(math.prod, self._shapes))

    def shapes_without_data(self) -> list[Shape]:
        """Return the tops' shapes as given by the caller or fixed by the prototxt; a label goes with each image."""
        given = self.context.options.given_shapes
        data = given.get(self.param.top[0]) or self.known_shape()
        if data is None:
            raise self.shape_wanted(self.param.top[0], f"{self.batch_size},C,H,W")
        return [data, *(given.get(top) or self.second_shape(data) for top in self.param.top[1:])]

    def second_shape(self, data: Shape) -> Shape:
        """Return the shape of the second top, for a first top of shape ``data``: a label for each image."""
        return data[:1]

    def shape_wanted(self, blob: str, example: str) -> SpecError:
        """Return the error that asks for the shape of a top."""
        advice = f"give --shape {blob}={example}, or --data"
        fault = self.error(f'the shape of "{blob}" is known only from its data; {advice}', "top")
        return UnknownShape(fault.message, fault.where)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self._shapes

    @property
    def source(self) -> Source:
        """The source of the batches, for a layer that opened its data."""
        assert self._source is not None, "built without opening data"
        return self._source

    @property
    def num_records(self) -> int:
        """The number of records (0: the data is not open). After the last record a batch continues with the first."""
        return self._source.cursor.count if self._source else 0

    @property
    def iteration(self) -> int:
        """The iteration of the batch that the next forward pass returns."""
        return self._feed.position if self._feed else 0

    @property
    def waited(self) -> float:
        return self._feed.waited if self._feed else 0.0

    def keys(self, iteration: int) -> list[str]:
        return self.source.keys(iteration)

    def restart(self, iteration: int = 0) -> None:
        if self._feed:
            self._feed.restart(iteration)

    def running_state(self) -> State:
        return {"iteration": self.iteration}

    def resume(self, state: Mapping[str, Any]) -> None:
        if state["iteration"] < 0:
            raise self.error(f"found iteration {state['iteration']} to resume from, expected at least 0")
        self.restart(state["iteration"])

    def close(self) -> None:
        if self._feed:
            self._feed.close()

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if self._feed is None:
            raise self.error("this net was built without opening its data, so it cannot run")
        tops, wraps = self._feed.next()
        for _ in range(wraps):
            self.log_restart()
        self.top_shapes = [tuple(top.shape) for top in tops]  # at batch size 1 images may differ in size
        if self.context.device.type == "cpu":  # even a ``to`` without effect lets other threads take Python's lock
            return tops
        return tuple(top.to(self.context.device, non_blocking=True) for top in tops)

    def log_restart(self) -> None:
        """Log that the last record was passed, if Caffe logs it."""

    # What the subclasses share

    @property
    def draws(self) -> Draws:
        """The random numbers of this layer. A TRAIN and a TEST layer may have the same name."""
        options, stream = self.context.options, f"{self.param.name}/{PHASE_NAMES[self.phase]}"
        return Draws(self.context.data_seed, stream, options.rank, options.ranks)

    def transformer(self, kind: type[Transformer] = Transformer) -> Transformer:
        """Return the transformer of this layer's ``transform_param``."""
        draws = self.draws
        return kind(self.param.transform_param, self.phase, self.context.at, draws.seed, draws.stream)

    @property
    def where(self) -> Where:
        """The position in the prototxt that names the data."""
        return self.context.at(self.group, "source")

    def cursor(self, count: int, rand_skip: int = 0, shuffle: bool = False, kind: type[Cursor] = Cursor) -> Cursor:
        """Return the order in which ``count`` records are read. ``rand_skip`` skips some of the first ones."""
        draws = self.draws
        skip = draw_skip(rand_skip, draws.seed, draws.stream)
        if rand_skip:
            log.info("image_data_layer.cpp:70", f"Skipping first {skip} data points.")
        if skip >= count:
            raise self.error(f"cannot skip {skip} records (rand_skip): there are only {count}", self.group, "rand_skip")
        return kind(count, self.batch_size, skip, shuffle, draws)

    def log_size(self, source: Source, site: str) -> None:
        """Log the shape of a batch."""
        log.info(site, "output data size: " + ",".join(map(str, source.shapes[0])))


def _make(source: Source, num_tops: int, pinned: bool, iteration: int, count: int) -> list[Batch]:
    """Make batches, in any thread. For a GPU they are page-locked, so that the copy is asynchronous.

    It has no reference to the layer, so that an unused layer is deleted at once, and its threads are stopped.
    """
    made: list[Batch] = []
    for i, arrays in enumerate(batches(source, iteration, count), iteration):
        tops = tuple(torch.from_numpy(array) for array in arrays[:num_tops])
        made.append((tuple(top.pin_memory() if pinned else top for top in tops), source.cursor.wraps(i)))
    return made


@register("Data", "data_param", "transform_param")
class Data(ReadingLayer):
    """Read the Datums of an LMDB or LevelDB, in the order of their keys, over and over.

    top[0]  transformed images (batch_size, C, H, W)
    top[1]  labels (batch_size,); may be left out
    Caffe: src/caffe/layers/data_layer.cpp
    """

    tops = (1, 2)
    group = "data_param"
    ignores = frozenset(f"data_param.{name}" for name in MOVED)

    def wrong_settings(self) -> Iterator[SpecError]:
        yield from super().wrong_settings()
        yield from contradictions(self.param.transform_param, self.context.at)

    def construct(self) -> None:
        super().construct()
        if self.opens_data and self._sound:
            p = self.param.data_param
            self._reader = self.attempt(open_reader, p.source, BACKENDS[p.backend], self.where)

    def open(self) -> Source | None:
        p, reader = self.param.data_param, self._reader
        transformer = self.attempt(self.transformer)
        if reader is None or transformer is None:
            return None
        if p.force_encoded_color:
            transformer.color = True
        speed, cursor = self.context.options.speed, self.cursor(len(reader), p.rand_skip)
        at_once = None if speed is None else speed.reads_at_once(transformer.decode)
        source = DatabaseSource(reader, cursor, transformer, self.where, at_once)
        self.log_size(source, "data_layer.cpp:45")
        return source

    def known_shape(self) -> Shape | None:
        """Return the shape if crop_size gives height and width, and several mean_value the number of channels."""
        p = self.param.transform_param
        if p.crop_size and len(p.mean_value) > 1:
            return (self.batch_size, len(p.mean_value), p.crop_size, p.crop_size)
        return None

    def log_restart(self) -> None:
        log.info("data_layer.cpp:73", "Restarting data prefetching from start.")


@register("ImageData", "image_data_param", "transform_param", "data_param.prefetch")
class ImageData(ReadingLayer):
    """Read image files named in a list of ``name label`` lines, resized bilinearly where asked.

    top[0]  transformed images (batch_size, 3 or 1, H, W)
    top[1]  labels (batch_size,)
    Caffe: src/caffe/layers/image_data_layer.cpp
    """

    group = "image_data_param"
    ignores = frozenset(f"image_data_param.{name}" for name in MOVED)

    def wrong_settings(self) -> Iterator[SpecError]:
        p = self.param.image_data_param
        if bool(p.new_height) != bool(p.new_width):
            yield self.error("new_height and new_width must be given together", self.group)
        yield from super().wrong_settings()
        yield from contradictions(self.param.transform_param, self.context.at)

    def open(self) -> Source | None:
        """Read the list; its first image sets the shape."""
        p = self.param.image_data_param
        log.info("image_data_layer.cpp:38", f"Opening file {p.source}")
        images = self.attempt(read_image_list, p.source, self.where)
        transformer = self.attempt(self.transformer)
        if images is None or transformer is None:
            return None
        if p.shuffle:
            log.info("image_data_layer.cpp:53", "Shuffling data")
        log.info("image_data_layer.cpp:63", f"A total of {len(images)} images.")
        cursor = self.cursor(len(images), p.rand_skip, p.shuffle)
        size = (p.new_height, p.new_width) if p.new_height else None
        self.possible((3, *(size or ())))
        source = ImageListSource(images, p.root_folder, p.is_color, size, cursor, transformer)
        self.log_size(source, "image_data_layer.cpp:90")
        return source

    def known_shape(self) -> Shape | None:
        """Return the shape if crop_size, or new_height and new_width, give height and width."""
        p, crop = self.param.image_data_param, self.param.transform_param.crop_size
        height, width = (crop, crop) if crop else (p.new_height, p.new_width)
        return (self.batch_size, 3 if p.is_color else 1, height, width) if height else None


@register("WindowData", "window_data_param", "transform_param", "data_param.prefetch")
class WindowData(ReadingLayer):
    """Draw windows of images, some that show an object and some that show none, warped to one size.

    top[0]  images (batch_size, 3, crop_size, crop_size)
    top[1]  labels (batch_size,); 0 is background
    Caffe: src/caffe/layers/window_data_layer.cpp
    """

    group = "window_data_param"
    ignores = frozenset(
        {f"window_data_param.{name}" for name in MOVED if name != "scale"}
        | {f"transform_param.{name}" for name in ("scale", "force_color", "force_gray")}
    )

    def wrong_settings(self) -> Iterator[SpecError]:
        from netspec.data.windows import wrong_means

        p, crop = self.param.window_data_param, self.param.transform_param.crop_size
        yield from super().wrong_settings()
        if crop <= 0:
            yield self.error(f"crop_size must be above 0, found {crop}", "transform_param", "crop_size")
        if p.crop_mode not in ("warp", "square"):
            message = f'unknown crop_mode "{p.crop_mode}"; expected warp or square'
            yield self.error(message, self.group, "crop_mode")
        if crop > 0 and 2 * p.context_pad >= crop:
            message = f"context_pad {p.context_pad} on both sides leaves no pixels of crop_size {crop}"
            yield self.error(message, self.group, "context_pad")
        yield from wrong_means(self.param.transform_param, self.context.at)

    def open(self) -> Source | None:
        from netspec.data.windows import WindowSource, read_window_file, window_mean

        p, transform, context = self.param.window_data_param, self.param.transform_param, self.context
        file = self.attempt(read_window_file, p, self.where)
        mean = self.attempt(window_mean, transform, context.at)
        if file is None or mean is None:
            return None
        return WindowSource(p, transform, file, mean, context.at, self.draws)

    def known_shape(self) -> Shape:
        """Return the shape, which the prototxt determines."""
        crop: int = self.param.transform_param.crop_size
        return (self.batch_size, 3, crop, crop)
