"""Temporal segment networks: layers that read frames or optical flow of videos, and crop windows of several sizes.

Fork: yjxiong/caffe (Wang et al., Temporal Segment Networks, ECCV 2016). The random numbers are the net's own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from typing_extensions import override

from netspec.data.images import list_lines, read_image, read_label
from netspec.data.random_words import words
from netspec.data.resize import resized
from netspec.data.sources import Cursor, ImageSource, Item, Source
from netspec.data.transformer import Transformer, contradictions
from netspec.dialects.layers import replace
from netspec.errors import SpecError, Where
from netspec.layers import register
from netspec.layers.contract.base import Shape
from netspec.layers.data import files
from netspec.proto.schema import TRAIN, value

DECLARATIONS = """
message VideoDataParameter {
  enum Modality { RGB = 0; FLOW = 1; }
  optional string source = 1;
  optional uint32 batch_size = 4;
  optional uint32 rand_skip = 7 [default = 0];
  optional bool shuffle = 8 [default = false];
  optional uint32 new_height = 9 [default = 0];
  optional uint32 new_width = 10 [default = 0];
  optional uint32 new_length = 11 [default = 1];
  optional uint32 num_segments = 12 [default = 1];
  optional Modality modality = 13 [default = FLOW];
  optional string name_pattern = 14;
  optional bool encoded = 15 [default = false];
  optional bool grayscale = 16 [default = false];
}
extend DataParameter {
  optional bool shuffle = 1010 [default = false];
}
extend TransformationParameter {
  optional bool fix_crop = 1010 [default = false];
  optional bool multi_scale = 1011 [default = false];
  repeated float scale_ratios = 1012;
  optional int32 max_distort = 1013 [default = 1];
  optional bool is_flow = 1014 [default = false];
  optional bool more_fix_crop = 1015 [default = false];
}
extend LayerParameter {
  optional VideoDataParameter video_data_param = 1190;
}
"""

Array = np.ndarray
GROUP, RGB, FLOW = "video_data_param", 0, 1
WINDOWS = ("fix_crop", "multi_scale", "scale_ratios", "max_distort", "is_flow", "more_fix_crop")
TRANSFORM = ("transform_param", *(f"transform_param.{name}" for name in WINDOWS))
RATIOS = (1.0, 0.875, 0.75, 0.66)  # default scale_ratios: a window's side divided by the image's shorter side
NEAR = 3  # a side of a window that differs from crop_size by less becomes crop_size
CORNERS = ((0, 0), (0, 4), (4, 0), (4, 4), (2, 2))  # positions of windows with fix_crop, in quarters of the free space
MORE_CORNERS = ((0, 2), (4, 2), (2, 0), (2, 4), (1, 1), (1, 3), (3, 1), (3, 3))


class Windows(Transformer):
    """Caffe's Transformer with windows of several sizes and positions. Mean values are used again for each frame."""

    def __init__(self, param: Any, *arguments: Any) -> None:
        super().__init__(param, *arguments)
        self._param = param

    @override
    def output_shape(self, shape: Shape) -> Shape:
        given = len(self.mean_values)
        if given and given < shape[0] and shape[0] % given == 0:
            self.mean_values = np.tile(self.mean_values, shape[0] // given)
        return super().output_shape(shape)

    @override
    def _transform(self, images: Array, out: Array, draws: Array) -> None:
        for image, cut, (mirror, h_off, w_off, _) in zip(images, out, draws.tolist(), strict=True):
            self._transform_one(image, cut, mirror, h_off, w_off)

    def _transform_one(self, image: Array, out: Array, mirror: int, h_off: int, w_off: int) -> None:
        """Crop a window, in training with a random size and position, and resize it to crop_size."""
        p = self._param
        flipped = self.mirror and mirror % 2 == 1
        if self._random_crop and (value(p, "multi_scale") or value(p, "fix_crop")):
            image = self._window(image, mirror // 2, h_off, w_off)
        elif self.crop_size:
            spare = [size - self.crop_size for size in image.shape[1:]]
            draws = (h_off, w_off)
            corner = [d % (s + 1) if self._random_crop else s // 2 for d, s in zip(draws, spare, strict=True)]
            image = _cut(image, corner, (self.crop_size, self.crop_size))
        image = image[:, :, ::-1] if flipped else image
        if value(p, "is_flow") and flipped:
            image = np.concatenate(
                [255 - image[c : c + 1] if c % 2 == 0 else image[c : c + 1] for c in range(len(image))]
            )
        if len(self.mean_values):
            np.subtract(image, self.mean_values[:, None, None], out=out, dtype=np.float32)
        else:
            out[...] = image

    def _window(self, image: Array, chosen: int, h_off: int, w_off: int) -> Array:
        p, size = self._param, self.crop_size
        sizes = [(size, size)]
        if value(p, "multi_scale"):
            sides = [int(min(image.shape[1:]) * ratio) for ratio in list(value(p, "scale_ratios")) or RATIOS]
            sides = [size if abs(side - size) < NEAR else side for side in sides]
            most = value(p, "max_distort")
            sizes = [(a, b) for i, a in enumerate(sides) for k, b in enumerate(sides) if abs(i - k) <= most]
        window = sizes[chosen % len(sizes)]
        free = [whole - part for whole, part in zip(image.shape[1:], window, strict=True)]
        if value(p, "fix_crop"):
            corners = CORNERS + (MORE_CORNERS if value(p, "more_fix_crop") else ())
            multiples = corners[h_off % len(corners)]
            corner = [quarters * (size // 4) for quarters, size in zip(multiples, free, strict=True)]
        else:
            corner = [draw % (size + 1) for draw, size in zip((h_off, w_off), free, strict=True)]
        cut = _cut(image, corner, window)
        if window == (size, size):
            return cut
        return np.stack([resized(plane, size, size) for plane in cut])


def _cut(image: Array, corner: Sequence[int], window: tuple[int, int]) -> Array:
    return image[:, corner[0] : corner[0] + window[0], corner[1] : corner[1] + window[1]]


def _wrong_transform(layer: files.ReadingLayer) -> Iterator[SpecError]:
    transform = layer.param.transform_param
    scaled = value(transform, "multi_scale") or value(transform, "fix_crop")
    if transform.mean_file and (scaled or value(transform, "is_flow")):
        yield layer.error("mean_file cannot be used with windows of several sizes; give mean_value", "transform_param")
    if scaled and not transform.crop_size:
        yield layer.error("multi_scale and fix_crop need crop_size", "transform_param", "crop_size")


class LaterShuffled(Cursor):
    """A Cursor that reads the first epoch in order, and shuffles only the others."""

    @override
    def _record(self, position: int) -> int:
        return position if position < self.count else super()._record(position)


@replace("Data", "data_param", "data_param.shuffle", *TRANSFORM)
class Data(files.Data):
    """Caffe's Data; with shuffle, each epoch after the first has a different random order.

    top[0]  transformed images (batch_size, C, H, W)
    top[1]  labels (batch_size,); may be left out
    Fork: yjxiong/caffe, src/caffe/layers/data_layer.cpp, src/caffe/data_transformer.cpp
    """

    def wrong_settings(self) -> Iterator[SpecError]:
        yield from super().wrong_settings()
        yield from _wrong_transform(self)

    @override
    def cursor(
        self, count: int, rand_skip: int = 0, shuffle: bool = False, kind: type[Cursor] = LaterShuffled
    ) -> Cursor:
        return super().cursor(count, rand_skip, value(self.param.data_param, "shuffle"), kind)

    @override
    def transformer(self, kind: type[Transformer] = Windows) -> Transformer:
        of_windows = any(value(self.param.transform_param, name) for name in ("fix_crop", "multi_scale", "is_flow"))
        return super().transformer(kind if of_windows else Transformer)


@dataclass(frozen=True)
class Video:
    """A line of the list: the folder of a video's frames, their number, its label, and the position of the line."""

    folder: str
    frames: int
    label: int
    where: Where


def read_videos(path: str, where: Where | None = None) -> list[Video]:
    """Read lines ``folder frames label``. Raises SpecError for another line, and for a list without lines."""
    videos = []
    for line, position in list_lines(path, where):
        found = re.fullmatch(r"(.+?)\s+([0-9]{1,9})\s+([0-9]+)", line)
        if not found:
            raise SpecError(
                f'found "{line}", expected the folder of a video, how many frames it has, its label', position
            )
        videos.append(Video(found[1], int(found[2]), read_label(found[3], position), position))
    if not videos:
        raise SpecError(f'the list "{path}" is empty', where or Where(path))
    return videos


class VideoSource(ImageSource):
    """Batches of videos: consecutive frames from each of ``num_segments`` equal parts, as channels.

    The frames of a part begin at a random position in training, and at its center in testing. Raises SpecError for a
    frame that cannot be read, and for a video whose frames have another size than the first video's.
    """

    label_axes = (1, 1, 1)

    def __init__(
        self, param: Any, videos: Sequence[Video], cursor: Cursor, transform: Transformer, draws: Any, phase: int
    ) -> None:
        self._param, self._videos, self._draws, self._training = param, videos, draws, phase == TRAIN
        default = "image_%04d.jpg" if param.modality == RGB else "flow_%c_%04d.jpg"
        self._pattern = param.name_pattern or default
        super().__init__(cursor, transform)

    def keys(self, iteration: int) -> list[str]:
        """Return the folders of an iteration."""
        return [self._videos[record].folder for record in self.cursor.records(iteration)]

    @override
    def item(self, record: int, position: int) -> Item:
        video, p = self._videos[record], self._param
        length = video.frames // p.num_segments
        starts, planes = length - p.new_length + 1, []  # how many frames of a segment can be the first
        size = (p.new_height, p.new_width) if p.new_height else None
        for segment in range(p.num_segments):
            draw = int(self._draws(position * p.num_segments + segment, 1)[0, 0]) if self._training else 0
            start = 0
            if starts > 0:
                start = segment * length + (draw % starts if self._training else starts // 2)
            for number in range(start + 1, start + p.new_length + 1):
                for name in [(number,)] if p.modality == RGB else [("x", number), ("y", number)]:
                    path = f"{video.folder}/{self._pattern % name}"
                    try:
                        planes.append(read_image(path, p.modality == RGB and not p.grayscale, size))
                    except ValueError as fault:
                        raise SpecError(str(fault), video.where) from None
        if len({plane.shape[1:] for plane in planes}) > 1:
            raise SpecError("its frames differ in size", video.where)
        return Item(video.folder, np.concatenate(planes), video.label, video.where)


@register("VideoData", GROUP, *TRANSFORM, "data_param.prefetch")
class VideoData(files.ReadingLayer):
    """Read frames or flow of videos, which are folders of images; a list has lines ``folder frames label``.

    From each of num_segments parts of a video, new_length consecutive frames are read. name_pattern is their file name,
    with their number from 1; for flow also with a letter, x or y, for two gray images.

    top[0]  (batch_size, 3 new_length num_segments, H, W); for flow, 2 new_length num_segments: x, y, x, y, ...
    top[1]  labels (batch_size, 1, 1, 1)
    Fork: yjxiong/caffe, src/caffe/layers/video_data_layer.cpp
    """

    group = GROUP

    def wrong_settings(self) -> Iterator[SpecError]:
        p = value(self.param, GROUP)
        if bool(p.new_height) != bool(p.new_width):
            yield self.error("new_height and new_width must be given together", GROUP)
        for name in ("new_length", "num_segments"):
            if getattr(p, name) < 1:
                yield self.error(f"{name} must be at least 1", GROUP, name)
        try:
            if p.name_pattern:
                _ = p.name_pattern % (("x", 1) if p.modality == FLOW else (1,))
        except (TypeError, ValueError):
            expected = "flow_%c_%05d.jpg" if p.modality == FLOW else "img_%05d.jpg"
            yield self.error(f'found "{p.name_pattern}", expected a pattern as {expected}', GROUP, "name_pattern")
        yield from super().wrong_settings()
        yield from contradictions(self.param.transform_param, self.context.at)
        yield from _wrong_transform(self)

    def open(self) -> Source | None:
        p, draws = value(self.param, GROUP), self.draws
        videos = self.attempt(read_videos, p.source, self.where)
        transformer = self.attempt(self.transformer, Windows)
        if videos is None or transformer is None:
            return None
        cursor = self.cursor(len(videos), p.rand_skip, p.shuffle)
        starts = partial(words, draws.seed, f"{draws.stream}/frames")
        source = VideoSource(p, videos, cursor, transformer, starts, self.phase)
        self.log_size(source, "video_data_layer.cpp:88")
        return source

    def known_shape(self) -> Shape | None:
        """Return the shape if the prototxt gives height and width."""
        p, crop = value(self.param, GROUP), self.param.transform_param.crop_size
        height, width = (crop, crop) if crop else (p.new_height, p.new_width)
        planes = 2 if p.modality == FLOW else 1 if p.grayscale else 3
        return (self.batch_size, planes * p.new_length * p.num_segments, height, width) if height else None

    def second_shape(self, data: Shape) -> Shape:
        return (data[0], 1, 1, 1)
