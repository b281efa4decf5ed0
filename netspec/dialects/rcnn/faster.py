"""The Python layers of py-faster-rcnn: images, proposals, and the targets of both heads.

A Python layer with one of these modules and classes runs without the original code. The settings are those of
experiments/cfgs/faster_rcnn_end2end.yml. A box is (x1, y1, x2, y2) in pixels, both corners included. Random numbers
come from the net, not from numpy.
Fork: rbgirshick/py-faster-rcnn, lib/rpn, lib/roi_data_layer; peteanderson80/bottom-up-attention, which has attributes
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from netspec.data.images import read_image
from netspec.dialects.boxes import Array, as_array, overlaps
from netspec.dialects.rcnn.proposals import all_anchors, base_anchors
from netspec.dialects.rcnn.smooth import four
from netspec.errors import SpecError
from netspec.files.opencv import cv2
from netspec.layers.contract.base import ALL_AXES, Layer, Shape, State
from netspec.layers.contract.data_layer import DataLayer

RATIOS, SCALES = (0.5, 1, 2), (8, 16, 32)
# The minibatch of anchors: its size, its maximum share of objects, and the overlaps of an object and of background.
ANCHORS, ANCHOR_SHARE, ANCHOR_OBJECT, ANCHOR_BACKGROUND = 256, 0.5, 0.7, 0.3
# The minibatch of regions: its size, its maximum share of objects, and the minimum overlap of an object.
REGIONS, REGION_SHARE, REGION_OBJECT = 128, 0.25, 0.5
ATTRIBUTES = 16  # number of attributes of an object (bottom-up attention)
REGIONS_WITH_ATTRIBUTES, SHARE_WITH_ATTRIBUTES = 64, 0.5  # instead of REGIONS and REGION_SHARE
DEVIATIONS = np.array([0.1, 0.1, 0.2, 0.2], np.float32)  # divisors of the classifier's targets
SHORTEST, LONGEST = 600, 1000  # short and long side of scaled images
MEANS = np.array([102.9801, 115.9465, 122.7717])  # blue, green, red


OWN_CODE = "--allow-python-layers runs the fork's own code"
_SETTING = r"""(\w+)['"]?\s*:\s*(?:[^\s\[(]*\s*[\[(]([^\])]*)[\])]|([-+.\w]+))"""  # a name; a list or a number


def settings(layer: Layer, required: str, *optional: str) -> dict[str, Any]:
    """Return the numbers and lists of numbers in ``param_str``, one per line in YAML: ``'feat_stride': 16``.

    Raises SpecError if ``required`` is missing or below 1, and for a name that is neither it nor in ``optional``.
    """
    text = layer.param.python_param.param_str
    found: dict[str, Any] = {}
    for name, listed, single in re.findall(_SETTING, text):
        numbers = [float(word) for word in re.findall(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", listed or single)]
        found[name] = numbers if listed else numbers[0] if numbers else single
    if not (isinstance(found.get(required), float) and found[required] >= 1):
        message = f"param_str has no {required} of at least 1; found {text!r}"
        raise layer.error(message, "python_param", "param_str")
    known = (required, *optional)
    if unknown := found.keys() - {*known}:
        message = f"param_str has {min(unknown)}, which is not read here; it may have {', '.join(known)}"
        raise layer.error(message, "python_param", "param_str")
    return found


def anchors_of(found: Mapping[str, Any]) -> Array:
    """Return the anchors of py-faster-rcnn, or those for the ``scales`` and ``ratios`` of a param_str."""
    return base_anchors(16, found.get("ratios", RATIOS), found.get("scales", SCALES))


def pixel_overlaps(boxes: Array, others: Array) -> Array:
    """Return the intersection over union of each of (n, 4) with each of (m, 4) in double precision: (n, m)."""
    pixel = np.array([0, 0, 1, 1], np.float64)  # a box of pixels includes its last row and column
    return overlaps(boxes[:, None] + pixel, others[None] + pixel)


def targets(boxes: Array, truth: Array) -> Array:
    """Return the offsets from each box (n, 4) to its true one (n, 4): dx, dy, log dw, log dh."""
    sizes, true_sizes = (b[:, 2:] - b[:, :2] + 1 for b in (boxes, truth))
    shift = truth[:, :2] + true_sizes / 2 - boxes[:, :2] - sizes / 2
    return np.concatenate([shift / sizes, np.log(true_sizes / sizes)], axis=1).astype(np.float32)


class _Sampling(Layer):
    """Base of layers with random choices. They have no gradient."""

    not_exported = "it is for training, and chooses at random"

    def choose(self, indices: Array, count: int) -> Array:
        """Return ``count`` of the indices, or all if they are fewer."""
        if len(indices) <= count:
            return indices
        order = torch.randperm(len(indices), generator=self.context.random.on("cpu"))
        return indices[order[:count].numpy()]

    def tops_of(self, like: torch.Tensor, arrays: Sequence[Array]) -> tuple[torch.Tensor, ...]:
        """Return the tops, and keep their shapes, which depend on the values."""
        tops = tuple(torch.from_numpy(np.ascontiguousarray(a, np.float32)).to(like) for a in arrays)
        self.top_shapes = [tuple(top.shape) for top in tops]
        return tops


class AnchorTarget(_Sampling):
    """Label the anchors that show an object, and compute the offsets from anchor to object.

    An anchor inside the image is an object if it overlaps a true box by at least 0.7, or more than all other anchors
    do. It is background if it overlaps no true box by 0.3. Of both, 256 are chosen, at most half of them objects.

    bottom[0]  scores (1, 2 A, H, W); only the shape is used
    bottom[1]  true boxes (n, 5): x1, y1, x2, y2, class
    bottom[2]  height, width and scale of the image (1, 3)
    bottom[3]  optional: the image; not used
    top[0]     labels (1, 1, A H, W): 1 object, 0 background, -1 not chosen
    top[1]     targets (1, 4 A, H, W): dx, dy, log dw, log dh
    top[2]     inside weights, the same shape: 1 for objects
    top[3]     outside weights, the same shape: 1 / the number of chosen anchors
    Fork: py-faster-rcnn, lib/rpn/anchor_target_layer.py
    """

    bottoms, tops = (3, 4), (4, 4)
    label_bottoms = frozenset(range(4))

    def setup(self) -> None:
        found = settings(self, "feat_stride", "scales", "ratios", "allowed_border")
        self.stride, self.border = int(found["feat_stride"]), found.get("allowed_border", 0)
        self.anchors = anchors_of(found)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != 4 or bottom_shapes[0][0] != 1:
            raise self.error(f"found scores of shape {bottom_shapes[0]}, expected (1, C, H, W)", "bottom", 0)
        if bottom_shapes[1][1:] not in ((4,), (5,), (5 + ATTRIBUTES,)):
            raise self.error(f"found true boxes of shape {bottom_shapes[1]}, expected (n, 5)", "bottom", 1)
        if math.prod(bottom_shapes[2]) < 2:
            raise self.error(f"found an image's sizes of shape {bottom_shapes[2]}, expected (1, 3)", "bottom", 2)
        count, (height, width) = len(self.anchors), bottom_shapes[0][2:]
        return [(1, 1, count * height, width), *[(1, 4 * count, height, width)] * 3]

    def forward(
        self, scores: torch.Tensor, boxes: torch.Tensor, image: torch.Tensor, *more: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        height, width = scores.shape[2:]
        anchors, truth, sizes = all_anchors(self.anchors, self.stride, height, width), as_array(boxes), as_array(image)
        end = sizes.reshape(-1)[[1, 0]] + self.border
        inside = np.flatnonzero((anchors[:, :2] >= -self.border).all(1) & (anchors[:, 2:] < end).all(1))
        labels, moves = np.full(len(anchors), -1), np.zeros((len(anchors), 4), np.float32)
        if len(inside) and len(truth):
            table = pixel_overlaps(anchors[inside], truth[:, :4])
            most = table.max(axis=1)
            labels[inside[most < ANCHOR_BACKGROUND]] = 0
            labels[inside[(table == table.max(axis=0)).any(axis=1) | (most >= ANCHOR_OBJECT)]] = 1
            moves[inside] = targets(anchors[inside], truth[table.argmax(axis=1), :4])
        elif len(inside):
            labels[inside] = 0
        objects = self.choose(np.flatnonzero(labels == 1), int(ANCHOR_SHARE * ANCHORS))
        others = self.choose(np.flatnonzero(labels == 0), ANCHORS - len(objects))
        labels[:] = -1
        labels[objects], labels[others] = 1, 0
        chosen = max(1, len(objects) + len(others))
        inner = np.repeat(labels[:, None] == 1, 4, axis=1)
        outer = np.repeat(labels[:, None] >= 0, 4, axis=1) / np.float32(chosen)
        by_map = [a.reshape(height, width, -1).transpose(2, 0, 1) for a in (labels, moves, inner, outer)]
        return self.tops_of(scores, [by_map[0].reshape(1, 1, -1, width), *(a[None] for a in by_map[1:])])


class ProposalTarget(_Sampling):
    """Choose regions for training, and compute their classes and the offsets from region to object.

    Chooses 128 of the proposals and true boxes: at most a quarter that overlap a true box by at least 0.5, and
    background. With num_attr_classes (bottom-up attention), 64, of which at most half are objects.

    bottom[0]  proposals (R, 5): 0, x1, y1, x2, y2
    bottom[1]  true boxes (n, 5): x1, y1, x2, y2, class; with num_attr_classes (n, 21): and 16 attributes
    top[0]     the regions (r, 5), those with an object first
    top[1]     classes (r,), 0 background
    top[2]     targets (r, 4 num_classes), divided by (0.1, 0.1, 0.2, 0.2), at the region's class
    top[3]     inside weights, the same shape: 1 there
    top[4]     outside weights, the same shape: 1 there
    top[5]     with num_attr_classes: attributes of the objects (32, 16), or ignore_label (-1)
    In R-FCN the tops have four axes, and the regions are not chosen here.
    Fork: py-faster-rcnn and bottom-up-attention, lib/rpn/proposal_target_layer.py
    """

    bottoms, tops = (2, 2), (5, 6)
    label_bottoms = frozenset({0, 1})
    counted_axis = 0

    def setup(self) -> None:
        found = settings(self, "num_classes", "num_attr_classes", "num_rel_classes", "ignore_label")
        self.classes, self.nothing = int(found["num_classes"]), float(found.get("ignore_label", -1))
        self.attributes = bool(found.get("num_attr_classes"))
        if found.get("num_rel_classes"):
            raise self.error(f"num_rel_classes is not known here; {OWN_CODE}", "python_param", "param_str")
        if self.num_tops != 5 + self.attributes:
            expected = "6, the last for attributes" if self.attributes else "5, or num_attr_classes in param_str"
            raise self.error(f"found {self.num_tops} tops, expected {expected}; {OWN_CODE}", "top")
        self.regions, share = REGIONS, REGION_SHARE
        if self.attributes:
            self.regions, share = REGIONS_WITH_ATTRIBUTES, SHARE_WITH_ATTRIBUTES
        self.objects = round(share * self.regions)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if bottom_shapes[0][1:] != (5,):
            raise self.error(f"found proposals of shape {bottom_shapes[0]}, expected (R, 5)", "bottom", 0)
        if len(bottom_shapes[1]) != 2 or bottom_shapes[1][1] not in (4, 5, self.columns):  # 4 or 5: no data yet
            raise self._wrong(bottom_shapes[1])
        tops = [(1, 5), (1,), *[(1, 4 * self.classes)] * 3, (self.objects, ATTRIBUTES)]
        return [four(top) if self.is_rfcn else top for top in tops[: self.num_tops]]

    @property
    def columns(self) -> int:
        """The number of values of a true box."""
        return 5 + ATTRIBUTES * self.attributes

    def _wrong(self, shape: Shape) -> SpecError:
        return self.error(f"found true boxes of shape {shape}, expected (n, {self.columns})", "bottom", 1)

    @property
    def is_rfcn(self) -> bool:
        """Whether the net has R-FCN's layers."""
        return "rfcn" in self.context.options.dialects

    def forward(self, proposals: torch.Tensor, boxes: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if self.is_rfcn:
            raise self.error(
                f"R-FCN's choice of regions depends on its configuration file, which netspec does not read; {OWN_CODE}"
            )
        truth = as_array(boxes)
        if truth.shape[1] != self.columns:
            raise self._wrong(truth.shape)
        own = np.concatenate([np.zeros((len(truth), 1), np.float32), truth[:, :4]], axis=1)
        regions = np.concatenate([as_array(proposals), own])
        best, which = np.zeros(len(regions)), np.zeros(len(regions), int)
        if len(truth):
            table = pixel_overlaps(regions[:, 1:], truth[:, :4])
            best, which = table.max(axis=1), table.argmax(axis=1)
        objects = self.choose(np.flatnonzero(best >= REGION_OBJECT), self.objects)
        others = self.choose(np.flatnonzero(best < REGION_OBJECT), self.regions - len(objects))
        regions, which = regions[[*objects, *others]], which[[*objects, *others]]
        labels = np.zeros(len(regions), int)
        rows = np.arange(len(objects))
        labels[rows] = truth[which[rows], 4]
        if (labels >= self.classes).any():
            raise self.error(f"found class {labels.max()}, expected less than {self.classes}", "bottom", 1)
        moves, weights = np.zeros((2, len(regions), self.classes, 4), np.float32)
        moves[rows, labels[rows]] = targets(regions[rows, 1:], truth[which[rows], :4]) / DEVIATIONS
        weights[rows, labels[rows]] = 1
        flat = [a.reshape(len(regions), -1) for a in (moves, weights, weights)]
        traits = np.full((self.objects, ATTRIBUTES), self.nothing, np.float32)
        if self.attributes:
            traits[rows] = truth[which[rows], 5:]
            traits[:, 1:][traits[:, 1:] == 0] = self.nothing  # the first stays, as in the fork
        return self.tops_of(proposals, [regions, labels, *flat, traits][: self.num_tops])


class RoIData(_Sampling, DataLayer):
    """Read images and their true boxes, one image per pass, in random order.

    The short side is scaled to 600 pixels, but the long one to at most 1000. ``net.layers[0].set_roidb(entries)`` sets
    the images. Each entry is a dict with "image" (a path), "boxes" (n, 4), "gt_classes" (n,) and, if it is mirrored,
    "flipped": True, with mirrored boxes. "gt_attributes" (n, 16) are appended to the boxes.

    top[0]     the image (1, 3, H, W): blue, green, red, minus their means
    top[1]     its height, width and scale (1, 3)
    top[2]     the true boxes (n, 5), scaled: x1, y1, x2, y2, class; (n, 21) with attributes
    Fork: py-faster-rcnn and bottom-up-attention, lib/roi_data_layer/layer.py, minibatch.py
    """

    bottoms, tops = (0, 0), (3, None)
    counted_axis = ALL_AXES  # images have different sizes

    def setup(self) -> None:
        if self.num_tops != 3:
            found = f"found {self.num_tops} tops, expected 3 (data, im_info, gt_boxes)"
            raise self.error(f"{found}: batches of Fast R-CNN's own regions are not here; {OWN_CODE}", "top")
        self.entries: Sequence[Mapping[str, Any]] = ()
        self.waiting: list[int] = []

    @property
    def code(self) -> RoIData:
        """The object that pycaffe's ``net.layers[0]`` returns; in the fork, the layer is Python code."""
        return self

    def set_roidb(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Set the images to read; see the class. Raises SpecError if an entry lacks something."""
        for i, entry in enumerate(entries):
            if missing := {"image", "boxes", "gt_classes"} - set(entry):
                raise self.error(f"entry {i} has no {' and no '.join(sorted(missing))}")
        if self.entries or max(self.waiting, default=0) >= len(entries):
            self.waiting = []  # otherwise it may be the order of a training that was resumed
        self.entries = list(entries)

    def restart(self) -> None:
        self.waiting = []

    def running_state(self) -> State:
        return {"waiting": " ".join(map(str, self.waiting))}

    def resume(self, state: Mapping[str, Any]) -> None:
        numbers = state["waiting"].split()
        if not all(number.isdecimal() and int(number) < (len(self.entries) or math.inf) for number in numbers):
            given = f"numbers below {len(self.entries)}" if self.entries else "numbers"
            raise self.error(f'found images "{state["waiting"][:40]}" to read next, expected {given}')
        self.waiting = list(map(int, numbers))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        given = self.context.options.given_shapes
        default = [(1, 3, SHORTEST, LONGEST), (1, 3), (1, 5)]
        return [given.get(name, shape) for name, shape in zip(self.param.top, default, strict=True)]

    def forward(self) -> tuple[torch.Tensor, ...]:
        if not self.entries:
            raise self.error("no images were given; call net.layers[0].set_roidb(entries)")
        if not self.waiting:
            every = np.arange(len(self.entries))
            order = torch.randperm(len(every), generator=self.context.random.on("cpu"))
            self.waiting = [int(i) for i in every[order.numpy()]]
        entry = self.entries[self.waiting.pop()]
        try:
            pixels = read_image(str(entry["image"])).transpose(1, 2, 0)
        except ValueError as fault:
            raise self.error(str(fault)) from None
        if entry.get("flipped"):
            pixels = pixels[:, ::-1]
        image, scale = scaled((pixels - MEANS).astype(np.float32))
        columns = [np.array(entry["boxes"]) * scale, np.array(entry["gt_classes"])[:, None]]
        if "gt_attributes" in entry:
            attributes = entry["gt_attributes"]
            columns.append(attributes.toarray() if hasattr(attributes, "toarray") else np.array(attributes))
        rows = np.concatenate(columns, axis=1)
        sizes = [[*image.shape[:2], scale]]
        like = torch.empty(0, device=self.context.device)
        return self.tops_of(like, [image.transpose(2, 0, 1)[None], np.array(sizes), rows[rows[:, 4] > 0]])


def scaled(image: Array) -> tuple[Array, float]:
    """Scale an image (H, W, 3) to a short side of 600 pixels, or a long side of 1000, by the exact factor; return both.

    Fork: py-faster-rcnn, lib/utils/blob.py
    """
    short, long = sorted(image.shape[:2])
    scale = SHORTEST / short
    if np.round(scale * long) > LONGEST:
        scale = LONGEST / long
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR), scale
