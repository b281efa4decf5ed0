"""The losses of YOLO v2 and v3, as in Darknet's region and yolo layers.

Fork: eric612/MobileNet-YOLO, src/caffe/layers/region_loss_layer.cpp, yolov3_layer.cpp
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from typing_extensions import override

from netspec.dialects.boxes import Array, around, as_array, overlaps, sigmoid
from netspec.dialects.gradients import with_gradient_of
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.loss.base import Loss
from netspec.proto.schema import value

MSE = 2  # Yolov3Parameter.IOU_LOSS
OBJECT, CLASSES = 4, 5  # their index in a box; x, y, width and height come before


def read_anchors(layer: Layer, group: str) -> Array:
    """Return the sizes of the prior boxes (n, 2), the ``biases`` of a layer. Raises SpecError."""
    biases = value(layer.param, group).biases
    if len(biases) % 2 or not biases:
        raise layer.error(f"found {len(biases)} biases, expected pairs of width and height", group, "biases")
    return np.array(biases, np.float32).reshape(-1, 2)


class _DarknetLoss(Loss):
    """Base of the losses. ``_moves`` returns the desired change of each value of a map."""

    group: str
    not_exported = "it is for training"

    def setup(self) -> None:
        self.settings = value(self.param, self.group)
        self.anchors = read_anchors(self, self.group)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the scalar top; the map must have the channels of its boxes."""
        maps, truth = bottom_shapes
        channels = self.settings.num * (CLASSES + self.settings.num_class)
        if len(maps) != 4 or maps[1] != channels or not maps[0]:
            raise self.error(f"found a map of shape {maps}, expected (N, {channels}, S, S)", "bottom", 0)
        if truth[:1] != maps[:1] or truth[-1:] != (5,):
            raise self.error(f"found true boxes of shape {truth}, expected ({maps[0]}, 1, n, 5)", "bottom", 1)
        return [()]

    def forward(self, maps: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        items, height, width = (maps.shape[i] for i in (0, 2, 3))
        cells = as_array(maps).reshape(items, self.settings.num, -1, height, width)
        boxes = as_array(truth).reshape(items, -1, 5)
        first = np.concatenate([each[: _until(each[:, 3]), :3] for each in boxes])
        if len(wrong := first[~((first >= 0) & (first < (self.settings.num_class, 1, 1))).all(axis=1)]):
            found = "found a true box of class {:g} at {:g}, {:g}".format(*wrong[0])
            fault = f"{found}; expected a class below {self.settings.num_class} and a center from 0 to below 1"
            raise self.error(fault, "bottom", 1)
        moves = np.stack([self._moves(*each) for each in zip(cells, boxes, strict=True)])
        diff = self._gradient(moves, cells)
        moves, diff = (torch.from_numpy(each.reshape(maps.shape)).to(maps) for each in (moves, diff))
        return with_gradient_of(lambda: (maps * diff).sum() / items, moves.square().sum() / items)

    def _moves(self, cells: Array, truth: Array) -> Array:
        """Return the negative of the desired changes of the values (num, 5 + num_class, H, W) of an image.

        Later true boxes override earlier ones at the same anchor.
        """
        raise NotImplementedError

    def _gradient(self, moves: Array, cells: Array) -> Array:
        """Return the gradient of the loss, times N, of the numbers (N, num, 5 + num_class, H, W)."""
        return moves


def _until(column: Array) -> int:
    """Return the number of values before the first 0."""
    return int(np.argmin(np.append(column != 0, False)))


class RegionLoss(_DarknetLoss):
    """The sum of squares of the desired changes of the values of YOLO's boxes, divided by N.

    The objectness of a box that overlaps a true one by more than ``thresh`` is free; for others, it should be 0. Of the
    anchors (``biases``, in cells) in a true box's cell, the one with the most similar shape should have its position,
    size and class, and an objectness of 1, or of its overlap with ``rescore``. The changes, divided by N, are the
    gradient, as in Darknet. For some values this is half the derivative of the loss, and for others it differs.

    bottom[0]  (N, num (5 + num_class), S, S): x, y, width, height, objectness, classes of each anchor
    bottom[1]  true boxes (N, 1, n, 5): class from 0, x, y, width, height, relative to the image; zeros end them
    top[0]     the loss, ()
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/region_loss_layer.cpp
    """

    group = "region_loss_param"

    def setup(self) -> None:
        super().setup()
        param = self.settings
        if len(self.anchors) != param.num or param.coords != OBJECT:
            message = f"expected a pair of biases for each of num {param.num}, and coords 4"
            found = f"found {len(param.biases)} and coords {param.coords}"
            raise self.error(f"{message}; {found}", self.group, "biases")
        if param.softmax_tree or param.class_map:
            raise self.error("a tree or map of classes is not known here", self.group, "softmax_tree")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the scalar top; the map must be square."""
        shapes = super().reshape(bottom_shapes)
        if bottom_shapes[0][2] != bottom_shapes[0][3]:
            raise self.error(f"found a map of shape {bottom_shapes[0]}, expected a square one", "bottom", 0)
        return shapes

    @override
    def _moves(self, cells: Array, truth: Array) -> Array:
        p, side = self.settings, np.float32(cells.shape[2])
        shares = np.exp(cells[:, CLASSES:] - cells[:, CLASSES:].max(axis=1, keepdims=True))
        shares /= shares.sum(axis=1, keepdims=True)
        objects = sigmoid(cells[:, OBJECT])
        moves = np.zeros_like(cells)
        moves[:, OBJECT] = np.float32(p.noobject_scale) * objects * objects * (1 - objects)
        y, x = np.mgrid[: cells.shape[2], : cells.shape[3]].astype(np.float32)
        centers = np.stack([x + sigmoid(cells[:, 0]), y + sigmoid(cells[:, 1])], axis=-1) / side
        extents = np.exp(cells[:, 2:4].transpose(0, 2, 3, 1)) * self.anchors[:, None, None] / side
        found = around(centers, extents)
        known = truth[: _until(truth[:, 1])]
        if len(known):
            best = overlaps(found[..., None, :], around(known[:, 1:3], known[:, 3:5])).max(axis=-1)
            moves[:, OBJECT][best > np.float32(p.thresh)] = 0
        for label, *box in truth[: _until(truth[:, 3])]:
            center, extent = np.array(box[:2], np.float32), np.array(box[2:], np.float32)
            column, row = (center * side).astype(int)
            like = self.anchors / side if p.bias_match else extents[:, row, column]
            zero = np.zeros_like(like)
            n = int(overlaps(around(zero, like), around(zero[:1], extent[None])).argmax())
            at = (n, slice(None), row, column)
            number, move = cells[at], moves[at]
            overlap = overlaps(found[n, row, column], around(center, extent))
            scale = np.float32(p.coord_scale * (1 if p.rescore else 2 - extent.prod()))
            inside = sigmoid(number[:2])
            move[:2] = -scale * (center * side - [column, row] - inside) * inside * (1 - inside)
            move[2:4] = -scale * (np.log(extent * side / self.anchors[n]) - number[2:4])
            goal, o = overlap if p.rescore else 1, objects[n, row, column]
            move[OBJECT] = -np.float32(p.object_scale) * (goal - o) * o * (1 - o)
            move[CLASSES:] = np.float32(p.class_scale) * (shares[at] - (np.arange(p.num_class) == int(label)))
        return moves


class Yolov3(_DarknetLoss):
    """The sum of squares of the desired changes of the values of YOLO v3's boxes, divided by N.

    The objectness of a box that overlaps a true one by more than ``thresh`` is free; for others, it should be 0. The
    anchor (``biases``, in pixels of an image of anchors_scale times the map's size) with the shape most similar to a
    true box should have its position, size and class, and an objectness of 1, if it is in ``mask``. So should other
    anchors in ``mask`` that overlap its shape by more than iou_thresh. The target of the class is 1 and that of others
    0, both moved toward 0.5 by label_smooth_eps. The changes, divided by N, are the gradient; with use_logic_gradient,
    they are multiplied by the derivative of the sigmoid. As in the fork, noobject_scale is not used, and object_scale
    only with use_logic_gradient. An iou_loss other than MSE is not supported.

    bottom[0]  (N, num (5 + num_class), H, W): x, y, width, height, objectness, classes of each anchor
    bottom[1]  true boxes (N, 1, n, 5): class from 0, x, y, width, height, relative to the image; zeros end them
    top[0]     the loss, ()
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/yolov3_layer.cpp
    """

    group = "yolov3_param"

    def setup(self) -> None:
        super().setup()
        p = self.settings
        if p.iou_loss != MSE:
            raise self.error("only iou_loss: MSE is known", self.group, "iou_loss")
        if len(p.mask) < p.num or max(p.mask[: p.num], default=0) >= len(self.anchors):
            expected = f"num {p.num} numbers below {len(self.anchors)}, the pairs of biases"
            raise self.error(f"found mask {list(p.mask)}, expected {expected}", self.group, "mask")
        self.mask = list(p.mask)[: p.num]

    @override
    def _moves(self, cells: Array, truth: Array) -> Array:
        p, map_size = self.settings, np.array(cells.shape[:1:-1], np.float32)
        image = map_size * np.float32(p.anchors_scale)
        shares = sigmoid(cells)
        moves = np.zeros_like(cells)
        moves[:, OBJECT] = shares[:, OBJECT]
        y, x = np.mgrid[: cells.shape[2], : cells.shape[3]].astype(np.float32)
        centers = (np.stack([x, y], axis=-1) + shares[:, :2].transpose(0, 2, 3, 1)) / map_size
        extents = np.exp(cells[:, 2:4].transpose(0, 2, 3, 1)) * self.anchors[self.mask][:, None, None] / image
        known = truth[: _until(truth[:, 1])]
        if len(known):
            found = around(centers, extents)[..., None, :]
            best = overlaps(found, around(known[:, 1:3], known[:, 3:5])).max(axis=-1)
            moves[:, OBJECT][best > np.float32(p.thresh)] = 0
        zero = np.zeros_like(self.anchors)
        for label, *box in truth[: _until(truth[:, 3])]:
            extent = np.array(box[2:], np.float32)
            like = overlaps(around(zero, self.anchors / image), around(zero[:1], extent[None]))
            for n in self._like(like):
                self._move(moves, cells, shares, n, int(label), np.array(box, np.float32))
        return moves

    def _like(self, like: Array) -> list[int]:
        """Return which anchors of ``mask`` a true box is for. Like the fork, leave out the index of the best one."""
        best = int(like.argmax()) if like.max() > 0 else -1
        first = [self.mask.index(best)] if best in self.mask else []
        left_out = first[0] if first else best
        if self.settings.iou_thresh >= 1:
            return first
        near = np.flatnonzero(like > np.float32(self.settings.iou_thresh)).tolist()
        return first + [self.mask.index(n) for n in near if n in self.mask and n != left_out]

    def _move(self, moves: Array, cells: Array, shares: Array, n: int, label: int, box: Array) -> None:
        """Set the desired values of anchor ``n`` of the mask in the cell of a true box."""
        p, map_size = self.settings, np.array(cells.shape[:1:-1], np.float32)
        column, row = (box[:2] * map_size).astype(int)
        at = (n, slice(None), row, column)
        number, share, move = cells[at], shares[at], moves[at]
        scale = np.float32(p.coord_scale * (2 - box[2] * box[3]))
        goal = np.log(box[2:] * map_size * np.float32(p.anchors_scale) / self.anchors[self.mask[n]])
        move[:2] = -scale * (box[:2] * map_size - [column, row] - share[:2])
        move[2:4] = -scale * (goal - number[2:4])
        move[OBJECT] = -(1 - share[OBJECT]) * np.float32(p.object_scale if p.use_logic_gradient else 1)
        wanted, classes, eps = np.zeros(p.num_class, np.float32), share[CLASSES:], p.label_smooth_eps
        wanted[label] = 1
        if move[CLASSES + label]:  # an earlier true box had this anchor: its class is kept, too
            step = p.class_scale * ((1 - eps) + eps / 2 - classes[label])
            move[CLASSES + label] = -step
        elif p.use_focal_loss:
            sure = classes[label] + np.float32(1e-15)
            focus = -(1 - sure) * (2 * sure * np.log(sure) + sure - 1) / 2
            move[CLASSES:] = -np.float32(p.class_scale) * (wanted - classes) * focus
        else:
            move[CLASSES:] = -np.float32(p.class_scale) * (wanted * (1 - eps) + eps / 2 - classes)

    @override
    def _gradient(self, moves: Array, cells: Array) -> Array:
        if not self.settings.use_logic_gradient:
            return moves
        share = sigmoid(cells)
        slope = share * (1 - share)
        slope[:, :, 2:4] = 1
        return moves * slope
