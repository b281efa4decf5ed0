"""The loss of YOLO v2, as Darknet's region layer has it.

Fork: eric612/MobileNet-YOLO, src/caffe/layers/region_loss_layer.cpp
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from netspec.dialects.boxes import Array, around, as_array, overlaps, sigmoid
from netspec.layers.contract.base import Shape
from netspec.layers.loss.base import Loss
from netspec.proto.schema import value

GROUP = "region_loss_param"
OBJECT, CLASSES = 4, 5  # where they begin among the numbers of a box; x, y, width and height are before them


class RegionLoss(Loss):
    """The sum of squares of what each number of YOLO's boxes is to be moved by, divided by N.

    A box that overlaps a true one by more than ``thresh`` may have any objectness, others shall have 0. Of the anchors
    (``biases``, in cells) in a true box's cell the one most like it in shape shall have its place, size and class, and
    an objectness of 1, with ``rescore`` of its overlap. The moves, divided by N, are the gradient, as in Darknet: that
    is half the derivative of the loss for some numbers, and for others another.

    bottom[0]  (N, num (5 + num_class), S, S): x, y, width, height, objectness, classes of each anchor
    bottom[1]  true boxes (N, 1, n, 5): class from 0, x, y, width, height, parts of the image; zeros end them
    top[0]     the loss, ()
    Fork: eric612/MobileNet-YOLO, src/caffe/layers/region_loss_layer.cpp
    """

    not_exported = "it is for training"

    def setup(self) -> None:
        self.settings = param = value(self.param, GROUP)
        if len(param.biases) != 2 * param.num or param.coords != OBJECT:
            message = f"expected a pair of biases for each of num {param.num}, and coords 4"
            raise self.error(f"{message}; found {len(param.biases)} and coords {param.coords}", GROUP, "biases")
        if param.softmax_tree or param.class_map:
            raise self.error("a tree or map of classes is not known here", GROUP, "softmax_tree")
        self.anchors = np.array(param.biases, np.float32).reshape(-1, 2)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape; the map must be square, with the channels of its boxes."""
        maps, truth = bottom_shapes
        channels = self.settings.num * (CLASSES + self.settings.num_class)
        if len(maps) != 4 or maps[1] != channels or maps[2] != maps[3]:
            raise self.error(f"found a map of shape {maps}, expected (N, {channels}, S, S)", "bottom", 0)
        if truth[:1] != maps[:1] or truth[-1:] != (5,):
            raise self.error(f"found true boxes of shape {truth}, expected ({maps[0]}, 1, n, 5)", "bottom", 1)
        return [()]

    def forward(self, maps: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        items, side = maps.shape[0], maps.shape[2]
        cells = as_array(maps).reshape(items, self.settings.num, -1, side, side)
        boxes = as_array(truth).reshape(items, -1, 5)
        moves = np.stack([self._moves(*each) for each in zip(cells, boxes, strict=True)])
        return _Moved.apply(maps, torch.from_numpy(moves.reshape(maps.shape)).to(maps))

    def _moves(self, cells: Array, truth: Array) -> Array:
        """Return what the numbers (num, 5 + num_class, S, S) of an image are to be moved by, in the opposite direction.

        Later true boxes replace what earlier ones said of the same anchor.
        """
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
        known = truth[: int(np.argmin(np.append(truth[:, 1] != 0, False)))]
        if len(known):
            best = overlaps(found[..., None, :], around(known[:, 1:3], known[:, 3:5])).max(axis=-1)
            moves[:, OBJECT][best > np.float32(p.thresh)] = 0
        for label, *place in truth[: int(np.argmin(np.append(truth[:, 3] != 0, False)))]:
            center, extent = np.array(place[:2], np.float32), np.array(place[2:], np.float32)
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


class _Moved(torch.autograd.Function):
    """The sum of the squares of moves / N; its gradient is the moves / N, as in the fork, not their derivative."""

    @staticmethod
    def forward(ctx: Any, maps: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(moves)
        return moves.square().sum() / len(maps)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        (moves,) = ctx.saved_tensors
        return moves * (grads[0] / len(moves)), None
