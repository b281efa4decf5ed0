"""One image in, one descriptor out: a net as the ``describe`` callable of a loop-closure detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from netspec.features.images import ImageNet
from netspec.features.views import read_zooms


class Describer:
    """A callable that returns blob ``blob`` of a net for an image given as its blob ``input``.

    The net is the prototxt ``model`` in phase TEST, reduced to the layers that compute the blob. Pixels are scaled by
    the transform_param of its data layer. ``zooms``, such as "1,0.7", gives the views of each image, ``views`` their
    number. Raises SpecError for errors in the files.
    """

    def __init__(
        self,
        model: str | Path,
        weights: str | Path,
        blob: str = "feat",
        input: str = "data",
        device: str = "cpu",
        zooms: str | float = "1",
    ) -> None:
        self.image_net = ImageNet(model, [weights], blob, input, torch.device(device), zooms=read_zooms(zooms))
        self.views = len(self.image_net.zooms)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the descriptor (views D,) float32 of an image (H, W, 3) or (H, W), uint8, BGR, of any size."""
        return self.image_net([image])[0]
