"""Converts images and arrays to inputs of a net, and outputs back.

Images are float arrays (H, W, K) with values from 0 to 1, K being 3 (RGB) or 1.
Caffe: python/caffe/io.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from netspec.compat.pycaffe import errors
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.data.preprocess import preprocessed

Array = np.ndarray
Extents = Sequence[int] | Array


# ---- Messages and arrays ----


def blobproto_to_array(blob: Any, return_diff: bool = False) -> Array:
    """Return the data, or the diff, of a BlobProto as float64, (num, channels, height, width) if it has these fields.

    Raises ValueError if the shape does not match the number of values.
    """
    values = np.array(blob.diff if return_diff else blob.data, np.float64)
    legacy = ("num", "channels", "height", "width")
    if any(blob.HasField(name) for name in legacy):
        return values.reshape([getattr(blob, name) for name in legacy])
    return values.reshape(list(blob.shape.dim))


def array_to_blobproto(arr: Array, diff: Array | None = None) -> Any:
    """Return an array, and its diff if given, as a BlobProto."""
    blob = caffe_pb2.BlobProto()
    blob.shape.dim.extend(arr.shape)
    blob.data.extend(np.asarray(arr, np.float32).ravel())
    if diff is not None:
        blob.diff.extend(np.asarray(diff, np.float32).ravel())
    return blob


def arraylist_to_blobprotovector_str(arraylist: Sequence[Array]) -> bytes:
    """Return arrays as a serialized BlobProtoVector."""
    return caffe_pb2.BlobProtoVector(blobs=[array_to_blobproto(arr) for arr in arraylist]).SerializeToString()


arraylist_to_blobprotovecor_str = arraylist_to_blobprotovector_str  # Caffe's spelling


def blobprotovector_str_to_arraylist(str: bytes) -> list[Array]:
    """Return the arrays in a serialized BlobProtoVector."""
    return [blobproto_to_array(blob) for blob in caffe_pb2.BlobProtoVector.FromString(str).blobs]


def array_to_datum(arr: Array, label: int | np.integer | None = None) -> Any:
    """Return an array (C, H, W) as a Datum: uint8 as bytes, other numbers as floats.

    Raises ValueError if it does not have three axes.
    """
    if arr.ndim != 3:
        raise ValueError(f"Incorrect array shape: found {arr.shape}, expected (channels, height, width).")
    datum = caffe_pb2.Datum()
    datum.channels, datum.height, datum.width = arr.shape
    if arr.dtype == np.uint8:
        datum.data = arr.tobytes()
    else:
        datum.float_data.extend(np.asarray(arr, np.float64).ravel())
    if label is not None:
        datum.label = int(label)
    return datum


def datum_to_array(datum: Any) -> Array:
    """Return the values of a Datum as (C, H, W), uint8 or float64; an encoded image is not decoded."""
    shape = datum.channels, datum.height, datum.width
    if datum.data:
        return np.frombuffer(datum.data, np.uint8).reshape(shape).copy()
    return np.array(datum.float_data, np.float64).reshape(shape)


# ---- Pre-processing ----


class Transformer:
    """Converts an image to a net's input: resizes, transposes, reorders channels, scales, and subtracts a mean.

    ``inputs`` has the shape of each input blob (N, C, H, W). Steps that are not set are skipped.
    """

    def __init__(self, inputs: Mapping[str, Sequence[int]]) -> None:
        self.inputs = inputs
        self.transpose: dict[str, Sequence[int]] = {}
        self.channel_swap: dict[str, Sequence[int]] = {}
        self.raw_scale: dict[str, float] = {}
        self.mean: dict[str, Array] = {}
        self.input_scale: dict[str, float] = {}

    def preprocess(self, in_: str, data: Array) -> Array:
        """Return an image (H', W', K) as (K, H, W) float32 for the input blob ``in_``.

        The order is: resize, transpose, swap the channels, times raw_scale, minus the mean, times input_scale. As in
        Caffe, a float32 image that needs neither resizing nor swapping is itself scaled in place.
        """
        self._check_input(in_)
        values = data.astype(np.float32, copy=False)
        size = tuple(self.inputs[in_][2:])
        if values.shape[:2] != size:
            values = resize_image(values, size)
        if in_ in self.transpose:
            values = values.transpose(self.transpose[in_])
        order, mean = self.channel_swap.get(in_), self.mean.get(in_)
        return preprocessed(values, order, self.raw_scale.get(in_, 1.0), mean, self.input_scale.get(in_, 1.0))

    def deprocess(self, in_: str, data: Array) -> Array:
        """Undo ``preprocess`` for an input (K, H, W), except for its size."""
        self._check_input(in_)
        values = data.copy().squeeze()
        if in_ in self.input_scale:
            values /= self.input_scale[in_]
        if in_ in self.mean:
            values += self.mean[in_]
        if in_ in self.raw_scale:
            values /= self.raw_scale[in_]
        if in_ in self.channel_swap:
            values = values[np.argsort(self.channel_swap[in_]), :, :]
        if in_ in self.transpose:
            values = values.transpose(np.argsort(self.transpose[in_]))
        return values

    def set_transpose(self, in_: str, order: Sequence[int]) -> None:
        """Set the order of an image's axes in the blob: (2, 0, 1) turns (H, W, K) into (K, H, W)."""
        self._check_input(in_)
        if len(order) != len(self.inputs[in_]) - 1:
            raise Exception("Transpose order needs to have the same number of dimensions as the input.")
        self.transpose[in_] = order

    def set_channel_swap(self, in_: str, order: Sequence[int]) -> None:
        """Set the order of the channels, after transposing: (2, 1, 0) turns RGB into BGR."""
        self._check_input(in_)
        if len(order) != self.inputs[in_][1]:
            raise Exception("Channel swap needs to have the same number of dimensions as the input channels.")
        self.channel_swap[in_] = order

    def set_raw_scale(self, in_: str, scale: float) -> None:
        """Set the factor of the image before the mean is subtracted: 255 for nets with inputs from 0 to 255."""
        self._check_input(in_)
        self.raw_scale[in_] = scale

    def set_mean(self, in_: str, mean: Array) -> None:
        """Set the mean to subtract: a value for each channel (K,), or an image (H, W) or (K, H, W).

        A mean image of another size is resized to the input, as in Caffe. Raises ValueError for another number of
        channels or axes.
        """
        self._check_input(in_)
        mean = np.asarray(mean)
        shape = tuple(self.inputs[in_][1:])
        if mean.ndim == 1:
            if mean.shape[0] != shape[0]:
                raise ValueError(f"Mean channels incompatible with input: found {mean.shape[0]}, expected {shape[0]}.")
            mean = mean[:, np.newaxis, np.newaxis]
        elif mean.ndim not in (2, 3):
            raise ValueError(f"Mean shape invalid: found {mean.shape}.")
        elif (image := mean.reshape((1,) * (3 - mean.ndim) + mean.shape)).shape != shape:
            if len(image) != shape[0]:
                raise ValueError(f"Mean channels incompatible with input: found {len(image)}, expected {shape[0]}.")
            low, span = mean.min(), np.ptp(mean) or 1
            mean = resize_image(((image - low) / span).transpose(1, 2, 0), shape[1:]).transpose(2, 0, 1) * span + low
        self.mean[in_] = mean

    def set_input_scale(self, in_: str, scale: float) -> None:
        """Set the factor of the input after the mean is subtracted."""
        self._check_input(in_)
        self.input_scale[in_] = scale

    def _check_input(self, in_: str) -> None:
        if in_ not in self.inputs:
            raise Exception(f"{in_} is not one of the net inputs: {list(self.inputs)}")


