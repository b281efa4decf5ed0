"""Similarity of descriptors: whole matrices for short sequences, the best references of each frame for long ones.

Higher scores are more similar: the cosine similarity, or minus the Euclidean distance, which ContrastiveLoss trains.
Products are computed in the precision of the descriptors. Euclidean distances are computed as |a|^2 + |b|^2 - 2 a.b
after subtracting the mean of the references. The squared distance has a rounding error of about
eps * (|a|^2 + |b|^2), so the distance of almost equal frames has an error of up to 1e-3 of the norm in float32.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from loopclosure.csv_file import write_csv
from loopclosure.errors import InputError
from loopclosure.places.truth import Exclusion
from loopclosure.progress import Progress, silent
from netspec.files.whole_file import whole_file

METRICS = ("euclidean", "cosine")
# 1024 x 16384 scores in float32 are 64 MiB, for a sequence of any length.
BLOCK_ROWS = 1024
BLOCK_COLUMNS = 16384


@dataclass(frozen=True)
class TopK:
    """The best references of each query, best first; equal scores in the order of the references.

    indices  (Q, k) int64, -1 if a query has fewer than k candidates
    scores   (Q, k), higher = more similar, -inf if there is no candidate
    """

    indices: np.ndarray
    scores: np.ndarray


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

    Rounding may make a result slightly negative. scikit-learn's euclidean_distances and pairwise_distances_argmin are
    several times slower, because they compute float32 in float64.
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

    The matrix of 100,000 frames needs 40 GB: use :func:`similarity_blocks` or :func:`top_k` for long sequences.
    """
    if views == 1:
        query, reference = _pair(queries, references, metric)
        return reference.scores(query, slice(None), slice(None))
    parts = [np.split(rows, views, axis=1) for rows in (queries, queries if references is None else references)]
    return np.max([similarity_matrix(query, reference, metric) for query, reference in product(*parts)], axis=0)


def similarity_blocks(
    queries: np.ndarray, references: np.ndarray | None = None, metric: str = "euclidean", rows: int = BLOCK_ROWS
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (first query, scores (rows, R)) from the first query to the last; the last block may have fewer rows."""
    query, reference = _pair(queries, references, metric)
    for start in range(0, len(query.rows), rows):
        yield start, reference.scores(query, slice(start, start + rows), slice(None))


def top_k(
    queries: np.ndarray,
    references: np.ndarray | None = None,
    k: int = 10,
    metric: str = "euclidean",
    exclusion: Exclusion | None = None,
    stamps: np.ndarray | None = None,
) -> TopK:
    """Find the ``k`` best references of each query; only one block of scores is in memory at a time.

    Without ``references``, one sequence is searched for its own loops: frame i is compared with the earlier frames
    j < i, except those that ``exclusion`` excludes (``stamps`` (Q,) in seconds are needed if it has seconds). With
    references, every pair is a candidate.
    """
    if k < 1:
        raise InputError(f"the best {k} were asked for; expected 1 or more")
    alone = references is None
    if exclusion is not None and not alone:
        raise InputError("an exclusion applies to one sequence; with other references nothing is near in time")
    exclusion = exclusion or Exclusion()
    query, reference = _pair(queries, references, metric)
    k = min(k, len(reference.rows))
    indices = np.full((len(query.rows), k), -1, dtype=np.int64)
    scores = np.full((len(query.rows), k), -np.inf, dtype=query.rows.dtype)
    for top in range(0, len(query.rows), BLOCK_ROWS):
        rows = slice(top, min(top + BLOCK_ROWS, len(query.rows)))
        # Frames after the last query of the block are not candidates of any of its queries.
        end = min(rows.stop, len(reference.rows)) if alone else len(reference.rows)
        for left in range(0, end, BLOCK_COLUMNS):
            columns = slice(left, min(left + BLOCK_COLUMNS, end))
            block = reference.scores(query, rows, columns)
            if alone:
                _mask_not_earlier(block, rows, columns, exclusion, stamps)
            _merge(indices[rows], scores[rows], block, left)
    return TopK(indices, scores)


def write_similarity(
    path: str | Path,
    queries: np.ndarray,
    references: np.ndarray | None = None,
    metric: str = "euclidean",
    progress: Progress = silent,
) -> tuple[int, int]:
    """Write all scores (Q, R) as an .npy file of float32, block by block; return its shape."""
    shape = (len(queries), len(queries) if references is None else len(references))
    blocks = similarity_blocks(queries, references, metric)
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype("<f4")), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for _, block in progress(blocks, "similarity", -(-shape[0] // BLOCK_ROWS)):
            file.write(np.ascontiguousarray(block, "<f4").data)
    return shape


def write_top_k(path: str | Path, found: TopK) -> None:
    """Write the best references of each query as CSV: query, rank from 1, reference, score."""
    rows = [
        (query, rank, reference, f"{score:.9g}")
        for query, (indices, scores) in enumerate(zip(found.indices, found.scores, strict=True))
        for rank, (reference, score) in enumerate(zip(indices, scores, strict=True), start=1)
        if reference >= 0
    ]
    write_csv(path, ("query", "rank", "reference", "score"), rows)


def _pair(queries: np.ndarray, references: np.ndarray | None, metric: str) -> tuple[Descriptors, Descriptors]:
    if references is None:
        both = prepare(queries, metric)
        return both, both
    reference = prepare(references, metric)
    return prepare(queries, metric, reference.mean), reference


def _mask_not_earlier(
    block: np.ndarray, rows: slice, columns: slice, exclusion: Exclusion, stamps: np.ndarray | None
) -> None:
    """Set to -inf, in place, the references that are excluded or not earlier than the query."""
    queries, references = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
    query_stamps, reference_stamps = (None, None) if stamps is None else (stamps[rows], stamps[columns])
    block[exclusion.excludes(queries, references, query_stamps, reference_stamps)] = -np.inf
    block[references[None, :] >= queries[:, None]] = -np.inf


def _merge(indices: np.ndarray, scores: np.ndarray, block: np.ndarray, left: int) -> None:
    """Merge a block of scores into the best so far, in place; its first column is reference ``left``."""
    k = indices.shape[1]
    if block.shape[1] > k:
        chosen = np.argpartition(block, block.shape[1] - k, axis=1)[:, -k:]
        # argpartition keeps any of equal scores at the border; keeping the earliest makes results reproducible.
        border = np.take_along_axis(block, chosen, axis=1).min(axis=1)
        tied = (np.count_nonzero(block >= border[:, None], axis=1) > k) & ~np.isneginf(border)
        for row in np.flatnonzero(tied):
            chosen[row] = np.argsort(-block[row], kind="stable")[:k]
    else:
        chosen = np.broadcast_to(np.arange(block.shape[1]), block.shape)
    candidates = np.concatenate([indices, chosen + left], axis=1)
    values = np.concatenate([scores, np.take_along_axis(block, chosen, axis=1)], axis=1)
    candidates[np.isneginf(values)] = -1
    order = np.lexsort((candidates, -values), axis=1)[:, :k]
    indices[:] = np.take_along_axis(candidates, order, axis=1)
    scores[:] = np.take_along_axis(values, order, axis=1)
