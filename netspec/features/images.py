"""A blob of a net over image files: what Caffe's users wrote around pycaffe. The file it makes: docs/features.md."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from netspec import log
from netspec.data.blobs import Shape
from netspec.data.datum import planar
from netspec.data.mean import read_mean
from netspec.errors import SpecError, Where
from netspec.exact import SMALL
from netspec.features.image_list import ImageList
from netspec.features.records import Progress
from netspec.graph.filter import filter_net, with_state
from netspec.graph.prune import prune
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.options import BuildOptions
from netspec.proto.schema import TEST
from netspec.proto.text import parse_net


@dataclass(frozen=True)
class Scaling:
    """(x - mean) * scale; ``mean`` broadcasts against (C, H, W)."""

    mean: np.ndarray
    scale: float


def image_net(
    model: str, blob: str, input_blob: str, shape: Shape | None, device: torch.device, exact: str = SMALL
) -> tuple[Net, Scaling]:
    """Return the part of a net that computes ``blob`` from ``input_blob``, and what its data layer does to pixels.

    ``shape`` (N, C, H, W) of the input is read off the net where it is None: from its Input layer, or from the first
    record of its data layer.
    """
    net, source = parse_net(model)
    net, source = filter_net(with_state(net, TEST), source)
    if shape is None:
        head, head_source = prune(net, source, [input_blob], {})
        probe = build_net(head, head_source, BuildOptions(torch.device("meta"), seed=0))
        shape = probe.shapes[input_blob]
        probe.close()
    if len(shape) != 4 or shape[1] not in (1, 3):
        message = f'input blob "{input_blob}" has shape {tuple(shape)}, expected N x 1 or 3 x H x W for images'
        raise SpecError(message, Where(source.file))
    readers = [layer for layer in net.layer if layer.HasField("transform_param")]
    body, body_source = prune(net, source, [blob], {input_blob: shape})
    built = build_net(body, body_source, BuildOptions(device, seed=0, exact=exact))
    if not readers:
        log.warning("extract.py:1", f"{model} has no data layer with a transform_param: images go in as 0 to 255")
    return built, _scaling(readers[0], shape, source.file) if readers else Scaling(np.zeros(1, np.float32), 1.0)


def extract_images(
    net: Net,
    scaling: Scaling,
    blob: str,
    images: ImageList,
    batch: int = 16,
    progress: Progress = iter,
    zooms: Sequence[float] = (),
) -> dict[str, np.ndarray]:
    """Return ``features`` (N, D) float32, ``names`` (N,), ``stamps`` (N,) [s] where known, ``seconds_per_image`` ().

    The seconds are the whole way from file to feature: reading, resizing, the net. With ``zooms`` each image has as
    many views, all of one size for the net: for 0.7, what is in the middle 0.7 of its width and height, as a camera
    further ahead would see it. ``features`` are then (N, V D), view after view, and ``zooms`` (V,) is there too.
    """
    views = check_zooms(zooms)
    (name,) = net.inputs
    shape = net.shapes[name][1:]
    net.keep = [blob]
    parts = []
    begin = time.perf_counter()
    with torch.no_grad():
        for start in progress(range(0, len(images.paths), batch)):
            read = [_read(path, shape[0]) for path in images.paths[start : start + batch]]
            stack = [fitted(middle(image, zoom), shape) for image in read for zoom in views]
            net(**{name: (np.stack(stack) - scaling.mean) * scaling.scale})
            parts.append(net.blobs[blob].reshape(len(read), -1).cpu().numpy())
    seconds = (time.perf_counter() - begin) / len(images.paths)
    arrays = {
        "features": np.concatenate(parts),
        "names": np.array(images.names),
        "seconds_per_image": np.array(seconds),
    }
    if images.stamps is not None:
        arrays["stamps"] = images.stamps
    if zooms:
        arrays["zooms"] = np.array(views)
    return arrays


def check_zooms(zooms: Sequence[float]) -> tuple[float, ...]:
    """Return the zooms, 1 where there are none; refuse any that is not more than 0 and at most 1."""
    for zoom in zooms:
        if not 0 < zoom <= 1:
            raise SpecError(f"found zoom {zoom:g}, expected more than 0 and at most 1, the whole image")
    return tuple(zooms) or (1.0,)


def middle(image: np.ndarray, zoom: float) -> np.ndarray:
    """Return the middle ``zoom`` of an image's height and width; 1 is all of it."""
    height, width = image.shape[:2]
    top, left = round(height * (1 - zoom) / 2), round(width * (1 - zoom) / 2)
    return image[top : max(height - top, top + 1), left : max(width - left, left + 1)]


def _scaling(layer: Any, shape: Shape, file: str) -> Scaling:
    """Return a transform_param's mean and scale for one image of ``shape`` (N, C, H, W).

    A pair's mean has the channels of both images: the first image's count. A mean image larger than the blob is cut at
    its centre, as Caffe cuts it with the image in phase TEST.
    """
    param = layer.transform_param
    _, channels, height, width = shape
    if param.mean_file:
        mean = read_mean(param.mean_file, Where(file))[:channels]
        top, left = (mean.shape[1] - height) // 2, (mean.shape[2] - width) // 2
        if mean.shape[0] != channels or min(top, left) < 0:
            message = f"the mean of {param.mean_file} is {mean.shape}, expected at least {tuple(shape[1:])}"
            raise SpecError(message, Where(file))
        return Scaling(mean[:, top : top + height, left : left + width], param.scale)
    values = np.array(param.mean_value or [0], np.float32)
    if len(values) not in (1, channels, 2 * channels):
        raise SpecError(f"found {len(values)} mean_value for images of {channels} channels", Where(file))
    return Scaling(values[:channels, None, None], param.scale)


def _read(path: Path, channels: int) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR if channels == 3 else cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SpecError("cannot read this image", Where(str(path)))
    return image


def fitted(image: np.ndarray, shape: Shape) -> np.ndarray:
    """Return an image (H, W, 3) BGR or (H, W), uint8, as ``shape`` (C, H, W): resized (bilinear), in colour or grey."""
    channels, height, width = shape
    if channels == 3 and image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    elif channels == 1 and image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if image.shape[:2] != (height, width):
        image = cv2.resize(image, (width, height))
    return planar(image)