# ---- Images ----


def load_image(filename: Any, color: bool = True) -> Array:
    """Return an image file as float32 (H, W, 3) RGB, or (H, W, 1) gray, with values from 0 to 1; alpha is dropped.

    Needs the extra ``pycaffe``.
    """
    skimage = errors.load("skimage", "caffe.io.load_image")
    reading = errors.load("skimage.io", "caffe.io.load_image")
    image = skimage.img_as_float(reading.imread(filename, as_gray=not color)).astype(np.float32)
    if image.ndim == 2:
        image = image[:, :, np.newaxis]
        return np.tile(image, (1, 1, 3)) if color else image
    return image[:, :, :3] if image.shape[2] == 4 else image


def resize_image(im: Array, new_dims: Extents, interp_order: int = 1) -> Array:
    """Return an image (H, W, K) resized to (height, width) by splines of the given order, without anti-aliasing.

    The pixels are Caffe's: for images with K of 1 or 3 those of scikit-image, for all others those of SciPy's zoom.
    Orders other than 1 need scikit-image (the extra ``pycaffe``).
    """
    height, width = (int(extent) for extent in new_dims)
    if im.shape[-1] not in (1, 3):
        from scipy.ndimage import zoom

        scale = (height / im.shape[0], width / im.shape[1], 1)
        return np.asarray(zoom(im, scale, order=interp_order), np.float32)
    low, high = im.min(), im.max()
    if not high > low:
        return np.full((height, width, im.shape[-1]), low, np.float32)
    unit = (im - low) / (high - low)  # scikit-image expects values from 0 to 1
    if interp_order == 1 and unit.dtype in (np.float32, np.float64):
        resized = _bilinear(unit, height, width)
    else:
        transform = errors.load("skimage.transform", "caffe.io.resize_image")
        resized = transform.resize(unit, (height, width), order=interp_order, mode="constant", anti_aliasing=False)
    return (resized * (high - low) + low).astype(np.float32)


