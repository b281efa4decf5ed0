"""The protocol of all indexes, and how to open one by name."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

import numpy as np

from loopclosure.errors import InputError

INDEXES = ("exact", "faiss")


class Index(Protocol):
    """Stores descriptors (D,) and finds the most similar ones. They are numbered from 0 in the order of adding."""

    def __len__(self) -> int:
        """Return the number of descriptors."""
        ...

    def add(self, rows: np.ndarray) -> None:
        """Append descriptors (N, D) float32; for cosine they have unit length."""
        ...

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (k,) and scores (k,) of the descriptors most similar to ``row`` (D,), best first.

        The arrays are shorter if there are fewer than ``k`` descriptors.

        Higher scores are more similar: the cosine similarity, or minus the Euclidean distance.
        """
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return stored descriptors (stop - start, D) float32; an index may have rounded them."""
        ...


def open_index(name: str, metric: str, first: int | None = None, in_memory: int | None = None) -> Index:
    """Return an index: "exact" or "faiss", empty, or one in Milvus, ``FILE.db`` or ``http://HOST:PORT``.

    ``in_memory``: how many descriptors "exact" keeps in memory, see :class:`~loopclosure.index.exact.ExactIndex`; the
    other indexes have files of their own, or shorten their descriptors.

    ``first``: use at most this many of the descriptors in Milvus, and add new ones after them; None: use all.

    Raises InputError for another name, or if a library that the index needs is not installed.
    """
    # Imported only when needed: the libraries are optional.
    if name == "exact":
        from loopclosure.index.exact import ExactIndex

        return ExactIndex(metric, in_memory)
    if name == "faiss":
        _need("faiss", "faiss")
        from loopclosure.index.by_faiss import FaissIndex

        return FaissIndex(metric)
    if name.endswith(".db") or "://" in name:
        _need("pymilvus", "milvus")
        from loopclosure.index.by_milvus import MilvusIndex

        return MilvusIndex(name, metric, first)
    raise InputError(f'there is no index "{name}"; expected {", ".join(INDEXES)}, or Milvus: FILE.db or http://HOST')


def _need(module: str, extra: str) -> None:
    if find_spec(module) is None:
        raise InputError(f"{module} is not installed; pip install netspec-caffe[{extra}]")
