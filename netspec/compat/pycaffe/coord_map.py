"""Maps coordinates of one blob to another: how to crop a map so that it fits the image that it was computed from.

A mapping is (axis, scale, shift), from a layer's bottom to its top: top coordinate = scale * bottom coordinate + shift,
along the axes after ``axis``; (None, 1, 0) is the identity. Blobs are Tops of a NetSpec.
Caffe: python/caffe/coord_map.py
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netspec.compat.pycaffe.net_spec import Function, Top, layers
from netspec.graph.coordinates import PASS_THROUGH_LAYERS, inverted, of_windows

Mapping = tuple[Any, Any, Any]

IDENTITY: Mapping = (None, 1, 0)
_TWO_DIMENSIONAL = frozenset(f"{what}_{axis}" for what in ("kernel", "stride", "pad") for axis in "hw")


class UndefinedMapException(Exception):
    """The layer has no linear mapping of coordinates."""


class AxisMismatchException(Exception):
    """Two mappings have different axes."""


def conv_params(fn: Function) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Return (axis, stride, extent of the dilated kernel, pad) of a layer; each has one entry, or one for each axis.

    Raises AssertionError for fields such as kernel_h, which are not supported.
    """
    given = fn.params.get("convolution_param", fn.params)
    assert not _TWO_DIMENSIONAL & set(fn.params), "cropping does not support legacy _h/_w params"
    kernel, dilation = _vector(given["kernel_size"]), _vector(given.get("dilation", 1))
    extent = (kernel - 1) * dilation + 1
    return given.get("axis", 1), _vector(given.get("stride", 1)), extent, _vector(given.get("pad", 0))


def crop_params(fn: Function) -> tuple[int, np.ndarray]:
    """Return (axis, offset) of a Crop layer."""
    given = fn.params.get("crop_param", fn.params)
    return given.get("axis", 2), _vector(given.get("offset", 0))


def coord_map(fn: Function) -> Mapping:
    """Return the mapping of a layer. Raises UndefinedMapException if it has none."""
    if fn.type_name in PASS_THROUGH_LAYERS:
        return IDENTITY
    if fn.type_name == "Crop":
        axis, offset = crop_params(fn)
        return axis - 1, 1, -offset  # the axis of a mapping is the last one that it does not change
    if fn.type_name in ("Convolution", "Pooling", "Im2col"):
        axis, *windows = conv_params(fn)
        return axis, *of_windows(*windows)
    if fn.type_name == "Deconvolution":
        axis, *windows = conv_params(fn)
        return axis, *inverted(*of_windows(*windows))
    raise UndefinedMapException(f"a layer of type {fn.type_name} has no coordinate mapping")


def compose(base_map: Mapping, next_map: Mapping) -> Mapping:
    """Return the composition: ``base_map`` after ``next_map``. Raises AxisMismatchException if their axes differ."""
    base_axis, base_scale, base_shift = base_map
    next_axis, next_scale, next_shift = next_map
    if None not in (base_axis, next_axis) and base_axis != next_axis:
        raise AxisMismatchException(
            f"one mapping is for the axes after {base_axis}, the other for the axes after {next_axis}"
        )
    axis = next_axis if base_axis is None else base_axis
    return axis, base_scale * next_scale, base_scale * next_shift + base_shift


def inverse(coord_map: Mapping) -> Mapping:
    """Return the mapping from top to bottom."""
    axis, scale, shift = coord_map
    return axis, *inverted(scale, shift)


def coord_map_from_to(top_from: Top, top_to: Top) -> Mapping:
    """Return the mapping from one top to another, through a blob from which both are computed.

    Raises RuntimeError if layers with mappings do not connect both to a common blob.
    """
    from_maps = _ancestors(top_from)
    for top, to_map in _ancestors(top_to).items():
        if top in from_maps:
            return compose(to_map, inverse(from_maps[top]))
    raise RuntimeError("Could not compute map between tops; are they connected by spatial layers?")


def crop(top_from: Top, top_to: Top) -> Top:
    """Return the top of a Crop layer that crops one top to the place and size of another.

    Raises AssertionError if their scales differ, or the offset is negative or not an integer.
    """
    axis, scale, shift = coord_map_from_to(top_from, top_to)
    assert np.all(scale == 1), f"scale mismatch on crop (a = {scale})"
    assert np.all(shift <= 0), f"cannot crop negative width (b = {shift})"
    assert np.all(np.round(shift) == shift), f"cannot crop noninteger width (b = {shift})"
    offset = [int(number) for number in -np.round(np.atleast_1d(shift))]
    return layers.Crop(top_from, top_to, crop_param={"axis": axis + 1, "offset": offset})


def _ancestors(top: Top) -> dict[Top, Mapping]:
    """Return the blobs that a top is computed from, itself first, each with the mapping from it to the top.

    The second bottom of Crop is ignored, because it only gives a size. The search ends at layers without a mapping.
    """
    maps = {top: IDENTITY}
    pending = [top]
    while pending:
        reached = pending.pop(0)
        bottoms = reached.fn.inputs[:1] if reached.fn.type_name == "Crop" else reached.fn.inputs
        try:
            step = coord_map(reached.fn) if bottoms else IDENTITY
        except UndefinedMapException:
            continue
        for bottom in bottoms:
            if bottom not in maps:
                maps[bottom] = compose(maps[reached], step)
                pending.append(bottom)
    return maps


def _vector(value: Any) -> np.ndarray:
    return np.array(value, ndmin=1)
