"""A net that classifies images. Caffe: python/caffe/classifier.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netspec.compat.pycaffe import io
from netspec.compat.pycaffe.net import Net
from netspec.compat.pycaffe.proto import caffe_pb2


class Classifier(Net):
    """A net with an image input, and a Transformer for it.

    ``image_dims`` is the size (height, width) to which images are resized before they are cropped to the net's input
    size; default: the input size. ``mean``, ``input_scale``, ``raw_scale`` and ``channel_swap`` are settings of the
    Transformer.
    """

    def __init__(
        self,
        model_file: str,
        pretrained_file: str,
        image_dims: io.Extents | None = None,
        mean: np.ndarray | None = None,
        input_scale: float | None = None,
        raw_scale: float | None = None,
        channel_swap: Sequence[int] | None = None,
    ) -> None:
        super().__init__(model_file, caffe_pb2.TEST, weights=pretrained_file)
        in_ = self.inputs[0]
        self.transformer = transformer(self, mean, input_scale, raw_scale, channel_swap)
        self.crop_dims = np.array(self.blobs[in_].data.shape[2:])
        self.image_dims = image_dims if image_dims is not None and len(image_dims) else self.crop_dims

    def predict(self, inputs: Sequence[np.ndarray], oversample: bool = True) -> np.ndarray:
        """Return the first output (N, classes) for N images (H, W, K).

        With ``oversample`` it is the mean over ten crops (corners, center, mirrored), otherwise that of the center.
        """
        height, width = self.image_dims
        images = np.zeros((len(inputs), height, width, inputs[0].shape[2]), np.float32)
        for number, image in enumerate(inputs):
            images[number] = io.resize_image(image, self.image_dims)
        if oversample:
            images = io.oversample(images, self.crop_dims)
        else:
            top, left = (np.array(self.image_dims) / 2.0 - self.crop_dims / 2.0).astype(int)
            images = images[:, top : top + self.crop_dims[0], left : left + self.crop_dims[1], :]
        in_ = self.inputs[0]
        blobs: dict[str, Any] = {in_: np.stack([self.transformer.preprocess(in_, image) for image in images])}
        predictions = self.forward_all(**blobs)[self.outputs[0]]
        if oversample:
            predictions = predictions.reshape((len(predictions) // 10, 10, -1)).mean(1)
        return predictions


def transformer(net: Any, mean: Any, input_scale: Any, raw_scale: Any, channel_swap: Any) -> io.Transformer:
    """Return a Transformer for the net's first input, with the given settings."""
    in_ = net.inputs[0]
    made = io.Transformer({in_: net.blobs[in_].data.shape})
    made.set_transpose(in_, (2, 0, 1))
    settings = (
        (made.set_mean, mean),
        (made.set_input_scale, input_scale),
        (made.set_raw_scale, raw_scale),
        (made.set_channel_swap, channel_swap),
    )
    for setter, value in settings:
        if value is not None:
            setter(in_, value)
    return made
