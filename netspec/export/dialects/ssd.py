"""The expressions of layers of netspec/dialects/ssd."""

from __future__ import annotations

from typing import Any

import torch

from netspec.export.exporter import exports, refusal, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats import nodes
from netspec.export.formats.torch_code import TorchCode
from netspec.proto.schema import value

CODES = {1: "corner", 2: "center", 3: "corner and size"}  # ssd.proto: enum PriorBoxParameter.CodeType


@exports("netspec.dialects.ssd.detection.DetectionOutput")
def detections(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression:
    param = value(layer.param, "detection_output_param")
    nms = param.nms_param
    if nms.eta < 1:
        raise refusal(layer, "its non-maximum suppression has a fixed threshold: eta must be 1")
    if len(bottoms) == 5:
        raise refusal(layer, "its priors are refined")
    options = {
        "classes": param.num_classes,
        "background": param.background_label_id,
        "overlap": rounded(nms.nms_threshold),
        **({"confidence": rounded(param.confidence_threshold)} if param.HasField("confidence_threshold") else {}),
        **({"candidates": nms.top_k} if nms.HasField("top_k") and nms.top_k > -1 else {}),
        **({"most": param.keep_top_k} if param.keep_top_k > -1 else {}),
        **({"kinds": layer.kinds} if layer.kinds > 1 else {}),
        **({"encoded": True} if param.variance_encoded_in_target else {}),
        **({"code": CODES[param.code_type]} if param.code_type != 2 else {}),
        **({"suppress": nodes.suppressed} if code.onnx else {}),
    }
    return call(detection_output, *bottoms[:3], **options)


@exports("netspec.dialects.ssd.priors.PriorBox")
def priors(layer: Any, code: TorchCode, x: Expression, *image: Expression) -> Expression:
    param = value(layer.param, "prior_box_param")
    fixed = None not in (*code.sizes(0)[2:], *(() if layer.image else code.sizes(1)[2:]))
    if param.denser_prior_boxes and not fixed:
        raise refusal(layer, "denser_prior_boxes is exported for maps of one size")
    if fixed and (code.onnx or param.denser_prior_boxes):
        return code.buffer(torch.from_numpy(layer.boxes))
    options = {
        "sizes": [(rounded(float(width)), rounded(float(height))) for width, height in layer.sizes],
        "variances": tuple(rounded(float(v)) for v in layer.variances),
        **({"step": layer.step} if layer.step else {}),
        **({"offset": rounded(param.offset)} if param.offset != 0.5 else {}),
        **({"clip": True} if param.clip else {}),
    }
    return call(prior_boxes, x, layer.image or image[0].shape[2:], **options)


def decode_boxes(codes, priors, code):
    """Return boxes (xmin, ymin, xmax, ymax) from codes relative to priors: corners, or center and log of the size."""
    low, high = priors.chunk(2, dim=-1)
    first, second = codes.chunk(2, dim=-1)
    extent = high - low
    if code == "center":
        center = (low + high) / 2 + first * extent
        half = second.exp() * extent / 2
        return torch.cat([center - half, center + half], dim=-1)
    scale = extent if code == "corner and size" else 1
    return torch.cat([low + first * scale, high + second * scale], dim=-1)


def suppressed(boxes, overlap):
    """Return which boxes (..., K, 4), in this order, overlap one kept before by more than a share of their union."""
    low = torch.maximum(boxes[..., :, None, :2], boxes[..., None, :, :2])
    high = torch.minimum(boxes[..., :, None, 2:], boxes[..., None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    area = (boxes[..., 2:] - boxes[..., :2]).clamp(min=0).prod(-1)
    union = area[..., :, None] + area[..., None, :] - shared
    over = (shared > overlap * union).triu(1)
    gone = torch.zeros_like(area, dtype=torch.bool)
    for k in range(boxes.shape[-2] - 1):
        gone = gone | over[..., k, :] & ~gone[..., k, None]
    return gone


def detection_output(
    loc,
    conf,
    prior,
    classes,
    background,
    overlap,
    confidence=-torch.inf,
    candidates=None,
    most=None,
    kinds=1,
    encoded=False,
    code="center",
    suppress=suppressed,
):
    """Return rows (image, label, confidence, xmin, ymin, xmax, ymax): (1, 1, D, 7).

    Of each class the boxes of highest confidence that overlap none of a higher one; where
    nothing is found, a row of -1 for each image. There are ``kinds`` boxes of each prior.
    """
    images = loc.shape[0]
    priors, variances = prior.reshape(2, 1, -1, 4)
    codes = loc.reshape(images, -1, kinds, 4).transpose(1, 2)
    codes = codes if encoded else codes * variances
    boxes = decode_boxes(codes, priors, code).expand(-1, classes, -1, -1)
    scores = conf.reshape(images, -1, classes).transpose(1, 2)
    scores, order = scores.sort(dim=2, descending=True, stable=True)
    scores, order = scores[..., :candidates], order[..., :candidates]
    boxes = boxes.gather(2, order[..., None].expand(-1, -1, -1, 4))
    label = torch.arange(classes, device=loc.device).to(loc.dtype)[:, None]
    image = torch.arange(images, device=loc.device).to(loc.dtype)[:, None, None]
    gone = suppress(boxes.flatten(0, 1), overlap).reshape(scores.shape)
    kept = (scores > confidence) & ~gone & (label != background)
    if most is not None:
        ranked = torch.where(kept, scores, -torch.inf).flatten(1)
        best = ranked.sort(dim=1, descending=True, stable=True)[1][:, :most]
        chosen = torch.zeros_like(ranked).scatter(1, best, 1.0)
        kept = kept & (chosen.reshape(kept.shape) > 0)
    head = [image.expand_as(scores), label.expand_as(scores), scores]
    found = torch.cat([torch.stack(head, -1), boxes], -1)
    nothing = torch.cat([image[:, 0], loc.new_full((images, 6), -1.0)], 1)
    rows = torch.cat([nothing, found.flatten(0, 2)])
    counted = torch.cat([(~kept.any()).expand(images), kept.flatten()])
    return rows[counted][None, None]


def prior_boxes(x, image, sizes, variances, step=None, offset=0.5, clip=False):
    """Return boxes with these sizes (width, height) around the center of every pixel of x, relative to the image.

    (1, 2, 4 H W K) for K sizes: the boxes (xmin, ymin, xmax, ymax) and their variances.
    """
    height, width = x.shape[2:]
    down, across = step or (image[0] / height, image[1] / width)
    options = {"dtype": torch.float32, "device": x.device}
    y = (torch.arange(height, **options) + offset) * down
    x = (torch.arange(width, **options) + offset) * across
    center = torch.stack(torch.broadcast_tensors(x, y[:, None]), 2)[:, :, None]
    half = torch.tensor(sizes, **options) / 2
    extent = torch.tensor([image[1], image[0]] * 2, **options)
    boxes = torch.cat([center - half, center + half], 3) / extent
    boxes = boxes.clamp(0, 1) if clip else boxes
    variance = torch.tensor(variances, device=boxes.device).expand_as(boxes)
    return torch.stack([boxes.flatten(), variance.flatten()])[None]
