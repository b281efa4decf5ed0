"""An index in a Milvus database, a file (``MilvusClient("places.db")``) or a cluster, for maps of several robots."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

from loopclosure.errors import InputError

T = TypeVar("T")
COLLECTION = "places"
AT_ONCE = 1000  # rows per insertion or query


class MilvusIndex:
    """See :class:`loopclosure.index.index.Index`; it may have descriptors of earlier sessions already."""

    def __init__(self, uri: str, metric: str, first: int | None = None) -> None:
        self._uri, self._metric = uri, metric
        client = import_module("pymilvus").MilvusClient  # optional
        self._client: Any = self._call(lambda: client(uri))
        self._count = 0
        if self._call(lambda: self._client.has_collection(COLLECTION)):
            self._call(lambda: self._client.load_collection(COLLECTION))
            found = self._call(lambda: self._query("", ["count(*)"]))
            self._count = min(int(found[0]["count(*)"]), 1 << 62 if first is None else first)

    def __len__(self) -> int:
        return self._count

    def add(self, rows: np.ndarray) -> None:
        """See :class:`~loopclosure.index.index.Index`."""
        if not self._count and not self._call(lambda: self._client.has_collection(COLLECTION)):
            kind = "IP" if self._metric == "cosine" else "L2"
            self._call(lambda: self._client.create_collection(COLLECTION, rows.shape[1], metric_type=kind))
        for start in range(0, len(rows), AT_ONCE):
            first = self._count
            data = [{"id": first + i, "vector": row.tolist()} for i, row in enumerate(rows[start : start + AT_ONCE])]
            self._call(lambda data=data: self._client.upsert(COLLECTION, data))
            self._count += len(data)

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`."""
        k = min(k, self._count)
        found = self._call(
            lambda: self._client.search(
                COLLECTION, [row.tolist()], filter=f"id < {self._count}", limit=k, consistency_level="Strong"
            )
        )[0]
        values = np.array([hit["distance"] for hit in found])
        scores = values if self._metric == "cosine" else -np.sqrt(np.maximum(values, 0))
        return np.array([hit["id"] for hit in found], np.int64), scores

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        parts = []
        for first in range(start, stop, AT_ONCE):
            asked = f"id >= {first} and id < {min(stop, first + AT_ONCE)}"
            found = self._call(lambda asked=asked: self._query(asked, ["id", "vector"]))
            parts += [hit["vector"] for hit in sorted(found, key=lambda hit: hit["id"])]
        return np.array(parts, np.float32)

    def _query(self, which: str, fields: list[str]) -> Any:
        return self._client.query(COLLECTION, filter=which, output_fields=fields, consistency_level="Strong")

    def _call(self, request: Callable[[], T]) -> T:
        """Return the result of a request. Raises InputError if it fails."""
        try:
            return request()
        except Exception as error:  # of pymilvus, of gRPC, of the file system
            reason = " ".join(str(error).split())
            raise InputError(f"Milvus: {reason:.200}", self._uri) from None
