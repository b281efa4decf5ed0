"""A net that classifies windows of images. Caffe: python/caffe/detector.py."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from netspec.compat.pycaffe import io
from netspec.compat.pycaffe.classifier import transformer
from netspec.compat.pycaffe.net import Net
from netspec.compat.pycaffe.proto import caffe_pb2

Window = Sequence[int]


class Detector(Net):
    """A net with an image input, to which windows of images are warped.

    ``context_pad`` is the number of pixels at each border of the input that show the surroundings of a window; pixels
    outside the image are filled with the mean. The other settings are those of the Transformer.
    """

    def __init__(
        self,
        model_file: str,
        pretrained_file: str,
        mean: np.ndarray | None = None,
        input_scale: float | None = None,
        raw_scale: float | None = None,
        channel_swap: Sequence[int] | None = None,
        context_pad: int | None = None,
    ) -> None:
        super().__init__(model_file, caffe_pb2.TEST, weights=pretrained_file)
        self.transformer = transformer(self, mean, input_scale, raw_scale, channel_swap)
        self.configure_crop(context_pad)

    def detect_windows(self, images_windows: Iterable[tuple[str, Iterable[Window]]]) -> list[dict[str, Any]]:
        """Return window, prediction and filename for each window (ymin, xmin, ymax, xmax) of image files."""
        images_windows = [(name, list(windows)) for name, windows in images_windows]
        in_ = self.inputs[0]
        given = []
        for name, windows in images_windows:
            image = io.load_image(name).astype(np.float32)
            given += [self.transformer.preprocess(in_, self.crop(image, np.array(window))) for window in windows]
        blobs: dict[str, Any] = {in_: np.stack(given)}
        predictions = self.forward_all(**blobs)[self.outputs[0]]
        crops = ((name, window) for name, windows in images_windows for window in windows)
        return [
            {"window": window, "prediction": prediction, "filename": name}
            for (name, window), prediction in zip(crops, predictions, strict=True)
        ]

    def detect_selective_search(self, image_fnames: Sequence[str]) -> list[dict[str, Any]]:
        """Return the result of ``detect_windows`` for the windows that selective search proposes.

        Needs the module selective_search_ijcv_with_python, which must be installed separately, and MATLAB.
        """
        search = importlib.import_module("selective_search_ijcv_with_python")
        names = [os.path.abspath(name) for name in image_fnames]
        windows = search.get_windows(names, cmd="selective_search_rcnn")
        return self.detect_windows(zip(names, windows, strict=True))

    def crop(self, im: np.ndarray, window: np.ndarray) -> np.ndarray:
        """Return the part of an image (H, W, K) in a window, with the context around it if that is set."""
        top, left, bottom, right = (int(edge) for edge in window)
        cropped = im[top:bottom, left:right]
        if not self.context_pad:
            return cropped
        size = self.blobs[self.inputs[0]].width  # the input is square
        scale = size / (size - 2.0 * self.context_pad)
        half = np.array([bottom - top + 1, right - left + 1]) / 2.0
        center = np.array([top, left]) + half
        low, high = np.round(center - scale * half), np.round(center + scale * half)
        wanted = high - low + 1
        factors = size / wanted
        missing = np.maximum(0, -low)  # above and left of the image
        shift = np.round(missing * factors).astype(int)
        low = np.clip(low, 0, im.shape[:2]).astype(int)
        high = np.clip(high, 0, im.shape[:2]).astype(int)
        seen = im[low[0] : high[0], low[1] : high[1]]
        extent = np.minimum(np.round((high - low + 1) * factors).astype(int), size - shift)
        result = np.ones((size, size, im.shape[2]), np.float32) * self.crop_mean
        result[shift[0] : shift[0] + extent[0], shift[1] : shift[1] + extent[1]] = io.resize_image(seen, extent)
        return result

    def configure_crop(self, context_pad: int | None) -> None:
        """Set the context, and the value of pixels outside an image: the mean, scaled like images, or 0."""
        self.context_pad = context_pad
        if not context_pad:
            return
        in_ = self.inputs[0]
        mean = self.transformer.mean.get(in_)
        if mean is None:
            self.crop_mean = np.zeros(self.blobs[in_].data.shape[1:], np.float32).transpose(1, 2, 0)
            return
        # For an input of 0, deprocess() returns the mean.
        zero = np.zeros(self.blobs[in_].data.shape[1:], np.float32)
        self.crop_mean = self.transformer.deprocess(in_, zero)
