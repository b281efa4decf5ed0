"""Whose a layer is if several forks have its type: what only one of them has shows it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from netspec.errors import SpecError
from netspec.proto.schema import TRAIN, LayerParameter, given_fields, value

Names = tuple[str, ...]
Shows = Callable[[LayerParameter], bool]


def never(layer: LayerParameter) -> bool:
    """Return False."""
    return False


@dataclass(frozen=True)
class Fork:
    """What a layer type computes in some forks. They are called by the first of their names.

    ``fields`` are fields that only they have, in the layer (``norm_param``) or in one of its messages
    (``bn_param.bn_mode``). ``shows`` checks for anything else that only their layers have.
    """

    dialects: Names
    computes: str = ""
    fields: Names = ()
    shows: Shows = never

    def is_shown_by(self, layer: LayerParameter) -> bool:
        """Return whether a layer has what only these forks have."""
        return any(_has(layer, field) for field in self.fields) or self.shows(layer)


@dataclass(frozen=True)
class Signature:
    """What the forks compute that define a layer type. The first is the default.

    ``alike`` returns whether they compute the same for a layer. ``advice`` is the end of the warning about what is
    not here.
    """

    forks: tuple[Fork, ...]
    alike: Shows = never
    advice: str = ""


def _has(layer: LayerParameter, field: str) -> bool:
    outer, _, inner = field.partition(".")
    return outer in given_fields(layer) and (not inner or inner in given_fields(value(layer, outer)))


SIGNATURES = {
    "Axpy": Signature((Fork(("blocks", "happynear")),)),
    "BN": Signature(
        (
            Fork(("blocks", "tsn"), "of PSPNet and TSN: the moving variance is in blobs[3]"),
            Fork(
                ("segmentation",),
                "of SegNet: no moving averages",
                ("bn_param.scale_filler", "bn_param.shift_filler", "bn_param.bn_mode"),
            ),
            Fork(("happynear",), "of happynear, L-Softmax, domain-guided dropout: 1 / std is there"),
        ),
    ),
    "CenterLoss": Signature(
        (
            Fork(
                ("faces",), "a center moves by the sum of differences / (n + 1), n the number of its class in a batch"
            ),
            Fork(("happynear",), "a center moves by n times that", ("center_loss_param.distance_type",)),
        ),
        alike=lambda layer: layer.phase != TRAIN,
    ),
    "DiceCoefLoss": Signature(
        (Fork(("segmentation",)),),
        advice="of each image, with squares (HolmesShuan's, for real values), not of the whole batch or with sums; to "
        "have those, write the layer as docs/layer.md shows and pass --plugin FILE.py",
    ),
    "FocalLoss": Signature(
        (
            Fork(
                ("happynear", "ssd"),
                "(alpha - p)^gamma",
                shows=lambda layer: value(layer, "focal_loss_param").type == 2,  # ONEADDP
            ),
            Fork(("rcnn",), "of zimenglan, as the paper's: alpha (1 - p)^gamma"),
        ),
        alike=lambda layer: _has(layer, "focal_loss_param.alpha") and value(layer, "focal_loss_param").alpha == 1,
    ),
    "Normalize": Signature(
        (
            Fork(("ssd",), "a learned scale, the length of the whole image", ("norm_param",)),
            Fork(("tsn",), "no scale, the length of the whole image"),
            Fork(
                ("happynear",),
                "no scale, the length over the channels of each pixel",
                ("normalize_param",),
                lambda layer: len(layer.top) > 1,
            ),
        )
    ),
    "Permute": Signature((Fork(("ssd", "happynear")),)),
    "ROIAlign": Signature(
        (Fork(("rcnn",), fields=("roi_align_param.sampling_ratio", "roi_pooling_param.pad_ratio")),),
        advice="as Detectron's (the mean of a point for each pixel), not as Cascade R-CNN's (the corners of the bins) "
        "or as the largest of four points; to choose, give sampling_ratio: 0 in roi_align_param, or pad_ratio: 0 in "
        "roi_pooling_param for Cascade R-CNN's",
    ),
    "SmoothL1Loss": Signature(
        (
            Fork(
                ("rcnn",),
                "divided by N; only a loss_weight that is given counts",
                ("smooth_l1_loss_param",),
                lambda layer: len(layer.bottom) == 4,
            ),
            Fork(("ssd", "yolo"), "divided by N; it counts without loss_weight too"),
            Fork(
                ("rfcn",),
                "divided by N H W; the gradient leaves the weights out",
                ("loss_param",),
                lambda layer: len(layer.top) > 1,
            ),
        ),
    ),
    "Upsample": Signature((Fork(("segmentation", "yolo")),)),
}


def has_several(layer_type: str) -> bool:
    """Return whether several dialects are known to define a layer type."""
    return layer_type in SIGNATURES and sum(len(fork.dialects) for fork in SIGNATURES[layer_type].forks) > 1


def chosen(layer_type: str, candidates: Sequence[Names], shown: Sequence[Collection[str]]) -> Names | None:
    """Return the candidate, forks that are alike, that a net shows, or the only one; None if it is not clear.

    ``shown`` are dialects that a net shows, the strongest first. Raises SpecError if they show several candidates.
    """
    for dialects in shown:
        found = [names for names in candidates if {*names} & {*dialects}]
        if len(found) == 1:
            return found[0]
        if found:
            raise _conflict(layer_type, found)
    return candidates[0] if len(candidates) == 1 else None


def _conflict(layer_type: str, candidates: Sequence[Names]) -> SpecError:
    names = [names[0] for names in candidates]
    found = " and ".join(f'"{name}"' for name in names)
    advice = f'name one of them, and only one, by a line "# dialect: {names[0]}" in the prototxt'
    return SpecError(f'this net shows {found}, which have different layers of type "{layer_type}"; {advice}')


def fork_of(layer: LayerParameter, shown: Sequence[Collection[str]]) -> tuple[str, str]:
    """Return the fork of a layer of one of these types, and a warning, "" if the net shows the fork.

    The layer itself decides, then what the net shows (see :func:`chosen`). Raises SpecError if it shows two forks.
    """
    signature = SIGNATURES[layer.type]
    own = [fork.dialects for fork in signature.forks if fork.is_shown_by(layer)]
    found = own[0] if len(own) == 1 else chosen(layer.type, own or [fork.dialects for fork in signature.forks], shown)
    if own and not found:
        raise _conflict(layer.type, own)
    default, last = signature.forks[0].dialects[0], signature.forks[-1].dialects[0]
    if found and (own or not signature.advice):
        return found[0], ""
    if signature.alike(layer):
        return default, ""
    advice = signature.advice
    if not advice:
        first, *others = (f'"{fork.dialects[0]}" ({fork.computes})' for fork in signature.forks)
        advice = f"as that of {first}, not of {' or '.join(others)}; to choose, write a line "
        advice += f'"# dialect: {last}" into the prototxt, or pass --plugin {last}'
    return default, f"several forks define this layer type, and the net does not show which is meant; computed {advice}"
