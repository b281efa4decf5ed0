"""Determines the fork of a layer whose type several forks define, from properties that only one of them has."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from netspec.layers.contract.base import Layer
from netspec.proto.schema import TRAIN, given_fields, value

OTHERS = "several forks define this layer type, and the net does not show which one is meant; it is computed "


def never(layer: Layer) -> bool:
    """Return False."""
    return False


@dataclass(frozen=True)
class Fork:
    """One fork's definition of a layer type.

    ``fields`` are fields that only this fork has, in the layer (``norm_param``) or in one of its messages
    (``bn_param.bn_mode``). ``shows`` checks for anything else that only this fork's layers have. ``computes`` describes
    what the layer computes; it is "" if an earlier fork in the list computes the same.
    """

    dialect: str
    computes: str = ""
    fields: tuple[str, ...] = ()
    shows: Callable[[Layer], bool] = never

    def is_shown_by(self, layer: Layer) -> bool:
        """Return whether a layer has a property that only this fork has."""
        return any(_has(layer, field) for field in self.fields) or self.shows(layer)


@dataclass(frozen=True)
class Signature:
    """The forks that define a layer type. The first one is the default.

    ``alike`` returns whether all forks compute the same for a layer. ``advice`` is the end of the warning, if it is
    not the usual one that names dialects.
    """

    forks: tuple[Fork, ...]
    alike: Callable[[Layer], bool] = never
    advice: str = ""


def _has(layer: Layer, field: str) -> bool:
    outer, _, inner = field.partition(".")
    return outer in given_fields(layer.param) and (not inner or inner in given_fields(value(layer.param, outer)))


def _has_no_outside_weights(layer: Layer) -> bool:
    """Return whether a SmoothL1Loss has neither weights nor pixels, so that every fork divides it by N."""
    shape = layer.bottom_shapes[0]
    return len(layer.bottom_shapes) == 2 and math.prod(shape[2:]) == 1 and _has(layer, "loss_weight")


def _alpha_is_1(layer: Layer) -> bool:
    return _has(layer, "focal_loss_param.alpha") and value(layer.param, "focal_loss_param").alpha == 1


SIGNATURES = {
    "Axpy": Signature((Fork("blocks"), Fork("happynear"))),
    "BN": Signature(
        (
            Fork("blocks", "of PSPNet and TSN: the moving variance is in blobs[3]"),
            Fork("tsn"),
            Fork("segmentation", fields=("bn_param.scale_filler", "bn_param.shift_filler", "bn_param.bn_mode")),
            Fork("happynear", "of happynear, L-Softmax, domain-guided dropout: 1 / std is there"),
        ),
    ),
    "CenterLoss": Signature(
        (
            Fork("faces", "a center moves by the sum of differences / (n + 1), n the number of its class in a batch"),
            Fork("happynear", "a center moves by n times that", ("center_loss_param.distance_type",)),
        ),
        alike=lambda layer: layer.phase != TRAIN,
    ),
    "DiceCoefLoss": Signature(
        (Fork("segmentation"),),
        advice="of each image, with squares (HolmesShuan's, for real values), not of the whole batch or with sums; to "
        "have those, write the layer as docs/layer.md shows and pass --plugin FILE.py",
    ),
    "FocalLoss": Signature(
        (
            Fork(
                "happynear",
                "(alpha - p)^gamma",
                shows=lambda layer: value(layer.param, "focal_loss_param").type == 2,  # ONEADDP
            ),
            Fork("ssd"),
            Fork("rcnn", "of zimenglan, as the paper's: alpha (1 - p)^gamma"),
        ),
        alike=_alpha_is_1,
    ),
    "Normalize": Signature(
        (
            Fork("ssd", "a learned scale, the length of the whole image", ("norm_param",)),
            Fork("tsn", "no scale, the length of the whole image"),
            Fork(
                "happynear",
                "no scale, the length over the channels of each pixel",
                ("normalize_param",),
                lambda layer: layer.num_tops > 1,
            ),
        )
    ),
    "Permute": Signature((Fork("ssd"), Fork("happynear"))),
    "ROIAlign": Signature(
        (Fork("rcnn", fields=("roi_align_param.sampling_ratio", "roi_pooling_param.pad_ratio")),),
        advice="as Detectron's (the mean of a point for each pixel), not as Cascade R-CNN's (the corners of the bins) "
        "or as the largest of four points; to choose, give sampling_ratio: 0 in roi_align_param, or pad_ratio: 0 in "
        "roi_pooling_param for Cascade R-CNN's",
    ),
    "SmoothL1Loss": Signature(
        (
            Fork(
                "rcnn",
                "divided by N; only a loss_weight that is given counts",
                ("smooth_l1_loss_param",),
                lambda layer: len(layer.bottom_shapes) == 4,
            ),
            Fork("ssd", "divided by N; it counts without loss_weight too"),
            Fork("yolo"),
            Fork(
                "rfcn",
                "divided by N H W; the gradient leaves the weights out",
                ("loss_param",),
                lambda layer: layer.num_tops > 1,
            ),
        ),
        alike=_has_no_outside_weights,
    ),
    "Upsample": Signature((Fork("segmentation"), Fork("yolo"))),
}


def _shown_fork(layer: Layer) -> str:
    """Return the dialect that the net shows for this layer, or "". The last of several wins."""
    signature = SIGNATURES[layer.type]
    if shown := [fork.dialect for fork in signature.forks if fork.is_shown_by(layer)]:
        return shown[-1]
    if signature.alike(layer):
        return signature.forks[0].dialect
    used = [fork.dialect for fork in signature.forks if fork.dialect in layer.context.options.dialects]
    return used[-1] if used and has_several(layer.type) else ""


def has_several(layer_type: str) -> bool:
    """Return whether several dialects define a layer type."""
    return layer_type in SIGNATURES and len(SIGNATURES[layer_type].forks) > 1


def fork_of(layer: Layer) -> str:
    """Return the dialect of this layer: the one it shows, or one that the net uses, or the default."""
    return _shown_fork(layer) or SIGNATURES[layer.type].forks[0].dialect


def doubt(layer: Layer) -> str:
    """Return a warning, with advice, if the net does not show which fork's layer is meant; "" if it does."""
    own = type(layer).__module__.startswith(f"{__package__}.")  # not a user's layer of the same type
    if not own or layer.type not in SIGNATURES or _shown_fork(layer):
        return ""
    signature = SIGNATURES[layer.type]
    if signature.advice:
        return f"{OTHERS}{signature.advice}"
    forks = [fork for fork in signature.forks if fork.computes]
    if not forks:
        return ""
    first, *others = (f'"{fork.dialect}" ({fork.computes})' for fork in forks)
    last = forks[-1].dialect
    return (
        f"{OTHERS}as that of {first}, not of {' or '.join(others)}; to choose, write a line "
        f'"# dialect: {last}" into the prototxt, or pass --plugin {last}'
    )
