"""Step 5 of :mod:`loopclosure.methods.auto`: which matches are loops, by their lines and by their points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from loopclosure.lines.course import WINDOW, Course, on_course
from loopclosure.lines.points import SURE, asked, in_part, look_alike
from loopclosure.methods.contradiction import Visits
from loopclosure.methods.geometry import Matches
from loopclosure.methods.lines import Lines


@dataclass(frozen=True)
class Decision:
    """What became of the matches (Q,) bool.

    loops   these are accepted
    by_line of these, the ones whose sequence is more alike than chance; the others are by their points
    fell    matches of sequences that their points speak against
    part    matches of which enough points agree, but only a part of those that match
    alike   whether these are so many that places look alike, and a single image needs more points
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
    alike = look_alike(np.count_nonzero(part), np.count_nonzero(many))
    sure = matches.whole & (matches.evidence >= asked(alike))
    if lines is None:
        return Decision(sure, nothing, nothing, part, alike)
    pairs = neighbors(matches.match, lines.course)
    if not matches.by_lines:
        return Decision(grown(sure, matches.verified, pairs), nothing, nothing, part, alike)
    found = of_lines(matches, lines, sure, pairs)
    fell = fallen(found, matches, pairs, lines.course.length, scores, visits)
    by_line = found & ~fell
    by_line |= between(by_line, lines.match, lines.course) & (matches.match == lines.match)
    loops = grown(by_line | (sure & ~fell), lines.near & matches.verified & ~fell, pairs)
    return Decision(loops, by_line, fell, part, alike)


def of_lines(matches: Matches, lines: Lines, sure: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the queries (Q,) with an accepted line, of enough on a stretch, and those next to them above chance.

    A stretch has enough if these are as many as a line has steps, or one of them is ``sure`` (Q,) by its points: lines
    of neighbors share their steps, so one line by chance is a stretch of nearly its own length.
    """
    found = np.zeros_like(matches.line)
    for queries in stretches(matches.line, pairs):
        found[queries] = len(queries) >= lines.course.length or sure[queries].any()
    return grown(found, lines.above_decoys & (matches.match == lines.match), pairs)


def fallen(
    found: np.ndarray, matches: Matches, pairs: np.ndarray, length: int, scores: np.ndarray, visits: Visits | None
) -> np.ndarray:
    """Return the loops (Q,) of lines of this length that points speak against: ends of stretches, and whole ones.

    An end is a run without a verified match. One that is longer than a line is several lines, which tell enough: half a
    drive may be in another light. A shorter one may be the end of the line through the last place of a loop.
    """
    fell = np.zeros_like(found)
    for queries in stretches(found, pairs):
        verified = np.flatnonzero(matches.verified[queries])
        first, end = (verified[0], verified[-1] + 1) if len(verified) else (0, len(queries))
        for run in (queries[:first], queries[end:]):
            fell[run] = len(run) <= length and _against(run, matches, scores, visits)
        rest = queries[~fell[queries]]
        fell[rest] = _against(rest, matches, scores, visits)
    return fell


def _against(queries: np.ndarray, matches: Matches, scores: np.ndarray, visits: Visits | None) -> bool:
    """Return whether points speak against all matches of a run of a stretch, the ``queries`` (n,).

    Either too few are verified for one place, or of those that are, most agree only in part.
    """
    tried = queries[matches.tried[queries]]
    verified = tried[matches.verified[tried]]
    if in_part(len(verified), np.count_nonzero(matches.whole[verified])):
        return True
    if visits is None or not len(tried):
        return False
    similarity = float(np.median(scores[tried, matches.match[tried]]))
    return visits.contradict(similarity, len(verified), len(tried))


def grown(loops: np.ndarray, possible: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return loops (Q,) with those of the ``possible`` ones that are neighbors of loops, and neighbors of these."""
    found = np.zeros_like(loops)
    for queries in stretches(loops | possible, pairs):
        found[queries] = loops[queries].any()
    return found


def stretches(loops: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """Return the queries of each stretch of loops (Q,): loops that are neighbors, and neighbors of these."""
    linked = pairs[loops[pairs].all(axis=1)]
    links = coo_matrix((np.ones(len(linked)), linked.T), shape=(len(loops), len(loops)))
    numbers, queries = connected_components(links, directed=False)[1], np.flatnonzero(loops)
    return [queries[numbers[queries] == number] for number in np.unique(numbers[queries])]


def between(loops: np.ndarray, match: np.ndarray, course: Course) -> np.ndarray:
    """Return the queries (Q,) between two loops of one line whose matches are on it.

    Nothing leads a match there but the place itself, though its score is no greater than chance makes some.
    """
    filled = np.zeros_like(loops)
    for first, last in pairwise(np.flatnonzero(loops).tolist()):
        way, moved = last - first, match[last] - match[first]
        if way > 1 and on_course(moved, way, course):
            line = match[first] + moved * np.arange(1, way) / way
            filled[first + 1 : last] = np.abs(match[first + 1 : last] - line) <= WINDOW
    return filled


def neighbors(match: np.ndarray, course: Course) -> np.ndarray:
    """Return pairs (N, 2) of queries, the earlier first, whose matches lie on the line through one another.

    The line has the length, the speed and the direction of the ``course``, and is ``WINDOW`` references wide to each
    side.
    """
    pairs = []
    for step in range(1, max(WINDOW, course.length // 2) + 1):
        earlier = np.flatnonzero(on_course(match[step:] - match[:-step], step, course))
        pairs.append(np.stack([earlier, earlier + step], axis=1))
    return np.concatenate(pairs)
