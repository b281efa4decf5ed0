"""One image in, one descriptor out: a net as the ``describe`` callable of a loop-closure detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from netspec.errors import SpecError
from netspec.features.images import check_zooms, fitted, image_net, middle
from netspec.net.weights import load_weights


class Describer:
    """A callable that gives blob ``blob`` of a net for an image that goes into its blob ``input``.

    The net is the prototxt ``model`` in phase TEST, cut down to what computes the blob; the pixels are scaled as its
    data layer's transform_param says. ``zooms``, "1,0.7", describes so many views of each image, as
    :func:`netspec.features.images.extract_images` does; ``views`` says how many. Raises SpecError for faults of the
    files.
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
        self.blob = blob
        try:
            numbers = [float(text) for text in str(zooms).split(",")]
        except ValueError:
            raise SpecError(f'found zooms "{zooms}", expected numbers with commas between, e.g. "1,0.7"') from None
        self.zooms = check_zooms(numbers)
        self.views = len(self.zooms)
        self.net, self.scaling = image_net(str(model), blob, input, None, torch.device(device))
        load_weights(self.net, weights)
        self.net.keep = [blob]

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the descriptor (views D,) float32 of an image (H, W, 3) or (H, W), uint8, BGR, of any size."""
        (name,) = self.net.inputs
        pixels = np.stack([fitted(middle(image, zoom), self.net.shapes[name][1:]) for zoom in self.zooms])
        with torch.no_grad():
            self.net(**{name: (pixels - self.scaling.mean) * self.scaling.scale})
        return self.net.blobs[self.blob].reshape(-1).cpu().numpy()
