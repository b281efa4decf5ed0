"""SSD's AnnotatedData: images with boxes from a database of AnnotatedDatum, with data augmentation.

Fork: weiliu89/caffe (ssd), src/caffe/layers/annotated_data_layer.cpp
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from netspec.data.database import Reader
from netspec.data.datum import datum_to_array, shape_text
from netspec.data.random_words import derived
from netspec.data.sources import Arrays, Cursor, Draws, Source
from netspec.dialects.ssd.augment import COLUMNS, FIT_SMALL_SIZE, Augmenter, fixed_size, wrong_settings
from netspec.errors import SpecError, Where
from netspec.layers.contract.base import Shape
from netspec.layers.data.files import Data, ReadingLayer
from netspec.proto.schema import has, message, value

Array = np.ndarray

PERIOD = 10  # iterations between two random choices of a resize_param
MOST_BOXES = 300  # maximum number of boxes in an image with yolo_data_type: 1


class AnnotatedSource:
    """The records of a database of AnnotatedDatum, made into batches.

    The augmentation of a record depends only on ``draws`` and the record's position. One of several ``augments`` is
    drawn for PERIOD iterations, with the prob of its resize_param. ``settings`` is the annotated_data_param. With
    anno_type, all records are treated as having boxes; with yolo_data_type 1, each image's boxes are the rows of
    YOLO: class from 0, x, y, width, height. Raises SpecError for a record that cannot be read.
    """

    def __init__(
        self,
        reader: Reader,
        cursor: Cursor,
        augments: Sequence[Augmenter],
        settings: Any,
        draws: Draws,
        where: Where | None,
    ) -> None:
        self.cursor, self._reader, self._augments, self._where = cursor, reader, augments, where
        self._draws, self._difficult = draws, settings.train_diffcult
        self._centered = centered = settings.yolo_data_type == 1
        self._parse = message("ssd.AnnotatedDatum").FromString
        self._has_boxes = True
        image, first = self._read(cursor.first())
        self._has_boxes = centered or has(settings, "anno_type") or first.HasField("type")
        self._shapes = [(image.shape[2], *augment.size(image.shape)) for augment in augments]
        count = sum(len(group.annotation) for group in first.annotation_group)
        batch = cursor.batch_size
        second: Shape = (batch, 1, 1, 1)
        if centered:
            second = (batch, 1, MOST_BOXES, 5)
        elif self._has_boxes:
            second = (1, 1, max(count, 1), COLUMNS + 1)
        self.shapes: Sequence[Shape] = ((batch, *self._shapes[0]), second)

    def keys(self, iteration: int) -> list[str]:
        """Return the keys of the records of an iteration."""
        return [self._name(record) for record in self.cursor.records(iteration)]

    def batch(self, iteration: int) -> Arrays:
        """Return images (N, C, H, W) and rows of boxes (1, 1, n, 8), or labels (N, 1, 1, 1)."""
        images, rows, labels = [], [], []
        chosen = self._chosen(iteration)
        augment, shape = self._augments[chosen], self._shapes[chosen]
        numbered = zip(self.cursor.records(iteration), self.cursor.positions(iteration), strict=True)
        for item, (record, position) in enumerate(numbered):
            pixels, datum = self._read(record)
            draw = Random(derived(self._draws.seed, f"{self._draws.stream}/{position}"))
            image, boxes = augment(pixels, self._boxes(datum), draw)
            if self.cursor.batch_size > 1 and image.shape != shape:
                advice = "all must have the same size: give resize_param, or batch_size: 1"
                found = f'record "{self._name(record)}" gives {shape_text(image.shape)}, the first {shape_text(shape)}'
                raise SpecError(f"{found}; {advice}", self._where)
            images.append(image)
            rows.append(np.insert(boxes, 0, item, axis=1))
            labels.append(datum.datum.label)
        if not self._has_boxes:
            return np.stack(images), np.array(labels, np.float32).reshape(-1, 1, 1, 1)
        if self._centered:
            return np.stack(images), np.stack([self._as_centered(boxes[:, 1:]) for boxes in rows])
        found = np.concatenate(rows)
        nothing = np.full((1, COLUMNS + 1), -1, np.float32)
        return np.stack(images), (found if len(found) else nothing)[None, None]

    def _chosen(self, iteration: int) -> int:
        """Return the index of the augmenter for an iteration."""
        if len(self._augments) == 1:
            return 0
        draw = Random(derived(self._draws.seed, f"{self._draws.stream}/resize/{iteration // PERIOD}"))
        (chosen,) = draw.choices(range(len(self._augments)), [a.resize.prob for a in self._augments])
        return chosen

    def _as_centered(self, boxes: Array) -> Array:
        """Return boxes (n, 7) as YOLO's rows (1, MOST_BOXES, 5), zeros after the last."""
        if not self._difficult:
            boxes = boxes[boxes[:, 6] == 0]
        rows = np.zeros((1, MOST_BOXES, 5), np.float32)
        low, high = boxes[:MOST_BOXES, 2:4], boxes[:MOST_BOXES, 4:6]
        rows[0, : len(low)] = np.concatenate([boxes[:MOST_BOXES, :1] - 1, (low + high) / 2, high - low], axis=1)
        return rows

    def _name(self, record: int) -> str:
        return self._reader.key(record).decode(errors="backslashreplace")

    def _read(self, record: int) -> tuple[Array, Any]:
        """Return the image (H, W, C) of a record, and the record."""
        try:
            try:
                datum = self._parse(self._reader.record(record))
            except DecodeError:
                raise ValueError("is no AnnotatedDatum") from None
            if not datum.HasField("datum"):
                raise ValueError("is no AnnotatedDatum; for a database of plain images use a layer of type Data")
            image = datum_to_array(datum.datum, self._augments[0].color)
            if image.dtype != np.uint8:
                raise ValueError(f"has {image.dtype} values, expected 8 bits per channel")
            return np.ascontiguousarray(image.transpose(1, 2, 0)), datum
        except ValueError as fault:
            raise SpecError(f'record "{self._name(record)}" {fault}', self._where) from None

    @staticmethod
    def _boxes(datum: Any) -> Array:
        """Return the boxes of a record (n, 7): label, instance, xmin, ymin, xmax, ymax, difficult."""
        rows = [
            (group.group_label, a.instance_id, a.bbox.xmin, a.bbox.ymin, a.bbox.xmax, a.bbox.ymax, a.bbox.difficult)
            for group in datum.annotation_group
            for a in group.annotation
        ]
        return np.array(rows, np.float32).reshape(-1, COLUMNS)


