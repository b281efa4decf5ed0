"""SSD's DetectionEvaluate, and the mean average precision of detections.

Fork: weiliu89/caffe (ssd), src/caffe/layers/detection_evaluate_layer.cpp; Solver::TestDetection (src/caffe/solver.cpp),
ComputeAP (src/caffe/util/bbox_util.cpp)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.dialects.boxes import Array, as_array, highest, overlaps
from netspec.dialects.checks import check_at_least_1
from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.layers.contract.base import Layer, Scorer, Shape, State
from netspec.proto.schema import value

IMAGE, LABEL, CONFIDENCE = 0, 1, 2  # columns of a detection; its box follows
NO_IMAGE = -1
WARP = 1  # ssd.py: enum ResizeParameter.Resize_mode
INTEGRAL = "Integral"


class DetectionEvaluate(Layer):
    """Judge each detection: it is right if it overlaps a box of its label enough that no better detection matches.

    A detection on a difficult box is neither right nor wrong, unless evaluate_difficult_gt is set. In a test,
    the rows of all batches together give the mean average precision, the only number shown for this top.

    bottom[0]  detections (1, 1, d, 7), DetectionOutput's
    bottom[1]  true boxes (1, 1, g, 8), AnnotatedData's
    top[0]     (1, 1, classes + d, 5): for each class (-1, label, number of true boxes, -1, -1), then for each detection
               (image, label, confidence, right, wrong)
    Fork: src/caffe/layers/detection_evaluate_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({0, 1})
    counted_axis = 2
    not_exported = "it compares with true boxes"
    changes_itself = True  # index of the next image

    def setup(self) -> None:
        param = value(self.param, "detection_evaluate_param")
        check_at_least_1(self, "detection_evaluate_param", "num_classes")
        if param.overlap_threshold <= 0:
            raise self.error("overlap_threshold must be above 0", "detection_evaluate_param", "overlap_threshold")
        if param.HasField("resize_param") and param.resize_param.resize_mode != WARP and param.name_size_file:
            message = "with name_size_file only resize_mode WARP can be evaluated"
            raise self.error(message, "detection_evaluate_param", "resize_param")
        self.classes = [label for label in range(param.num_classes) if label != param.background_label_id]
        self._sizes = self._read_sizes(param.name_size_file) if param.name_size_file else None
        self._image = 0

    def _read_sizes(self, file: str) -> Array:
        """Return the width and height of each image (n, 2), from lines of name, height and width."""
        try:
            rows = [line.split() for line in Path(file).read_text("utf-8").splitlines() if line.strip()]
        except (OSError, UnicodeDecodeError) as fault:
            message = f'name_size_file "{file}" {unreadable(file, fault)}'
            raise self.error(message, "detection_evaluate_param", "name_size_file") from None
        for number, row in enumerate(rows, 1):
            if len(row) != 3 or not all(word.isdecimal() for word in row[1:]):
                line = " ".join(row)
                raise SpecError(f'found "{line}", expected a name, a height and a width', Where(file, number, 1))
        return np.array([(int(row[2]), int(row[1])) for row in rows], np.float32)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        for i, (shape, columns) in enumerate(zip(bottom_shapes, (7, 8), strict=True)):
            if len(shape) != 4 or shape[:2] != (1, 1) or shape[3] != columns:
                raise self.error(f"found a bottom of shape {shape}, expected (1, 1, n, {columns})", "bottom", i)
        return [(1, 1, len(self.classes) + bottom_shapes[0][2], 5)]

    def restart(self) -> None:
        self._image = 0

    def running_state(self) -> State:
        return {"image": self._image}

    def resume(self, state: Mapping[str, Any]) -> None:
        if state["image"] < 0:
            raise self.error(f"found image {state['image']} to go on from, expected at least 0")
        self._image = state["image"]

    def forward(self, detections: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        param = value(self.param, "detection_evaluate_param")
        found, boxes = as_array(detections).reshape(-1, 7), as_array(truth).reshape(-1, 8)
        boxes = boxes[: next(iter(np.flatnonzero(boxes[:, IMAGE] == NO_IMAGE)), len(boxes))]
        counted = boxes if param.evaluate_difficult_gt else boxes[boxes[:, 7] == 0]
        rows: list[tuple[float, ...]] = [
            (NO_IMAGE, label, (counted[:, LABEL] == label).sum(), -1, -1) for label in self.classes
        ]
        for image in np.unique(found[:, IMAGE]):
            own = found[(found[:, IMAGE] == image) & (found[:, LABEL] != -1)]
            for label in np.unique(own[:, LABEL]):
                true = boxes[(boxes[:, IMAGE] == image) & (boxes[:, LABEL] == label)]
                rows += self._judged(own[own[:, LABEL] == label], true, param)
            self._image += 1
        top = torch.from_numpy(np.array(rows, np.float32)[None, None]).to(detections)
        self.top_shapes = [tuple(top.shape)]
        return top

    def _judged(self, found: Array, true: Array, param: Any) -> Iterator[tuple[float, ...]]:
        """Yield the rows of detections of one label in one image, by decreasing confidence."""
        found = found[highest(found[:, CONFIDENCE], len(found))]
        table = self._overlaps(found[:, 3:7], true[:, 3:7])
        taken = set[int]()
        for row, own in zip(found, table, strict=True):
            best = int(own.argmax()) if len(true) else -1
            right, wrong = 0, 0
            if best < 0 or own[best] < param.overlap_threshold:
                wrong = 1
            elif param.evaluate_difficult_gt or not true[best, 7]:
                right, wrong = (0, 1) if best in taken else (1, 0)
                taken.add(best)
            yield (row[IMAGE], row[LABEL], row[CONFIDENCE], right, wrong)

    def _overlaps(self, found: Array, true: Array) -> Array:
        """Return the overlap of each detection with each true box: (d, g); in integer pixels if sizes are known."""
        if self._sizes is None:
            return overlaps(found[:, None], true[None])
        scale = np.tile(self._sizes[self._image % len(self._sizes)], 2)
        pixel = np.array([0, 0, 1, 1], np.float32)  # a box of pixels includes its last row and column
        return overlaps(found.clip(0, 1)[:, None] * scale + pixel, true[None] * scale + pixel)

    def scorer(self) -> Scorer:
        return Scorer(self.score, frozenset({"eval_type", "ap_version", "show_per_class_result"}))

    def score(self, tops: Sequence[torch.Tensor], solver: Any = None) -> list[float]:
        """Return the mean average precision over all batches, in the version of the solver's ``ap_version``."""
        rows = np.concatenate([as_array(top).reshape(-1, 5) for top in tops])
        version = value(solver, "ap_version") if solver is not None else INTEGRAL
        counts, found = rows[rows[:, 0] == NO_IMAGE], rows[rows[:, 0] != NO_IMAGE]
        found = found[(found[:, 3] > 0) | (found[:, 4] > 0)]
        precisions = []
        for label in self.classes:
            true = counts[counts[:, LABEL] == label, CONFIDENCE].sum()
            precisions.append(average_precision(found[found[:, LABEL] == label, 2:], float(true), version))
            if solver is not None and value(solver, "show_per_class_result"):
                log.info("solver.cpp:540", f"class{label}: {log.number(precisions[-1])}")
        return [float(np.mean(precisions))]


def average_precision(found: Array, true: float, version: str = INTEGRAL) -> float:
    """Return the average precision of detections (confidence, right, wrong) for ``true`` objects.

    "11point" is the mean of the best precision at recalls of 0, 0.1, ... 1 (VOC 2007), "MaxIntegral" the area under the
    best precision at each recall or above (VOC 2012), "Integral" that under the precision itself.
    """
    if not len(found) or not true:
        return 0.0
    right, wrong = found[np.argsort(-found[:, 0], kind="stable")][:, 1:].cumsum(axis=0, dtype=np.float32).T
    precision, recall = right / (right + wrong), right / np.float32(true)
    if version == "11point":
        best = [precision[recall >= k / 10].max(initial=0) for k in range(11)]
        return _sum([share / np.float32(11) for share in reversed(best)])
    if version == "MaxIntegral":
        # The fork starts at the end, and sums in that order.
        precision, steps = np.maximum.accumulate(precision[::-1]), np.diff(recall, prepend=np.float32(0))[::-1]
        return _sum(steps * precision)
    return _sum(np.diff(recall, prepend=np.float32(0)) * precision)


def _sum(terms: Iterable[np.float32]) -> float:
    """Return the sum in float32, one term after the other, limited to 1."""
    total = np.float32(0)
    for term in terms:
        total += term
    return min(float(total), 1.0)
