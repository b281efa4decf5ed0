"""Computes which pixels of an image matter for a blob, from the magnitude of the gradient.

Simonyan, Vedaldi, Zisserman: Deep Inside Convolutional Networks (2014), section 3; averaged over noisy copies:
Smilkov et al.: SmoothGrad (2017).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from netspec.errors import SpecError, Where
from netspec.inspect.features.images import ImageNet

NOISE = 0.1  # standard deviation, as a share of the range of the input


def of_unit(
    net: ImageNet, image: np.ndarray, unit: int | None = None, samples: int = 16
) -> tuple[np.ndarray, int, float]:
    """Return the saliency (H, W) of an image, uint8 BGR, for one value of the blob, and its index and value.

    ``unit`` is the flat index of the value, or None for the largest. The saliency is the maximum absolute gradient
    over the channels, averaged over ``samples`` noisy copies of the input; a single sample has no noise. Raises
    SpecError if the blob has no such unit.
    """
    data = net.inputs([image])
    values = net.values(data).reshape(-1)
    if unit is not None and not 0 <= unit < len(values):
        raise SpecError(f"found unit {unit}, expected 0 to {len(values) - 1}: blob {net.blob} has {len(values)} values")
    chosen = int(values.argmax()) if unit is None else unit
    (map_,) = _gradients(net, [data], lambda blobs: blobs[0].reshape(-1)[chosen], samples)
    return map_, chosen, float(values[chosen])


def of_distance(
    net: ImageNet, first: np.ndarray, second: np.ndarray, samples: int = 16
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the saliency (H, W) of two images for the Euclidean distance of their blobs, and that distance."""
    data = [net.inputs([image]) for image in (first, second)]
    blobs = [net.values(part).reshape(-1) for part in data]
    one, other = _gradients(net, data, lambda both: (both[0] - both[1]).square().sum(), samples)
    return one, other, float(np.linalg.norm(blobs[0] - blobs[1]))


def _gradients(
    net: ImageNet, data: Sequence[np.ndarray], score: Callable[[list[torch.Tensor]], torch.Tensor], samples: int
) -> list[np.ndarray]:
    generator = torch.Generator().manual_seed(0)
    sums = [np.zeros(part.shape[2:]) for part in data]
    for _ in range(samples):
        inputs = [_noisy(torch.from_numpy(part), generator if samples > 1 else None) for part in data]
        total = score([net.differentiable(part) for part in inputs])
        if not total.requires_grad:
            raise SpecError(f"blob {net.blob} has no gradient with respect to {net.input}", Where(net.file))
        total.backward()
        for found, part in zip(sums, inputs, strict=True):
            if part.grad is not None:
                found += part.grad[0].abs().amax(dim=0).numpy()
    return [found / samples for found in sums]


def _noisy(data: torch.Tensor, generator: torch.Generator | None) -> torch.Tensor:
    if generator is not None:
        data = data + NOISE * float(data.max() - data.min()) * torch.randn(data.shape, generator=generator)
    return data.clone().requires_grad_()