class AnnotatedData(Data):
    """Read images with boxes from a database of AnnotatedDatum, in the order of its keys, over and over.

    Each image is augmented in this order: colors (distort_param), a larger canvas (expand_param), a window that one of
    the batch samplers draws, a new size (resize_param), crop, mirror, mean, scale. Boxes are clipped to the window;
    emit_constraint determines which are kept.

    top[0]  images (batch_size, C, H, W)
    top[1]  a row for each box (1, 1, n, 8): image, label, instance, xmin, ymin, xmax, ymax, difficult; corners
            relative to the image; one row of -1 if there is none. Records without a type have labels instead
            (batch_size, 1, 1, 1). May be left out. With yolo_data_type 1, (batch_size, 1, 300, 5): class from 0, x, y,
            width, height; zeros after the last box.
    Fork: src/caffe/layers/annotated_data_layer.cpp; one of several resize_param is drawn by prob for 10 iterations
    each: eric612/MobileNet-YOLO
    """

    def wrong_settings(self) -> Iterator[SpecError]:
        p = self.param
        yield from ReadingLayer.wrong_settings(self)
        yield from wrong_settings(p.transform_param, self._samplers, self.context.at)
        resizes = value(p.transform_param, "resize_param")
        if any(resize.resize_mode == FIT_SMALL_SIZE for resize in resizes) and p.data_param.batch_size > 1:
            found = f"found {p.data_param.batch_size}"
            message = f"FIT_SMALL_SIZE gives each image a size of its own: it needs batch_size: 1, {found}"
            yield self.error(message, "data_param", "batch_size")
        if not 0 <= self._jitter < 1:
            message = f"found yolo_data_jitter {self._jitter:g}, expected 0 to less than 1"
            yield self.error(message, "annotated_data_param", "yolo_data_jitter")

    @property
    def _jitter(self) -> float:
        """The maximum share of a side that a window may leave out; the default is YOLO's."""
        settings = value(self.param, "annotated_data_param")
        given = settings.HasField("yolo_data_jitter") or settings.yolo_data_type == 1
        return float(settings.yolo_data_jitter) if given else 0.0

    @property
    def _samplers(self) -> Sequence[Any]:
        samplers: Sequence[Any] = value(self.param, "annotated_data_param").batch_sampler
        return samplers

    def open(self) -> Source | None:
        p, context = self.param, self.context
        reader = self._reader
        transform, settings = p.transform_param, value(p, "annotated_data_param")
        resizes = list(value(transform, "resize_param")) or [None]
        given = (transform, self._samplers, self.phase, context.at)
        made = [self.attempt(Augmenter, *given, resize, self._jitter) for resize in resizes]
        augments = [augment for augment in made if augment is not None]
        if reader is None or len(augments) < len(made):
            return None
        if p.data_param.force_encoded_color:
            for augment in augments:
                augment.color = True
        cursor = self.cursor(len(reader), p.data_param.rand_skip)
        source = AnnotatedSource(reader, cursor, augments, settings, self.draws, self.where)
        self.log_size(source, "annotated_data_layer.cpp:62")
        return source

    def known_shape(self) -> Shape | None:
        """Return the shape if the prototxt gives size and channels."""
        p = self.param.transform_param
        size = fixed_size(p)
        channels = 3 if p.force_color else 1 if p.force_gray else len(p.mean_value)
        return (self.batch_size, channels, *size) if size and (channels > 1 or p.force_gray) else None

    def second_shape(self, data: Shape) -> Shape:
        """Return the shape of a single box, or of an image's boxes in YOLO's format."""
        centered = value(self.param, "annotated_data_param").yolo_data_type == 1
        return (self.batch_size, 1, MOST_BOXES, 5) if centered else (1, 1, 1, COLUMNS + 1)
