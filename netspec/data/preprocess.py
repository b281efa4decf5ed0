"""What is done to the pixels of an image before a net.

Caffe: Transformer.preprocess (python/caffe/io.py), DataTransformer::Transform (src/caffe/data_transformer.cpp)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def preprocessed(
    values: np.ndarray, order: Sequence[int] | None, raw_scale: float, mean: np.ndarray | None, scale: float
) -> np.ndarray:
    """Return float32 images (..., C, H, W) with their channels in this order (None: as they are), scaled.

    As in Caffe, an array whose channels are not reordered is itself changed.
    """
    if order is not None:
        values = np.take(values, order, axis=-3)
    if raw_scale != 1:
        values *= np.float32(raw_scale)
    if mean is not None:
        values -= mean
    if scale != 1:
        values *= np.float32(scale)
    return values