def _bilinear(image: Array, height: int, width: int) -> Array:
    """Return an image (H, W, K) with values from 0 to 1, resized as by scikit-image, in less than half of its time.

    The bits are the same: products and sums are in double, in the order of SciPy's zoom, which scikit-image calls.
    Pixels outside are 0.

    SciPy: ndimage/src/ni_interpolation.c (NI_ZoomShift)
    """
    framed = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    parts = [(framed.take(columns, axis=1), share[:, None]) for columns, share in _taps(image.shape[1], width)]
    total = np.zeros((height, width, image.shape[2]))
    for rows, by_row in _taps(image.shape[0], height):
        for part, by_column in parts:
            pixels = part.take(rows, axis=0) * by_row[:, None, None]
            pixels *= by_column
            total += pixels
    return np.clip(total.astype(image.dtype), 0, 1)


def _taps(size: int, wanted: int) -> list[tuple[Array, Array]]:
    """Return the two pixels before and after each of ``wanted`` positions, as indices in a frame, and their shares."""
    positions = (np.arange(wanted) + 0.5) * (size / wanted) - 0.5
    before = np.floor(positions)
    share = positions - before
    first = before.astype(int) + 1  # the frame starts one pixel earlier
    return [(first, 1.0 - share), (first + 1, share)]


def oversample(images: Sequence[Array] | Array, crop_dims: Extents) -> Array:
    """Return ten crops of each of N images of one size, (10 N, h, w, K): corners, center, and these five mirrored."""
    height, width = (int(extent) for extent in crop_dims)
    rows, columns, channels = images[0].shape
    starts = [(top, left) for top in (0, rows - height) for left in (0, columns - width)]
    starts.append((int(rows / 2 - height / 2), int(columns / 2 - width / 2)))
    crops = np.empty((10 * len(images), height, width, channels), np.float32)
    for number, image in enumerate(images):
        for k, (top, left) in enumerate(starts):
            crop = image[top : top + height, left : left + width]
            crops[10 * number + k] = crop
            crops[10 * number + 5 + k] = crop[:, ::-1]
    return crops


def __getattr__(name: str) -> Any:
    """Return names that Caffe's module imports and that scripts use: ``resize``, ``zoom``, ``skimage``."""
    if name == "zoom":
        from scipy.ndimage import zoom

        return zoom
    if name == "resize":
        return errors.load("skimage.transform", "caffe.io.resize").resize
    if name == "skimage":
        errors.load("skimage.io", "caffe.io.skimage")
        return errors.load("skimage", "caffe.io.skimage")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
