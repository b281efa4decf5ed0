"""SSD's MultiBoxLoss: the prior boxes to train (matched ones and the hardest background), and their targets.

n images have p priors each; boxes are predicted in k kinds, one for all classes or one per class.
Fork: weiliu89/caffe (ssd), src/caffe/util/bbox_util.cpp: FindMatches, MineHardExamples, EncodeLocPrediction
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from netspec.dialects.boxes import (
    CENTER_SIZE,
    LEFT_OUT,
    NO_MATCH,
    Array,
    as_array,
    check_predictions,
    decode,
    encode,
    highest,
    match,
    outside,
    suppress_all,
)
from netspec.dialects.checks import check_at_least_1
from netspec.dialects.gradients import with_gradient_of
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.loss.base import BATCH_SIZE, FULL, VALID, normalization_mode
from netspec.layers.loss.scores import FLT_MIN
from netspec.proto.schema import value

# ssd.py: enums of MultiBoxLossParameter
SMOOTH_L1 = 1
SOFTMAX = 0
PER_PREDICTION = 1
NONE, MAX_NEGATIVE, HARD_EXAMPLE = 0, 1, 2


@dataclass(frozen=True)
class Truth:
    """The true boxes (g, 4) of one image and their labels (g,)."""

    boxes: Array
    labels: Array


def find_matches(
    param: Any, truth: list[Truth], priors: Array, kinds: int, decoded: Callable[[int, int], Array]
) -> tuple[Array, Array]:
    """Match the boxes of each image and kind with its true ones, like :func:`match`, but (n, k, p).

    The boxes are the priors (p, 4) or, unless use_prior_for_matching, the predictions: ``decoded(image, kind)``.
    """
    threshold = param.overlap_threshold if param.match_type == PER_PREDICTION else None
    found = np.full((len(truth), kinds, len(priors)), NO_MATCH)
    best = np.zeros(found.shape, np.float32)

    def matched(boxes: Array, true: Array) -> tuple[Array, Array]:
        leave_out = (outside(boxes) & param.ignore_cross_boundary_bbox).any(axis=1)
        return match(boxes, true, threshold, leave_out)

    for i, true in enumerate(truth):
        if not len(true.labels):
            continue
        by_prior = matched(priors, true.boxes) if param.use_prior_for_matching else None
        for kind in range(kinds):
            own = np.full(len(true.labels), True) if param.share_location else true.labels == kind
            if not own.any():
                continue
            if by_prior is None:
                index, best[i, kind] = matched(decoded(i, kind), true.boxes[own])
                found[i, kind] = np.where(index > NO_MATCH, np.flatnonzero(own)[np.maximum(index, 0)], index)
            else:
                index, best[i, kind] = by_prior
                found[i, kind] = np.where((index <= NO_MATCH) | own[np.maximum(index, 0)], index, NO_MATCH)
    return found, best


def mine(
    param: Any, truth: list[Truth], found: Array, best: Array, losses: Array, boxes: Callable[[int], Array]
) -> tuple[Array, Array]:
    """Return the matches (n, p) to keep, and which priors (n, p) to train as background.

    MAX_NEGATIVE keeps all matches, and neg_pos_ratio times as many other priors, those with the largest loss.
    HARD_EXAMPLE keeps the sample_size priors with the largest loss, matched or not. With an nms_param, priors are first
    removed if their ``boxes(image)`` overlap one with a larger loss; without its top_k, none is left, as in the fork.
    An image without a true box is not used.
    """
    kept, negative = found.copy(), np.zeros(found.shape, bool)
    for i in range(len(found)):
        if not len(truth[i].labels):
            continue
        positive = found[i] > NO_MATCH
        if param.mining_type == MAX_NEGATIVE:
            eligible = np.flatnonzero((found[i] == NO_MATCH) & (best[i] < param.neg_overlap))
            count = int(np.float32(positive.sum()) * np.float32(param.neg_pos_ratio))
        else:
            eligible, count = np.arange(found.shape[1]), param.sample_size
        loss = losses[i, eligible]
        if param.HasField("nms_param") and param.nms_param.nms_threshold > 0:
            nms = param.nms_param
            order = suppress_all(boxes(i)[eligible], loss, nms.nms_threshold, nms.top_k)[:count]
        else:
            order = highest(loss, count)
        chosen = np.zeros(found.shape[1], bool)
        chosen[eligible[order]] = True
        negative[i] = chosen & (found[i] == NO_MATCH)
        if param.mining_type == HARD_EXAMPLE:
            kept[i, positive & ~chosen] = LEFT_OUT
    return kept, negative


class MultiBoxLoss(Layer):
    """The loss of predicted boxes and confidences, with matching of priors and hard negative mining.

    The sum over the matched priors of the boxes' loss (smooth L1 or L2 to the encoded true box), times
    loc_weight, and over these and the chosen background of the confidences' loss (softmax or logistic); both divided by
    the number of matches (loss_param). A part whose propagate_down is false is left out.

    bottom[0]  predicted boxes (N, 4 P) for P priors; (N, 4 P num_classes) if share_location is false
    bottom[1]  confidences (N, P num_classes)
    bottom[2]  priors and variances (1, 2, 4 P)
    bottom[3]  true boxes, rows of 8: image in the batch (-1: none), label, instance, xmin, ymin, xmax, ymax, difficult
    top[0]     the loss, ()
    Fork: src/caffe/layers/multibox_loss_layer.cpp
    """

    bottoms = (4, 4)
    is_loss = True
    not_exported = "it is a training loss; which boxes count depends on their values"
    label_bottoms = frozenset({2, 3})

    def setup(self) -> None:
        """Check that the parameters are consistent."""
        self.settings: Any = value(self.param, "multibox_loss_param")
        p, field = self.settings, "multibox_loss_param"
        check_at_least_1(self, field, "num_classes")
        if p.background_label_id >= p.num_classes:
            message = f"background_label_id {p.background_label_id} is not one of the {p.num_classes} classes"
            raise self.error(message, field, "background_label_id")
        if p.map_object_to_agnostic and p.num_classes != 2:
            message = f"map_object_to_agnostic needs num_classes: 2, background and object; found {p.num_classes}"
            raise self.error(message, field, "num_classes")
        self.mining = p.mining_type != NONE
        if p.HasField("do_neg_mining") and p.do_neg_mining != self.mining:
            raise self.error("do_neg_mining is outdated and contradicts mining_type", field, "do_neg_mining")
        if self.mining and not p.share_location:
            raise self.error("mining needs share_location: true; or set mining_type: NONE", field, "share_location")
        if p.mining_type == HARD_EXAMPLE and p.sample_size < 1:
            raise self.error("sample_size must be at least 1", field, "sample_size")
        self.kinds = 1 if p.share_location else p.num_classes
        self.normalization = normalization_mode(self.param.loss_param, VALID)
        self.parts = list(self.param.propagate_down[:2]) or [True, True]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the scalar top; the predictions must match the priors."""
        self.priors = check_predictions(self, bottom_shapes, self.kinds, self.settings.num_classes)
        if bottom_shapes[3][-1:] != (8,):
            raise self.error(f"found true boxes of shape {bottom_shapes[3]}, expected rows of 8 numbers", "bottom", 3)
        return [()]

    def forward(self, loc: torch.Tensor, conf: torch.Tensor, prior: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return the loss; raise SpecError for an invalid true box."""
        p, images = self.settings, loc.shape[0]
        codes = loc.reshape(images, self.priors, self.kinds, 4)
        scores = conf.reshape(images, self.priors, p.num_classes)
        truth = self._read_truth(as_array(rows), images)
        priors, variances = as_array(prior).reshape(2, self.priors, 4)
        predicted = as_array(codes)

        def decoded(image: int, kind: int = 0) -> Array:
            return decode(predicted[image, :, kind], priors, self._scale(variances), p.code_type)

        found, best = find_matches(p, truth, priors, self.kinds, decoded)
        confidence_losses = self._confidence_losses(scores, *self._targets(found, truth))
        trained = np.full((images, self.priors), True)
        if self.mining:
            losses = as_array(confidence_losses).copy()
            if p.mining_type == HARD_EXAMPLE:
                box_losses = self._box_losses(codes, found, truth, priors, variances)
                losses[found[:, 0] > NO_MATCH] += as_array(box_losses.sum(1))
            boxes = decoded if not p.use_prior_for_nms else lambda image: priors
            found[:, 0], negative = mine(p, truth, found[:, 0], best[:, 0], losses, boxes)
            trained = (found[:, 0] > NO_MATCH) | negative
        loss = scores.new_zeros(())
        if self.parts[0]:
            loss = loss + p.loc_weight * self._box_losses(codes, found, truth, priors, variances).sum()
        if self.parts[1]:
            loss = loss + confidence_losses[torch.from_numpy(trained).to(scores.device)].sum()
        matches = int((found > NO_MATCH).sum())
        count = {FULL: images * self.priors, VALID: matches, BATCH_SIZE: images}.get(self.normalization, 1)
        return loss / max(1, count)

    def _scale(self, variances: Array) -> Array | None:
        """Return the variances that are part of a box's code, if any."""
        return None if self.settings.encode_variance_in_target else variances

    def _read_truth(self, rows: Array, images: int) -> list[Truth]:
        """Return the true boxes of each image, from rows of 8 as in the docstring of the class."""
        p, rows = self.settings, rows.reshape(-1, 8)
        rows = rows if p.use_difficult_gt else rows[rows[:, 7] == 0]
        number = rows[:, 0].astype(int)  # -1: a placeholder row
        found = [rows[number == i] for i in range(images)]
        truth = [Truth(of_image[:, 3:7], of_image[:, 1].astype(int)) for of_image in found]
        classes = math.inf if p.map_object_to_agnostic else p.num_classes
        for true in truth:
            wrong = (true.labels == p.background_label_id) | (true.labels < 0) | (true.labels >= classes)
            if wrong.any():
                message = (
                    f"found a true box of label {true.labels[wrong][0]}, expected 0 to {classes - 1} and not the "
                    f"background's, {p.background_label_id}"
                )
                raise self.error(message, "bottom", 3)
            empty = (true.boxes[:, 2:] <= true.boxes[:, :2]).any(axis=1)
            if p.code_type == CENTER_SIZE and empty.any():
                message = f"found the true box {true.boxes[empty][0].tolist()}, expected xmin < xmax and ymin < ymax"
                raise self.error(message, "bottom", 3)
        return truth

    def _targets(self, found: Array, truth: list[Truth]) -> tuple[Array, Array]:
        """Return each prior's label (n, p), and 1 for each of its labels, else 0 (n, p, num_classes).

        A prior without a match is background; but without mining, it has no label in the second array.
        In this case, the fork also advances the second array by p per image, not by p num_classes, so the labels of all
        images except the first are at other priors (bbox_util.cpp, the end of EncodeConfPrediction).
        """
        p = self.settings
        labels = np.full((len(truth), self.priors), p.background_label_id)
        hot = np.zeros((*labels.shape, p.num_classes), np.float32)
        if self.mining:
            hot[..., p.background_label_id] = found[:, 0] <= NO_MATCH
        for image, kind in np.ndindex(found.shape[:2]):
            matched = np.flatnonzero(found[image, kind] > NO_MATCH)
            of_box = truth[image].labels[found[image, kind, matched]]
            labels[image, matched] = p.background_label_id + 1 if p.map_object_to_agnostic else of_box
            start = image * self.priors * (p.num_classes if self.mining else 1)
            hot.reshape(-1)[start + matched * p.num_classes + labels[image, matched]] = 1
        return labels, hot

    def _confidence_losses(self, scores: torch.Tensor, labels: Array, hot: Array) -> torch.Tensor:
        """Return the loss of each prior's confidences (n, p)."""
        if self.settings.conf_loss_type == SOFTMAX:
            chosen = F.log_softmax(scores, 2).gather(2, torch.from_numpy(labels).to(scores.device)[..., None])
            return -self.arithmetic(chosen).floored(chosen.squeeze(2), math.log(FLT_MIN))
        return F.binary_cross_entropy_with_logits(scores, torch.from_numpy(hot).to(scores), reduction="none").sum(2)

    def _box_losses(
        self, codes: torch.Tensor, found: Array, truth: list[Truth], priors: Array, variances: Array
    ) -> torch.Tensor:
        """Return the losses of the matched boxes' four numbers (m, 4), by image, kind and prior."""
        p = self.settings
        image, kind, prior = np.nonzero(found > NO_MATCH)
        predicted = codes[image, prior, kind]
        first = np.cumsum([0, *(len(true.labels) for true in truth)])  # for the true boxes of each image
        boxes = np.concatenate([true.boxes for true in truth])[first[image] + found[image, kind, prior]]
        prior_boxes, prior_variances = priors[prior], variances[prior]
        scale = self._scale(prior_variances)
        target = torch.from_numpy(encode(boxes, prior_boxes, scale, p.code_type)).to(codes)
        if p.bp_inside:
            where = prior_boxes
            if not p.use_prior_for_matching:
                where = decode(as_array(predicted), prior_boxes, scale, p.code_type)
            predicted = torch.where(torch.from_numpy(outside(where)).to(codes.device), target, predicted)
        if p.encode_variance_in_target:
            # The fork divides the difference, but not its gradient.
            divisor = torch.from_numpy(prior_variances).to(codes)
            given, target = predicted, target / divisor
            predicted = with_gradient_of(lambda: given, given / divisor)
        if p.loc_loss_type == SMOOTH_L1:
            return F.smooth_l1_loss(predicted, target, reduction="none")
        return (predicted - target).square() / 2
