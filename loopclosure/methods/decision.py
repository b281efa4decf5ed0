"""Step 5 of :mod:`loopclosure.methods.auto`: which matches are loops, by their lines and by their points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from loopclosure.detector.verification import SURE
from loopclosure.lines.course import Course
from loopclosure.methods.contradiction import Visits
from loopclosure.methods.geometry import Matches
from loopclosure.methods.lines import LENGTHS, Lines

WINDOW = 5  # references to each side of a line, and at least so many queries along it, where a loop has neighbors
LEAST_VERIFIED = 3  # fewer verified matches of a stretch do not tell whether they agree only in part
UNLIKELY = 0.05  # that so many matches in a row are not verified, at the share that is


@dataclass(frozen=True)
class Decision:
    """What became of the matches (Q,) bool.

    loops   these are accepted
    by_line of these, the ones whose sequence is more alike than chance; the others are by their points
    fell    matches of sequences that their points speak against
    part    matches of which enough points agree, but only a part of those that match: places look alike
    alike   whether places look alike so often that no single image is accepted
    """

    loops: np.ndarray
    by_line: np.ndarray
    fell: np.ndarray
    part: np.ndarray
    alike: bool


def decide(matches: Matches, lines: Lines | None, scores: np.ndarray, visits: Visits | None = None) -> Decision:
    """Decide which matches are loops.

    scores  (Q, R) the similarity of each pair
    visits  what frames of one visit have in common; None: not known
    """
    many, nothing = matches.evidence >= SURE, np.zeros(len(matches.match), bool)
    part = many & ~matches.whole
    alike = 2 * np.count_nonzero(part) > np.count_nonzero(many)
    sure = nothing if alike else many & matches.whole
    if lines is None:
        return Decision(sure, nothing, nothing, part, alike)
    pairs = neighbors(matches.match, lines.course)
    if not matches.by_lines:
        return Decision(grown(sure, matches.verified, pairs), nothing, nothing, part, alike)
    found = of_lines(matches, lines, pairs)
    fell = contradicted(found, matches.verified, matches.tried, pairs, lines.course.length)
    fell |= fallen(found & ~fell, matches, pairs, scores, visits)
    by_line = found & ~fell
    by_line |= between(by_line, lines.best.match, lines.course) & (matches.match == lines.best.match)
    loops = grown(by_line | (sure & ~fell), lines.near & matches.verified & ~fell, pairs)
    return Decision(loops, by_line, fell, part, alike)


def of_lines(matches: Matches, lines: Lines, pairs: np.ndarray) -> np.ndarray:
    """Return the queries (Q,) with an accepted line, of enough on a stretch, and those next to them above chance."""
    label = stretches(matches.line, pairs)
    many = np.bincount(label, matches.line)[label] >= LENGTHS[0]
    seeds = matches.line & (many | (np.bincount(label, matches.verified & matches.line)[label] > 0))
    return grown(seeds, lines.above_decoys & (matches.match == lines.best.match), pairs)


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


def fallen(
    loops: np.ndarray, matches: Matches, pairs: np.ndarray, scores: np.ndarray, visits: Visits | None
) -> np.ndarray:
    """Return the loops (Q,) of stretches whose points speak against all of it.

    Either too few are verified for one place, or of those that are, most agree only in part.
    """
    stretch, against = stretches(loops, pairs), np.zeros_like(loops)
    for number in np.unique(stretch[loops]):
        queries = np.flatnonzero(loops & (stretch == number))
        tried = queries[matches.tried[queries]]
        verified = tried[matches.verified[tried]]
        in_part = len(verified) >= LEAST_VERIFIED and 2 * np.count_nonzero(matches.whole[verified]) < len(verified)
        similarity = float(np.median(scores[tried, matches.match[tried]])) if len(tried) else 0.0
        against[queries] = in_part or (visits is not None and visits.contradict(similarity, len(verified), len(tried)))
    return against


def between(loops: np.ndarray, match: np.ndarray, course: Course) -> np.ndarray:
    """Return the queries (Q,) between two loops of one line whose matches are on it.

    Nothing leads a match there but the place itself, though its score is no greater than chance makes some.
    """
    filled = np.zeros_like(loops)
    for first, last in pairwise(np.flatnonzero(loops).tolist()):
        way, moved = last - first, match[last] - match[first]
        if way > 1 and _on_course(moved, way, course):
            line = match[first] + moved * np.arange(1, way) / way
            filled[first + 1 : last] = np.abs(match[first + 1 : last] - line) <= WINDOW
    return filled


def stretches(loops: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the number of the stretch of each query (Q,): loops that are neighbors, or neighbors of these."""
    linked = pairs[loops[pairs].all(axis=1)]
    links = coo_matrix((np.ones(len(linked)), linked.T), shape=(len(loops), len(loops)))
    return connected_components(links, directed=False)[1]


def neighbors(match: np.ndarray, course: Course) -> np.ndarray:
    """Return pairs (N, 2) of queries, the earlier first, whose matches lie on the line through one another.

    The line has the length, the speed and the direction of the ``course``, and is ``WINDOW`` references wide to each
    side.
    """
    pairs = []
    for step in range(1, max(WINDOW, course.length // 2) + 1):
        earlier = np.flatnonzero(_on_course(match[step:] - match[:-step], step, course))
        pairs.append(np.stack([earlier, earlier + step], axis=1))
    return np.concatenate(pairs)


def _on_course(moved: np.ndarray, way: int, course: Course) -> np.ndarray:
    """Return which matches that ``moved`` so many references are on one line, over ``way`` queries."""
    ahead, sequence = -moved if course.backwards else moved, course.sequence
    return (sequence.slowest * way - WINDOW <= ahead) & (ahead <= sequence.fastest * way + WINDOW)
