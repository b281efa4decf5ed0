"""One protocol for all that keeps descriptors and finds the most similar ones; and their names."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

import numpy as np

from loopclosure.errors import InputError

INDEXES = ("exact", "faiss")


class Index(Protocol):
    """Descriptors (D,), numbered 0, 1, ... in the order in which they come."""

    def __len__(self) -> int:
        """Return how many there are."""
        ...

    def add(self, rows: np.ndarray) -> None:
        """Append descriptors (N, D) float32; for cosine they have unit length."""
        ...

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (k,) and scores (k,) of the most similar to ``row`` (D,), best first; fewer if there are.

        Higher scores are more similar: the cosine similarity, or minus the Euclidean distance.
        """
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return descriptors (stop - start, D) float32, as exactly as they are kept."""
        ...


def open_index(name: str, metric: str, first: int | None = None) -> Index:
    """Return an index: "exact" or "faiss", empty, or one in Milvus, ``FILE.db`` or ``http://HOST:PORT``.

    ``first``: of what is in Milvus, so many descriptors are used at most, and new ones follow them; None: all.

    Raises InputError for another name, and where what it needs is not installed.
    """
    # Each has what it needs imported only where it is wanted.
    if name == "exact":
        from loopclosure.index.exact import ExactIndex

        return ExactIndex(metric)
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
