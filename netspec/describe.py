"""One image in, one descriptor out: a net as the ``describe`` callable of a loop-closure detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from netspec.extract import fitted, image_net
from netspec.weights import load_weights


class Describer:
    """A callable that gives blob ``blob`` of a net for an image that goes into its blob ``input``.

    The net is the prototxt ``model`` in phase TEST, cut down to what computes the blob; the pixels are scaled as its
    data layer's transform_param says. Raises SpecError for faults of the files.
    """

    def __init__(
        self, model: str | Path, weights: str | Path, blob: str = "feat", input: str = "data", device: str = "cpu"
    ) -> None:
        self.blob = blob
        self.net, self.scaling = image_net(str(model), blob, input, None, torch.device(device))
        load_weights(self.net, weights)
        self.net.keep = [blob]

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the descriptor (D,) float32 of an image (H, W, 3) or (H, W), uint8, BGR, of any size."""
        (name,) = self.net.inputs
        pixels = fitted(image, self.net.shapes[name][1:])
        with torch.no_grad():
            self.net(**{name: ((pixels - self.scaling.mean) * self.scaling.scale)[None]})
        return self.net.blobs[self.blob].reshape(-1).cpu().numpy()
