"""Blobs of a net over the records of its data layer, or over image files.

Caffe: tools/extract_features.cpp does the first; the second is what its users wrote around pycaffe.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from netspec import log
from netspec.data.datum import planar
from netspec.data.transformer import read_mean
from netspec.errors import SpecError, Where, did_you_mean
from netspec.graph.filter import filter_net, with_state
from netspec.graph.prune import prune
from netspec.layers.base import TEST, Shape
from netspec.net import BuildOptions, Net, build_net
from netspec.proto.text import parse_net

Progress = Callable[[Iterable[int]], Iterable[int]]  # tqdm's form: wraps what is counted
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class ImageList:
    """Image files in order: ``paths``, the ``names`` they are known by, ``stamps`` [s] where the list has them."""

    paths: tuple[Path, ...]
    names: tuple[str, ...]
    stamps: np.ndarray | None


@dataclass(frozen=True)
class Scaling:
    """(x - mean) * scale; ``mean`` broadcasts against (C, H, W)."""

    mean: np.ndarray
    scale: float


def with_sources(net: Any, source: Any, sources: dict[str, str]) -> Any:
    """Return a copy of the net in which the named data layers read other databases (layer name -> path)."""
    changed = type(net)()
    changed.CopyFrom(net)
    for name, path in sources.items():
        layers = [layer for layer in changed.layer if layer.name == name and layer.HasField("data_param")]
        if not layers:
            readers = [layer.name for layer in net.layer if layer.HasField("data_param")]
            known = ", ".join(dict.fromkeys(readers)) or "none"
            raise SpecError(f'no data layer "{name}" to give a source to; this net\'s: {known}', Where(source.file))
        for layer in layers:
            layer.data_param.source = path
    return changed


def extract_records(
    net: Net, blobs: Sequence[str], iterations: int | None = None, progress: Progress = iter
) -> dict[str, np.ndarray]:
    """Return each blob over the records of the net's data layer, flattened to (N, D) float32.

    Beside them ``keys`` (N,), ``seconds_per_record`` (reading and the net) and ``parameters``, how many the net learns.

    ``iterations`` batches are run, by default as many as cover every record once (those read twice are dropped).
    Raises SpecError where the net reads no records or lacks a blob.
    """
    readers = [layer for layer in net.layers if getattr(layer, "num_records", 0)]
    if not readers:
        raise SpecError("no layer of this net reads records; give image files instead", Where(net.plan.source.file))
    for name in blobs:
        if name not in net.shapes:
            known = f"{did_you_mean(name, list(net.shapes)) or ';'} it has: {', '.join(net.shapes)}"
            raise SpecError(f'no blob "{name}" in this net{known}', Where(net.plan.source.file))
    reader = readers[0]
    batch = reader.top_shapes[0][0]
    records, first = reader.num_records, reader.iteration
    rounds = -(-records // batch) if iterations is None else iterations
    rows = min(records, rounds * batch) if iterations is None else rounds * batch
    net.keep = list(blobs)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in blobs}
    begin = time.perf_counter()
    with torch.no_grad():
        for _ in progress(range(rounds)):
            net()
            for name in blobs:
                value = net.blobs[name]
                if value.dim() == 0 or value.shape[0] != batch:
                    message = (
                        f'blob "{name}" has shape {tuple(value.shape)}, expected one row a record ({batch} a batch)'
                    )
                    raise SpecError(message, Where(net.plan.source.file))
                parts[name].append(value.reshape(batch, -1).cpu().numpy())
    arrays = {name: np.concatenate(part)[:rows] for name, part in parts.items()}
    arrays["seconds_per_record"] = np.array((time.perf_counter() - begin) / (rounds * batch))
    arrays["parameters"] = np.array(sum(learnable.parameter.numel() for learnable in net.learnable))
    keys = [key for i in range(first, first + rounds) for key in reader.keys(i)]
    arrays["keys"] = np.array(keys[:rows])
    return arrays


def read_image_list(path: Path) -> ImageList:
    """Return the images of a folder or of a list file.

    A folder with an ``rgb.txt`` (TUM RGB-D) gives that file's order and stamps; any other, its images in natural order
    (2 before 10). A list file has one image a line, relative to its own folder, or ``stamp image``, or ``image label``
    as Caffe's lists; the label is not used.
    """
    if path.is_dir():
        if (path / "rgb.txt").is_file():
            return read_image_list(path / "rgb.txt")
        found = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS), key=lambda p: _natural(p.name))
        if not found:
            raise SpecError("no image files in this folder", Where(str(path)))
        return ImageList(tuple(found), tuple(p.name for p in found), None)
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as fault:
        raise SpecError(f"cannot read the image list: {fault}", Where(str(path))) from None
    names, stamps = [], []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        first, _, rest = text.partition(" ")
        stamp = _as_stamp(first) if rest else None
        name = rest.strip() if stamp is not None else text
        before, _, label = name.rpartition(" ")
        if label.isdigit() and (path.parent / before).is_file():
            name = before
        if not (path.parent / name).is_file():
            raise SpecError(
                f"image {name!r} is missing in {path.parent}", Where(str(path), number, line.find(name) + 1)
            )
        names.append(name)
        stamps.append(stamp)
    if not names:
        raise SpecError("no image in this list", Where(str(path)))
    known = np.array(stamps, np.float64) if all(s is not None for s in stamps) else None
    return ImageList(tuple(path.parent / name for name in names), tuple(names), known)


def image_net(model: str, blob: str, input_blob: str, shape: Shape | None, device: torch.device) -> tuple[Net, Scaling]:
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
    built = build_net(body, body_source, BuildOptions(device, seed=0))
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


def _as_stamp(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
