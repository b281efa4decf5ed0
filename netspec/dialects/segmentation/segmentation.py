"""SegNet and ENet: images with a label for each pixel, and a loss with class weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from typing_extensions import override

from netspec.data.random_words import words
from netspec.data.sources import Source
from netspec.data.transformer import contradictions
from netspec.dialects.gradients import with_gradient_of
from netspec.dialects.layers import replace
from netspec.dialects.segmentation.pairs import Array, pair_source
from netspec.errors import SpecError
from netspec.layers import register
from netspec.layers.contract.base import Shape
from netspec.layers.data.files import ReadingLayer
from netspec.layers.loss import scores as losses
from netspec.layers.loss.base import Loss
from netspec.proto.schema import value

DECLARATIONS = """
message DenseImageDataParameter {
  optional string source = 1;
  optional uint32 batch_size = 2;
  optional uint32 rand_skip = 3 [default = 0];
  optional bool shuffle = 4 [default = false];
  optional uint32 new_height = 5 [default = 0];
  optional uint32 new_width = 6 [default = 0];
  optional bool is_color = 7 [default = true];
  optional string mean_file = 8;
  optional string root_folder = 9 [default = ""];
  optional bool mirror = 10 [default = false];
  optional uint32 crop_width = 11 [default = 0];
  optional uint32 crop_height = 12 [default = 0];
  // ENet
  optional uint32 label_divide_factor = 13 [default = 1];
}
extend LossParameter {
  optional bool weight_by_label_freqs = 1003 [default = false];
  repeated float class_weighting = 1004;
}
extend LayerParameter {
  optional DenseImageDataParameter dense_image_data_param = 1180;
}
"""

GROUP = "dense_image_data_param"


@register("DenseImageData", GROUP, "transform_param", "data_param.prefetch")
class DenseImageData(ReadingLayer):
    """Read images and label images from a list, resized, mirrored and cropped in the same way, randomly in both phases.

    Labels are resized by nearest neighbor, to a size smaller by label_divide_factor, and are not changed otherwise. A
    list has lines ``image labels``.

    top[0]  transformed images (batch_size, 3 or 1, H, W)
    top[1]  labels (batch_size, 1, H, W); smaller by label_divide_factor
    Fork: TimoSaemann/caffe-enet, src/caffe/layers/dense_image_data_layer.cpp
    """

    group = GROUP
    ignores = frozenset({f"{GROUP}.mean_file"})

    def wrong_settings(self) -> Iterator[SpecError]:
        p, transform = value(self.param, GROUP), self.param.transform_param
        for names in (("new_height", "new_width"), ("crop_height", "crop_width")):
            if bool(getattr(p, names[0])) != bool(getattr(p, names[1])):
                yield self.error(f"{names[0]} and {names[1]} must be given together", GROUP)
        if p.label_divide_factor < 1 or (p.label_divide_factor > 1 and p.crop_height):
            message = "label_divide_factor must be at least 1, and 1 where images are cut"
            yield self.error(message, GROUP, "label_divide_factor")
        for name in ("mirror", "crop_size"):
            if getattr(transform, name):
                other = "mirror" if name == "mirror" else "crop_height and crop_width"
                message = f"{name} would not change the labels; give {other} in {GROUP}"
                yield self.error(message, "transform_param", name)
        yield from super().wrong_settings()
        yield from contradictions(transform, self.context.at)

    def open(self) -> Source | None:
        p, draws = value(self.param, GROUP), self.draws
        crop, mirror, less = (p.crop_height, p.crop_width), p.mirror, p.label_divide_factor

        def cut(image: Array, labels: Array, position: int) -> tuple[Array, Array]:
            mirrored, down, across, _ = words(draws.seed, f"{draws.stream}/cut", position, 1)[0].tolist()
            if mirror and mirrored % 2:
                image, labels = image[:, :, ::-1], labels[:, :, ::-1]
            if not crop[0]:
                return image, labels
            if any(size < part for size, part in zip(image.shape[1:], crop, strict=True)):
                raise SpecError(f"an image of {image.shape[1]} x {image.shape[2]} is smaller than the crop", self.where)
            top, left = down % (image.shape[1] - crop[0] + 1), across % (image.shape[2] - crop[1] + 1)
            window = (slice(None), slice(top, top + crop[0]), slice(left, left + crop[1]))
            return image[window], labels[window]

        return pair_source(self, p, cut, "dense_image_data_layer.cpp:121", lambda side: side // less)

    def known_shape(self) -> Shape | None:
        """Return the shape if the prototxt gives height and width."""
        p = value(self.param, GROUP)
        height, width = (p.crop_height, p.crop_width) if p.crop_height else (p.new_height, p.new_width)
        return (self.batch_size, 3 if p.is_color else 1, height, width) if height else None

    def second_shape(self, data: Shape) -> Shape:
        less = value(self.param, GROUP).label_divide_factor
        return (data[0], 1, *(size // less for size in data[2:]))


@replace(
    "SoftmaxWithLoss",
    "softmax_param",
    "loss_param",
    "loss_param.weight_by_label_freqs",
    "loss_param.class_weighting",
    where=lambda param: value(param.loss_param, "weight_by_label_freqs"),
)
class SoftmaxWithLoss(losses.SoftmaxWithLoss):
    """Caffe's SoftmaxWithLoss; with weight_by_label_freqs, each prediction is weighted by class_weighting[label].

    The sum is divided by the number of predictions that are not ignored, not by their weights.

    bottom[0]  scores (N, C, ...), C at softmax_param.axis
    bottom[1]  labels, one per prediction
    top[0]     the loss, ()
    top[1]     optional: the softmax, bottom[0]'s shape
    Fork: alexgkendall/caffe-segnet, src/caffe/layers/softmax_loss_layer.cpp
    """

    not_exported = "it weighs classes, for training"

    def setup(self) -> None:
        super().setup()
        self.weights = torch.tensor(list(value(self.param.loss_param, "class_weighting")))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        if len(self.weights) != self.classes:
            message = f"found {len(self.weights)} class_weighting, expected one for each of {self.classes} classes"
            raise self.error(message, "loss_param", "class_weighting")
        return shapes

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        _, label = self.scores_and_labels(scores, labels)
        self._each = self.weights.to(scores)[label.clamp(0, self.classes - 1)]
        return super().forward(scores, labels)

    @override
    def sum_up(
        self, losses: torch.Tensor, valid: torch.Tensor | None, total: Callable[[torch.Tensor], torch.Tensor]
    ) -> torch.Tensor:
        return super().sum_up(losses * self._each, valid, total)


@register("DiceCoefLoss")
class DiceCoefLoss(Loss):
    """1 minus the mean over the items of (2 x.y + 1) / (x.x + y.y + 1).

    The gradient is that of the sum. Other forks compute other values: over the whole batch, with
    sums instead of squares, or with dice_coef_loss_param, which is not supported.

    bottom[0]  x (N, ...)
    bottom[1]  y, as many
    top[0]     the loss, ()
    Fork: HolmesShuan/A-Variation-of-Dice-coefficient-Loss-Caffe-Layer, dice_coef_loss_layer.cpp
    """

    label_bottoms = frozenset()
    not_exported = "it is for training"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the scalar top; the bottoms must have equal numbers of values."""
        x, y = (torch.Size(shape) for shape in bottom_shapes)
        if x[:1] != y[:1] or x.numel() != y.numel():
            raise self.error(
                f"found bottoms of shapes {bottom_shapes}, expected as many numbers of each item", "bottom"
            )
        return [()]

    def forward(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        x, y = x.flatten(1), y.flatten(1)
        with torch.no_grad():
            below = x.square().sum(1, keepdim=True) + y.square().sum(1, keepdim=True) + 1
            ratio = (2 * (x * y).sum(1, keepdim=True) + 1) / below
            of_x, of_y = 2 / below * (x * ratio - y), 2 / below * (y * ratio - x)
        return with_gradient_of(lambda: (of_x * x + of_y * y).sum(), 1 - ratio.abs().sum() / len(x))
