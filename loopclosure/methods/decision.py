"""Step 5 of :mod:`loopclosure.methods.auto`: which matches are loops, by their lines and by their points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from loopclosure.detector.verification import DOUBTLESS, SURE
from loopclosure.methods.geometry import Matches
from loopclosure.methods.lines import LEAST_ACCEPTED, Lines
from loopclosure.methods.seqslam import SequenceSettings

WINDOW = 5  # references to each side of a line, and at least so many queries along it, where a loop has neighbors
MOST = 0.5  # of the matches between two loops are on one line with them, where it goes on between them
UNLIKELY = 0.05  # that so many matches in a row are not verified, at the share that is


def decide(matches: Matches, lines: Lines | None) -> np.ndarray:
    """Return the queries (Q,) whose matches are loops."""
    if lines is None:
        return matches.evidence >= SURE
    pairs, verified = neighbors(matches.match, lines.sequence), matches.evidence >= 1
    if not matches.by_lines:
        return grown(matches.evidence >= SURE, verified, pairs)
    label = stretches(matches.line, pairs)
    many = np.bincount(label, matches.line)[label] >= LEAST_ACCEPTED
    seeds = matches.line & (many | (np.bincount(label, verified & matches.line)[label] > 0))
    of_line = matches.match == lines.match
    by_line = grown(seeds, lines.above_decoys & of_line, pairs)
    loops = by_line & ~contradicted(by_line, verified, matches.inliers >= 0, pairs, lines.sequence.length)
    loops |= between(loops, lines.match, lines.sequence) & of_line
    # From afar a place is seen before the camera is there: other queries fit it better.
    loops |= lines.near & (matches.evidence >= DOUBTLESS)
    return grown(loops, lines.near & verified, pairs)


def grown(loops: np.ndarray, possible: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return loops (Q,) with those of the ``possible`` ones that are neighbors of loops, and neighbors of these."""
    loops = loops.copy()
    earlier, later = pairs.T
    while True:
        beside = np.zeros_like(loops)
        beside[later[loops[earlier]]] = True
        beside[earlier[loops[later]]] = True
        more = possible & beside & ~loops
        if not more.any():
            return loops
        loops |= more


def contradicted(
    loops: np.ndarray, verified: np.ndarray, tried: np.ndarray, pairs: np.ndarray, length: int
) -> np.ndarray:
    """Return the loops (Q,) of lines that their points contradict.

    These are runs of matches, at an end of a stretch or all of it, of which none is verified though so many should be:
    at the share of the stretch that is, or of all stretches where none is. A run longer than a line is several
    lines, which tell enough; a shorter one may be the end of the line through the last place of a loop. Matches whose
    verification was not ``tried`` count neither for nor against.
    """
    stretch = stretches(loops, pairs)
    against = np.zeros_like(loops)
    overall = np.mean(verified[loops & tried]) if np.any(loops & tried) else 0.0
    for number in np.unique(stretch[loops]):
        queries = np.flatnonzero(loops & (stretch == number))
        found = np.flatnonzero(verified[queries])
        if len(found):
            within = queries[found[0] : found[-1] + 1]
            share, runs = len(found) / np.count_nonzero(tried[within]), (queries[: found[0]], queries[found[-1] + 1 :])
        else:
            share, runs = overall, (queries,)
        for run in runs:
            if len(run) <= length and (1 - share) ** np.count_nonzero(tried[run]) < UNLIKELY:
                against[run] = True
    return against


def between(loops: np.ndarray, match: np.ndarray, sequence: SequenceSettings) -> np.ndarray:
    """Return the queries (Q,) between two loops of one line whose matches are on it, as at least half of them are.

    Nothing leads a match there but the place itself, though its score is no greater than chance makes some.
    """
    filled = np.zeros_like(loops)
    for first, last in pairwise(np.flatnonzero(loops).tolist()):
        way, moved = last - first, match[last] - match[first]
        if way > 1 and sequence.slowest * way - WINDOW <= moved <= sequence.fastest * way + WINDOW:
            line = match[first] + moved * np.arange(1, way) / way
            on = np.abs(match[first + 1 : last] - line) <= WINDOW
            filled[first + 1 : last] = on & (np.mean(on) >= MOST)
    return filled


def stretches(loops: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the number of the stretch of each query (Q,): loops that are neighbors, or neighbors of these."""
    linked = pairs[loops[pairs].all(axis=1)]
    links = coo_matrix((np.ones(len(linked)), linked.T), shape=(len(loops), len(loops)))
    return connected_components(links, directed=False)[1]


def neighbors(match: np.ndarray, sequence: SequenceSettings) -> np.ndarray:
    """Return pairs (N, 2) of queries, the earlier first, whose matches lie on the line through one another.

    The line has the length and the velocities of the ``sequence``, and is ``WINDOW`` references wide to each side.
    """
    pairs = []
    for step in range(1, max(WINDOW, sequence.length // 2) + 1):
        moved = match[step:] - match[:-step]
        low, high = sequence.slowest * step - WINDOW, sequence.fastest * step + WINDOW
        earlier = np.flatnonzero((moved >= low) & (moved <= high))
        pairs.append(np.stack([earlier, earlier + step], axis=1))
    return np.concatenate(pairs)
