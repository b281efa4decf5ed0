"""The base class of layers whose tops are records."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from netspec.layers.contract.base import Layer


class DataLayer(Layer):
    """Base of the layers whose tops are records, which are inputs of an exported net.

    Caffe: include/caffe/layers/base_data_layer.hpp
    """

    bottoms = (0, 0)
    tops = (2, 2)
    takes_arrays: ClassVar[bool] = False  # its records are arrays of a program: ``set_input_arrays``
    ahead: int = 0  # bytes of the batches that it reads ahead
    waited: float = 0.0  # the seconds that forward passes have waited for records
    num_records: int = 0  # 0: it reads none, or the data is not open
    iteration: int = 0  # of the batch that the next forward pass returns

    @classmethod
    def source_of(cls, param: Any) -> str:
        """Return the path that a LayerParameter names for its records, "" where it names none."""
        return ""

    def keys(self, iteration: int) -> list[str]:
        """Return the keys (or file names) of the records of an iteration, one per row of the tops."""
        raise NotImplementedError

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray) -> None:
        """Take images (n, C, H, W) and labels (n,) as records. Raises SpecError for other shapes."""
        raise NotImplementedError
