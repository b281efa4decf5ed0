"""Similarity of descriptors.

Higher scores are more similar: the cosine similarity, or minus the Euclidean distance, which ContrastiveLoss trains.
Products are computed in the precision of the descriptors. Euclidean distances are computed as |a|^2 + |b|^2 - 2 a.b
after subtracting the mean of the references. The squared distance has a rounding error of about
eps * (|a|^2 + |b|^2), so the distance of almost equal frames has an error of up to 1e-3 of the norm in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from loopclosure.errors import InputError

METRICS = ("euclidean", "cosine")


@dataclass(frozen=True)
class Descriptors:
    """Descriptors prepared for one metric.

    rows     (N, D): scaled to unit length for cosine (zeros stay zero, and are similar to nothing); minus ``mean`` for
             Euclidean
    squares  (N,) their squared lengths
    """

    metric: str
    rows: np.ndarray
    squares: np.ndarray
    mean: np.ndarray

    def scores(self, queries: Descriptors, rows: slice, columns: slice) -> np.ndarray:
        """Return the scores of a slice of ``queries`` (rows) against a slice of these descriptors (columns)."""
        if self.metric == "cosine":
            return queries.rows[rows] @ self.rows[columns].T
        distances = squared_distances(
            queries.rows[rows], self.rows[columns], queries.squares[rows, None], self.squares[columns]
        )
        np.maximum(distances, 0, out=distances)
        np.sqrt(distances, out=distances)
        np.negative(distances, out=distances)
        return distances


def squared_distances(a: np.ndarray, b: np.ndarray, squares_a: np.ndarray | float, squares_b: np.ndarray) -> np.ndarray:
    """Return |a|^2 + |b|^2 - 2 a.b for each row of ``a`` (N, D) and of ``b`` (M, D): (N, M).

    squares_a  (N, 1) squared lengths of the rows of ``a``; 0 omits them; the order within each row is the same
    squares_b  (M,) squared lengths of the rows of ``b``

    Rounding may make a result slightly negative.
    """
    products = a @ b.T
    products *= -2
    products += squares_a
    products += squares_b
    return products


def prepare(features: np.ndarray, metric: str = "euclidean", mean: np.ndarray | None = None) -> Descriptors:
    """Prepare descriptors (N, D); ``mean`` (D,) is the mean of the references, default: of ``features``.

    Raises InputError for another shape, an unknown metric, a NaN or an infinity.
    """
    check_metric(metric)
    features = np.asarray(features)
    if features.ndim != 2 or features.shape[1] == 0:
        raise InputError(f"descriptors have shape {features.shape}; expected (frames, dimensions)")
    if features.dtype != np.float64:
        features = features.astype(np.float32, copy=False)
    finite = np.all(np.isfinite(features), axis=1)
    if not np.all(finite):
        raise InputError(
            f"the descriptor of frame {np.argmin(finite)} (from 0) has a NaN or an infinity; did the net diverge?"
        )
    center: np.ndarray = np.zeros(features.shape[1], features.dtype)
    if mean is not None:
        center = np.asarray(mean, features.dtype)
    elif metric == "euclidean" and len(features):
        center = features.mean(axis=0)
    if len(center) != features.shape[1]:
        raise InputError(
            f"queries have {features.shape[1]} dimensions, references {len(center)}; both must come from the same net"
        )
    if metric == "cosine":
        norms = np.linalg.norm(features, axis=1, keepdims=True)
        rows = np.divide(features, norms, out=np.zeros_like(features), where=norms > 0)
    else:
        rows = features - center
    return Descriptors(metric, rows, np.einsum("nd,nd->n", rows, rows), center)


def check_metric(metric: str) -> None:
    """Raise InputError for a metric that is not one of METRICS."""
    if metric not in METRICS:
        raise InputError(f'unknown metric "{metric}"; known: {", ".join(METRICS)}')


def similarity_matrix(
    queries: np.ndarray, references: np.ndarray | None = None, metric: str = "euclidean", views: int = 1
) -> np.ndarray:
    """Return all scores (Q, R) at once; ``references`` None compares ``queries`` (Q, D) with themselves.

    A descriptor may contain several ``views``, one after the other. The score of two images is then the score of their
    two most similar views.
    """
    if views == 1:
        query, reference = _pair(queries, references, metric)
        return reference.scores(query, slice(None), slice(None))
    parts = [np.split(rows, views, axis=1) for rows in (queries, queries if references is None else references)]
    return np.max([similarity_matrix(query, reference, metric) for query, reference in product(*parts)], axis=0)


def _pair(queries: np.ndarray, references: np.ndarray | None, metric: str) -> tuple[Descriptors, Descriptors]:
    if references is None:
        both = prepare(queries, metric)
        return both, both
    reference = prepare(references, metric)
    return prepare(queries, metric, reference.mean), reference
