"""Caffe's data for PyTorch: databases, and the batches of a net's data layers, as ``torch.utils.data.Dataset``.

Records come in Caffe's order, with Caffe's transformation; random draws follow from the seed and the record's place in
the endless sequence that Caffe reads, so that they do not depend on the number of workers.
"""

from netspec.datasets.batches import Batches
from netspec.datasets.records import Records

__all__ = ["Batches", "Records"]
