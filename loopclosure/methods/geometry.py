"""Which matches geometry makes loops, where it can tell: the verification of :mod:`loopclosure.methods.auto`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from loopclosure.detector.verification import DOUBTLESS, LEAST_MATCHES, SURE, Agreement, Between, GeometricCheck
from loopclosure.methods.candidates import Candidates
from loopclosure.methods.decoys import UNEVEN, Lines, Matches, threshold
from loopclosure.methods.seqslam import SequenceSettings
from loopclosure.progress import Progress

SAMPLE = 40  # matches, and unlike pairs, that tell whether verification works
# The share of what sequences accept, or without sequences the number of matches, that verification must find.
LEAST_SHARE, LEAST_FOUND = 0.5, 3
# At most this share of unlike pairs has the evidence by which a match is verified.
RARELY = 0.05
WINDOW = 5  # references beside a line, and at least so many queries along it, that a verified pair vouches for
BESIDE = SequenceSettings(2 * WINDOW, *UNEVEN)  # the line through a single image that is a loop by itself

COUNTS = "so a match counts if it does, lies between two that do, or is of a stretch where few do"

Agree = Callable[[int, int], Agreement]


@dataclass(frozen=True)
class Geometry:
    """Verification, and how it does here.

    check, agree  of a query and a reference, by number
    unlike  the evidence of pairs that the scores call unlike; None where nothing can be verified
    said    what was tried, in a sentence
    seldom  it finds few of the matches of sequences, but no unlike pairs
    """

    check: GeometricCheck
    agree: Agree
    unlike: np.ndarray | None
    said: str
    seldom: bool = False

    def rare(self, evidence: np.ndarray) -> np.ndarray:
        """Return which evidence (Q,) is enough, and more than nearly all unlike pairs have."""
        assert self.unlike is not None
        return (evidence >= 1) & (evidence > np.quantile(np.append(0.0, self.unlike), 1 - RARELY))

    def common(self, evidence: float) -> bool:
        """Whether more than half of the unlike pairs have this evidence."""
        assert self.unlike is not None
        return bool(np.count_nonzero(self.unlike >= evidence) > LEAST_SHARE * len(self.unlike))


def try_geometry(given: Candidates, matches: Matches, check: GeometricCheck, agree: Agree) -> Geometry:
    """Verify some matches and some unlike pairs."""
    accepted, match = matches.accepted, matches.match
    pairs, hidden = _unlike(given), ""
    if isinstance(agree, Between) and pairs:
        fixed = pairs + _left(given)
        agree = agree.without_fixed([(int(given.queries[q]), int(given.references[r])) for q, r in fixed])
        if agree.hidden:
            hidden = f" ({100 * agree.hidden:.1f} % of the image never changes, and is left out)"

    def of_part(query: int, reference: int) -> Agreement:
        return agree(int(given.queries[query]), int(given.references[reference]))

    likely = np.flatnonzero(accepted) if accepted.any() else np.argsort(-matches.score, kind="stable")[:SAMPLE]
    likely = _sample(likely[match[likely] >= 0])
    if not len(likely):
        return Geometry(check, of_part, None, "verification: not tried, no query has a candidate")
    same = sum(check.enough(of_part(int(query), int(match[query]))) > 0 for query in likely)
    against = np.array([check.evidence(of_part(query, reference)) for query, reference in pairs])
    unlike = np.count_nonzero(against >= 1)
    found = f"{same} of {len(likely)} matches and {unlike} of {len(against)} unlike pairs"
    tried = f"verification: {found} show the same points{hidden}"
    if accepted.any() and LEAST_FOUND <= same < LEAST_SHARE * len(likely) and unlike <= RARELY * len(against):
        return Geometry(check, of_part, against, f"{tried}, {COUNTS}", seldom=True)
    if same < (LEAST_SHARE * len(likely) if accepted.any() else LEAST_FOUND):
        said = f"{tried}: these images cannot be verified, so it rejects nothing"
        return Geometry(check, of_part, None, said)
    # Unlike pairs of a small place, a desk, do show the same things, and so does a dashboard in all images.
    if unlike > LEAST_SHARE * len(against):
        said = f"{tried}: something is the same in all images, so a match needs far more points"
    else:
        said = f"{tried}, {COUNTS}"
    return Geometry(check, of_part, against, said)


def _sample(numbers: np.ndarray) -> np.ndarray:
    """Return at most ``SAMPLE`` of some numbers, evenly spread."""
    if not len(numbers):
        return numbers
    return numbers[np.unique(np.linspace(0, len(numbers) - 1, SAMPLE).round().astype(int))]


def _unlike(given: Candidates) -> list[tuple[int, int]]:
    """Return pairs that the scores call unlike."""
    known, pairs = given.known(), []
    for query in _sample(np.flatnonzero(np.count_nonzero(np.isfinite(known), axis=1) >= 8)):
        order = np.argsort(known[query], kind="stable")
        candidates = order[np.isfinite(known[query, order])]
        # One of the least alike quarter, another quarter of them each time.
        pairs.append((int(query), int(candidates[int(query) % max(1, len(candidates) // 4)])))
    return pairs


def _left(given: Candidates) -> list[tuple[int, int]]:
    """Return pairs of one drive whose second place was left just before: other places in the same light."""
    if given.two:
        return []
    queries = _sample(np.flatnonzero(given.allowed.any(axis=1)))
    return [(int(query), int(np.flatnonzero(given.allowed[query])[-1])) for query in queries]


def verify(given: Candidates, lines: Lines | None, matches: Matches, geometry: Geometry, progress: Progress) -> None:
    """Verify each query's match, or its best single image, which then becomes its match."""
    check, single, there = geometry.check, given.single, matches.there
    for query in progress(np.flatnonzero(there), "verification", int(np.count_nonzero(there))):
        # Lamps of a tunnel repeat: one image that is verified does not overrule a sequence that is accepted.
        other = matches.match if matches.accepted[query] else single
        for reference in dict.fromkeys((int(matches.match[query]), int(other[query]))):
            agreement = geometry.agree(int(query), reference)
            matches.inliers[query] = check.enough(agreement)
            matches.evidence[query] = check.evidence(agreement)
            matches.few[query] = agreement.matches < LEAST_MATCHES
            if matches.inliers[query]:
                matches.match[query] = reference
                break
    if lines is not None:
        score = np.where(matches.match == lines.match, lines.targets, lines.alone)
        matches.score = np.where(there & ~np.isnan(score), score, -np.inf)


