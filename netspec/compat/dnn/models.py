"""Model and its subclasses, which compute classes, boxes or a mask from an image, as in cv2.dnn.

OpenCV: modules/dnn/src/model.cpp (4.12)
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from netspec.compat.dnn.errors import BAD_ARGUMENT, DnnError
from netspec.compat.dnn.read import readNet
from netspec.files.opencv import dnn as opencv

Array = np.ndarray


class Model:
    """A net with preprocessing of images: ``Model(net)``, or ``Model(weights, prototxt)`` in either order.

    The image is resized to ``size`` (width, height), if it is set. The input is then (pixel - mean) * scale. ``mean``
    and ``scale`` are in the order of the input's channels: R, G, B if swapRB is set.
    """

    def __init__(self, model: Any, config: str | os.PathLike[str] = "") -> None:
        self._net = readNet(model, config) if isinstance(model, str | os.PathLike) else model
        self._size: tuple[int, int] = (0, 0)
        self._mean: Sequence[float] = (0, 0, 0, 0)
        self._scale: Array = np.ones(4)
        self._swap = self._crop = False
        self._outputs: Sequence[str] = self._net.getUnconnectedOutLayersNames()

    def setInputSize(self, *size: Any) -> Model:
        """Set the size of the input: ``setInputSize((width, height))`` or ``setInputSize(width, height)``."""
        width, height = size[0] if len(size) == 1 else size
        self._size = (int(width), int(height))
        return self

    def setInputMean(self, mean: Any) -> Model:
        """Set the mean of each channel, which is subtracted."""
        self._mean = _scalar(mean)
        return self

    def setInputScale(self, scale: Any) -> Model:
        """Set the factor for the difference: one number, or one for each channel."""
        self._scale = np.full(4, scale, float) if np.isscalar(scale) else np.array(_scalar(scale))
        return self

    def setInputCrop(self, crop: bool) -> Model:
        """Set whether the image is cropped to the proportions of the input instead of stretched."""
        self._crop = bool(crop)
        return self

    def setInputSwapRB(self, swapRB: bool) -> Model:
        """Set whether the first and the last channel are swapped."""
        self._swap = bool(swapRB)
        return self

    def setInputParams(
        self, scale: float = 1.0, size: Any = (0, 0), mean: Any = (0, 0, 0), swapRB: bool = False, crop: bool = False
    ) -> None:
        """Set all of these at once."""
        self.setInputScale(scale).setInputSize(size).setInputMean(mean).setInputSwapRB(swapRB).setInputCrop(crop)

    def setOutputNames(self, outNames: Sequence[str]) -> Model:
        """Set the layers whose tops :meth:`predict` returns. Default: those that no other layer reads."""
        self._outputs = tuple(outNames)
        return self

    def setPreferableBackend(self, backendId: int) -> Model:
        """Choose what runs the net, as :meth:`netspec.compat.dnn.net.Net.setPreferableBackend` does."""
        self._net.setPreferableBackend(backendId)
        return self

    def setPreferableTarget(self, targetId: int) -> Model:
        """Accept and ignore a target."""
        self._net.setPreferableTarget(targetId)
        return self

    def enableWinograd(self, useWinograd: bool) -> Model:
        """Accept and ignore the switch."""
        self._net.enableWinograd(useWinograd)
        return self

    def predict(self, frame: Array, outs: Any = None) -> tuple[Array, ...]:
        """Return the outputs for an image (H, W, C) or (H, W)."""
        blob = opencv.blobFromImage(frame, 1.0, self._size, self._mean, self._swap, self._crop)
        blob *= self._scale[: blob.shape[1], None, None].astype(np.float32)
        self._net.setInput(blob)
        if self._net.getLayer(0).outputNameToIndex("im_info") != -1:  # Faster R-CNN
            self._net.setInput(np.array([[self._size[1], self._size[0], 1.6]], np.float32), "im_info")
        return tuple(self._net.forward(list(self._outputs)))

    def _predict_one(self, frame: Array) -> Array:
        outputs = self.predict(frame)
        if len(outputs) != 1:
            raise DnnError(f"found {len(outputs)} outputs, expected one: {', '.join(self._outputs)}", code=BAD_ARGUMENT)
        return outputs[0]


class ClassificationModel(Model):
    """A net with one output: a score for each class."""

    def __init__(self, model: Any, config: str | os.PathLike[str] = "") -> None:
        super().__init__(model, config)
        self._softmax = False

    def setEnableSoftmaxPostProcessing(self, enable: bool) -> ClassificationModel:
        """Set whether the scores go through a softmax."""
        self._softmax = bool(enable)
        return self

    def getEnableSoftmaxPostProcessing(self) -> bool:
        """Return whether the scores go through a softmax."""
        return self._softmax

    def classify(self, frame: Array) -> tuple[int, float]:
        """Return the class of the highest score, and that score."""
        scores = self._predict_one(frame).reshape(-1)
        if self._softmax:
            scores = np.exp(scores - scores.max())
            scores /= scores.sum()
        best = int(scores.argmax())
        return best, float(scores[best])


class SegmentationModel(Model):
    """A net with one output (1, classes, H, W): a score for each class and pixel."""

    def segment(self, frame: Array, mask: Any = None) -> Array:
        """Return the class of the highest score of each pixel, the first of equal ones: (H, W) uint8."""
        return self._predict_one(frame)[0].argmax(axis=0).astype(np.uint8)


class DetectionModel(Model):
    """A net that ends in a DetectionOutput layer."""

    def __init__(self, model: Any, config: str | os.PathLike[str] = "") -> None:
        super().__init__(model, config)
        self._across = False

    def setNmsAcrossClasses(self, value: bool) -> DetectionModel:
        """Accept and ignore whether boxes of different classes suppress each other: DetectionOutput decides this."""
        self._across = bool(value)
        return self

    def getNmsAcrossClasses(self) -> bool:
        """Return what was set."""
        return self._across

    def detect(self, frame: Array, confThreshold: float = 0.5, nmsThreshold: float = 0.0) -> tuple[Any, Any, Any]:
        """Return classes (n,), confidences (n,) and boxes (n, 4): x, y, width, height in pixels of the image.

        If nothing is found, these are empty tuples. ``nmsThreshold`` is not used: the net has suppressed boxes already.
        """
        last = self._net.getLayer(self._net.getLayerNames()[-1])
        if last.type != "DetectionOutput":
            message = f'found a last layer of type "{last.type}", expected DetectionOutput'
            raise DnnError(message, code=BAD_ARGUMENT, func="detect")
        height, width = frame.shape[:2]
        if self._net.getLayer(0).outputNameToIndex("im_info") != -1:
            width, height = self._size
        rows = np.concatenate([output.reshape(-1, 7) for output in self.predict(frame)])
        rows = rows[rows[:, 2] >= np.float32(confThreshold)]
        if not len(rows):
            return (), (), ()
        boxes = np.array([_rectangle(row[3:], width, height) for row in rows], np.int32)
        return rows[:, 1].astype(np.int32), rows[:, 2].copy(), boxes


def _rectangle(corners: Array, width: int, height: int) -> tuple[int, int, int, int]:
    """Return the box in pixels of an image; corners less than two pixels apart are fractions of the image."""
    left, top, right, bottom = (int(value) for value in corners)
    if right - left + 1 <= 2 or bottom - top + 1 <= 2:
        scaled = corners * np.array([width, height] * 2, np.float32)
        left, top, right, bottom = (int(value) for value in scaled)
    across, down = right - left + 1, bottom - top + 1
    left, top = max(0, min(left, width - 1)), max(0, min(top, height - 1))
    return left, top, max(1, min(across, width - left)), max(1, min(down, height - top))


def _scalar(values: Any) -> Sequence[float]:
    """Convert a number or a sequence to four numbers like OpenCV, with 0 for missing ones."""
    given = [values] if np.isscalar(values) else list(values)
    return [float(value) for value in [*given, 0, 0, 0, 0][:4]]
