"""Scales the pixels of an image for a net, and cuts the views of an image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from netspec.data.blobs import Shape
from netspec.data.mean import read_mean
from netspec.data.preprocess import Steps
from netspec.errors import SpecError, Where
from netspec.proto.schema import LayerParameter


def scaling_of(steps: Steps, layer: LayerParameter | None, shape: Shape, file: str) -> Steps:
    """Return the steps for images of ``shape`` (C, H, W): ``steps`` if there are any, else a layer's transform_param.

    ``file`` is the layer's prototxt. Raises SpecError for a mean that does not fit.
    """
    if steps:
        return replace(steps, source="from the options").fitted(shape, "the mean", Where("--mean"))
    if layer is None:
        return Steps(source="no transform_param")
    param: Any = layer.transform_param
    source = f'transform_param of layer "{layer.name}"'
    if param.mean_file:
        mean = read_mean(param.mean_file, Where(file))[: shape[0]]  # for a pair, use the mean of its first image
        return Steps(mean, param.scale, source=source).fitted(shape, param.mean_file, Where(file))
    values = np.array(param.mean_value or [0], np.float32)
    if len(values) == 2 * shape[0]:  # a pair's
        values = values[: shape[0]]
    return Steps(values, param.scale, source=source).fitted(shape, "mean_value", Where(file))


def read_zooms(zooms: str | float) -> tuple[float, ...]:
    """Return the zooms in a text such as ``"1,0.7"``: the share of the image's height and width in each view.

    Raises SpecError unless each is above 0 and at most 1.
    """
    try:
        found = tuple(float(text) for text in str(zooms).split(","))
    except ValueError:
        raise SpecError(f'found zooms "{zooms}", expected numbers separated by commas, e.g. "1,0.7"') from None
    for zoom in found:
        if not 0 < zoom <= 1:
            raise SpecError(f"found zoom {zoom:g}, expected a number above 0 and at most 1 (the whole image)")
    return found


def middle(image: np.ndarray, zoom: float) -> np.ndarray:
    """Return the center of an image, with ``zoom`` times its height and width; 1 is the whole image."""
    height, width = image.shape[:2]
    top, left = round(height * (1 - zoom) / 2), round(width * (1 - zoom) / 2)
    return image[top : max(height - top, top + 1), left : max(width - left, left + 1)]