def kept(matches: Matches, geometry: Geometry, lines: Lines | None, precision: float) -> np.ndarray:
    """Return the queries (Q,) whose matches, which were verified, are loops."""
    unlike, evidence, accepted = geometry.unlike, matches.evidence, matches.accepted
    assert unlike is not None
    pairs = _neighbors(matches.match, lines)
    if geometry.seldom:
        return accepted & _vouched(accepted & (matches.inliers > 0), accepted, pairs)
    # What verification alone finds must be better than what it finds in pairs that are no loop. Where sequences tell
    # loops, it must be beyond doubt: the stripes of a curb repeat, and unlike pairs may all be of another road.
    least = max(SURE if lines is None else DOUBTLESS, threshold(evidence, unlike, precision))
    if not geometry.common(DOUBTLESS):
        least = min(least, DOUBTLESS)
    # From afar a place is seen before the camera is there: other queries fit it better.
    near = np.ones(len(accepted), bool) if lines is None else lines.near
    sure = near & (evidence >= least)
    verified = sure | accepted if geometry.common(1) else geometry.rare(evidence)
    loops = sure | (accepted & _vouched(verified, accepted, pairs))
    while np.any(more := verified & near & np.any(_beside(loops, pairs), axis=0) & ~loops):
        loops |= more
    return loops


def _vouched(verified: np.ndarray, accepted: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return which queries (Q,) are verified, lie between two that are, or are of a stretch of which few are.

    Past the last verified match a loop has ended, though the line through it goes on; but not where few are verified.
    """
    before, after = _beside(verified, pairs)
    linked = pairs[accepted[pairs].all(axis=1)]
    links = coo_matrix((np.ones(len(linked)), linked.T), shape=(len(verified), len(verified)))
    stretch = connected_components(links, directed=False)[1]
    share = np.bincount(stretch, verified) / np.bincount(stretch)
    return verified | (before & after) | ((share > 0) & (share < LEAST_SHARE))[stretch]


def _beside(which: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the queries that have one of ``which`` (Q,) before them, and after, among their neighbors."""
    before, after = np.zeros_like(which), np.zeros_like(which)
    earlier, later = pairs.T
    before[later[which[earlier]]] = True
    after[earlier[which[later]]] = True
    return before, after


def _neighbors(match: np.ndarray, lines: Lines | None) -> np.ndarray:
    """Return pairs (N, 2) of queries, the earlier first, whose matches lie on the line through one another.

    The line has the length and the velocities of the sequences, and is ``WINDOW`` references wide to each side; without
    lines there are no pairs.
    """
    if lines is None:
        return np.empty((0, 2), int)
    sequence, pairs = lines.setting.sequence or BESIDE, []
    for step in range(1, max(WINDOW, sequence.length // 2) + 1):
        moved = match[step:] - match[:-step]
        low, high = sequence.slowest * step - WINDOW, sequence.fastest * step + WINDOW
        earlier = np.flatnonzero((moved >= low) & (moved <= high))
        pairs.append(np.stack([earlier, earlier + step], axis=1))
    return np.concatenate(pairs)
