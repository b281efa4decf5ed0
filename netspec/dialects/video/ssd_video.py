"""SSD's VideoData: the frames of a video or a camera. `tsn` has a different VideoData, for folders of frames.

Fork: weiliu89/caffe (ssd)
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from random import Random

import numpy as np

from netspec.data.random_words import derived
from netspec.data.sources import Arrays, Cursor, Draws, Source
from netspec.dialects.known import dialect
from netspec.dialects.registry import declare
from netspec.dialects.ssd.augment import COLUMNS, Augmenter, fixed_size, wrong_settings
from netspec.errors import SpecError, Where
from netspec.files.opencv import cv2
from netspec.layers import register
from netspec.layers.contract.base import Shape
from netspec.layers.data.files import ReadingLayer
from netspec.proto.schema import value

DECLARATIONS = """
message VideoDataParameter {
  enum VideoType { WEBCAM = 0; VIDEO = 1; }
  optional VideoType video_type = 1 [default = WEBCAM];
  optional int32 device_id = 2 [default = 0];
  optional string video_file = 3;
  optional uint32 skip_frames = 4 [default = 0];
}
extend LayerParameter {
  optional VideoDataParameter video_data_param = 207;
}
"""

GROUP, VIDEO = "video_data_param", 1
NO_BOXES = np.empty((0, COLUMNS), np.float32)


class Frames:
    """The frames of a video (a path), by index, or of a camera (its number). They are read in order.

    Raises SpecError if it cannot be opened or has no frame.
    """

    def __init__(self, name: str | int, where: Where) -> None:
        self._name, self._where = name, where
        self.title = f"camera {name}" if isinstance(name, int) else f'video "{name}"'
        self._open()
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) if isinstance(name, str) else sys.maxsize

    def _open(self) -> None:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it would print its own messages
        self._capture, self._next = cv2.VideoCapture(self._name), 0
        cv2.utils.logging.setLogLevel(level)
        if not self._capture.isOpened():
            raise SpecError(f"{self.title} cannot be opened", self._where)

    def read(self, number: int) -> np.ndarray:
        """Return a frame (H, W, 3) uint8, blue first. Raises SpecError after the last one."""
        if number < self._next:
            if isinstance(self._name, str):
                self._open()
            else:
                self._next = number
        while self._next < number and self._capture.grab():
            self._next += 1
        there, frame = self._capture.read()
        if not there:
            raise SpecError(f"{self.title} has ended: there is no frame {number + 1}", self._where)
        self._next += 1
        return frame


class VideoSource:
    """Batches of frames; ``skip`` frames are skipped before each. Random numbers depend on the frame's position."""

    def __init__(self, frames: Frames, cursor: Cursor, augment: Augmenter, skip: int, draws: Draws) -> None:
        self.cursor, self._frames, self._augment, self._step = cursor, frames, augment, skip + 1
        self._draws = draws
        size = augment.size(frames.read(0).shape)
        self.shapes: Sequence[Shape] = [(cursor.batch_size, 3, *size), (cursor.batch_size,)]

    def keys(self, iteration: int) -> list[str]:
        """Return the names of the frames of an iteration, which are numbers from 1."""
        return [f"{self._frames.title} frame {number + 1}" for number in self._numbers(iteration)]

    def _numbers(self, iteration: int) -> list[int]:
        return [(position + 1) * self._step - 1 for position in self.cursor.positions(iteration)]

    def batch(self, iteration: int) -> Arrays:
        """Return frames (N, 3, H, W) and labels (N,), all 0."""
        images = []
        for position, number in zip(self.cursor.positions(iteration), self._numbers(iteration), strict=True):
            draw = Random(derived(self._draws.seed, f"{self._draws.stream}/{position}"))
            images.append(self._augment.transformed(self._frames.read(number), NO_BOXES, draw)[0])
        return np.stack(images), np.zeros(len(images), np.float32)


@register(
    "VideoData",
    GROUP,
    "data_param",
    "transform_param",
    "transform_param.resize_param",
    "transform_param.crop_h",
    "transform_param.crop_w",
)
class VideoData(ReadingLayer):
    """Read the frames of a video or a camera. Before each frame, skip_frames others are skipped.

    Frames are resized (resize_param), cropped and mirrored. The end of a video is an error. The
    last batch is dropped if it is incomplete.

    top[0]  transformed frames (batch_size of data_param, 3, H, W)
    top[1]  labels (batch_size,), all 0; may be left out
    Fork: weiliu89/caffe (ssd), src/caffe/layers/video_data_layer.cpp
    """

    tops = (1, 2)
    group = "data_param"
    in_order = True

    def construct(self) -> None:
        declare(dialect("ssd"))  # its transform_param
        super().construct()

    def wrong_settings(self) -> Iterator[SpecError]:
        transform, p = self.param.transform_param, value(self.param, GROUP)
        if self.param.data_param.batch_size <= 0:
            yield self.error("batch_size of data_param must be above 0", "data_param", "batch_size")
        if p.video_type == VIDEO and not p.video_file:
            yield self.error("video_file is missing; set it to the path of the video", GROUP, "video_file")
        if len(value(transform, "resize_param")) > 1:
            yield self.error("expected one resize_param", "transform_param", "resize_param")
        yield from wrong_settings(transform, [], self.context.at)

    def open(self) -> Source | None:
        p, transform, context = value(self.param, GROUP), self.param.transform_param, self.context
        name, field = (p.video_file, "video_file") if p.video_type == VIDEO else (p.device_id, "device_id")
        frames = self.attempt(Frames, name, context.at(GROUP, field))
        resize = next(iter(value(transform, "resize_param")), None)
        augment = self.attempt(Augmenter, transform, [], self.phase, context.at, resize)
        if frames is None or augment is None:
            return None
        batches = frames.count // (p.skip_frames + 1) // self.batch_size
        if not batches:
            raise self.error(f"{frames.title} has {frames.count} frames, too few for a batch", GROUP, field)
        cursor = self.cursor(batches * self.batch_size)
        source = VideoSource(frames, cursor, augment, p.skip_frames, self.draws)
        self.log_size(source, "video_data_layer.cpp:73")
        return source

    @property
    def num_records(self) -> int:
        return super().num_records if value(self.param, GROUP).video_type == VIDEO else 0

    def known_shape(self) -> Shape | None:
        """Return the shape if the prototxt gives the size."""
        size = fixed_size(self.param.transform_param)
        return (self.batch_size, 3, *size) if size else None
