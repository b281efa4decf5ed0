"""The one decision on which frames are loops, of a recording, of a session of a map, and of a robot's frames.

Scores of one frame after another go in, and loops come out: those of a robot at once by their points, or ``HALF``
frames later, when the line through a frame is known; those of a recording at its end. What is known of the drive by
then is all that differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from loopclosure.decision.constants import AGES, PRECISION, SAMPLE, SURE, VELOCITIES, WINDOW
from loopclosure.decision.growing import Growing
from loopclosure.decision.lines import Best, Course, Lines, courses, neighbors
from loopclosure.decision.points import in_part, look_alike, too_few, wrong_share
from loopclosure.decision.visits import Usual, Visits, outstanding
from loopclosure.errors import InputError


class Agreement(Protocol):
    """How many points of two images agree."""

    @property
    def whole(self) -> bool:
        """Whether most points that match agree."""
        ...


class Check(Protocol):
    """A geometric check; see :class:`loopclosure.detector.verification.GeometricCheck`."""

    def enough(self, found: Any) -> int:
        """Return the inliers of an agreement; 0 if chance explains them."""
        ...

    def evidence(self, found: Any, unlike: float = 0.0) -> float:
        """Return the inliers divided by the number needed; ``unlike``: so many more than rule out chance."""
        ...


Agree = Callable[[int, int], Agreement]


@dataclass(frozen=True)
class Settings:
    """What a decision is asked for.

    precision   the share of the accepted loops that should be right
    courses     on which lines are searched
    """

    precision: float = PRECISION
    courses: tuple[Course, ...] = tuple(courses())

    def __post_init__(self) -> None:
        if not 0 < self.precision < 1:
            raise InputError(f"precision is {self.precision:g}; expected more than 0 and less than 1")


@dataclass(frozen=True)
class Looked:
    """What the points of a single image say.

    match    the reference, -1 without one
    inliers  how many points agree, 0 if chance explains them; None if none was verified
    wrong    the share of wrong ones that is expected among images as good
    part     enough points agree, but only a part of those that match
    """

    match: int
    inliers: int | None = None
    wrong: float = 1.0
    part: bool = False


@dataclass(frozen=True)
class Decision:
    """What became of queries (n,).

    match     the best reference of each, -1 without one
    loops     bool: it is a loop
    by_line   bool: of these, those whose sequence is more alike than chance; the others are by their points
    fell      bool: matches of sequences that their points speak against
    part      bool: enough points agree, but only a part of those that match
    wrong     the share of wrong ones that is expected among the loops that are as good, counted per stretch
    evidence  of the match: its inliers divided by the number needed; NaN if it was not verified
    inliers   of the match, 0 if chance explains them, -1 if it was not verified
    line      the best line of each
    single    the score of the best image of each, -inf without one
    """

    match: np.ndarray
    loops: np.ndarray
    by_line: np.ndarray
    fell: np.ndarray
    part: np.ndarray
    wrong: np.ndarray
    evidence: np.ndarray
    inliers: np.ndarray
    line: Best
    single: np.ndarray


class Decider:
    """Decides on the queries of one drive, which are given one after the other.

    check, agree  verification of a query and a reference, by number; None: there are no images
    among         verification of two queries; None: they cannot be compared
    usual         what is known of the drive as a whole; None: what was seen of it so far
    """

    def __init__(
        self,
        settings: Settings | None = None,
        check: Check | None = None,
        agree: Agree | None = None,
        among: Agree | None = None,
        usual: Usual | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self.check, self._agree, self._among = check, agree, among
        self.usual, self._known = usual or Usual(), usual is not None
        self.lines = Lines(self.settings.courses)
        self._visits = Visits()
        self._before = Growing(AGES)  # the scores of each query with those before it, NaN where not known
        # Of each query: its best image, and its score; the reference that was verified as an image, its evidence, its
        # inliers and whether it is whole; the same of its line. NaN where nothing was verified.
        self._single, self._image, self._line = Growing(2), Growing(4), Growing(4)
        self._agreed = Growing(2)  # whether it has enough points, and whether these are only a part
        self._of_visits: dict[tuple[int, int], Agreement] = {}  # pairs of queries of one visit
        self._unlike: list[tuple[float, int]] = []  # pairs of different places: their score and points in common
        # The points in common of the less similar half of these, for at the start no frame is unlike; 0 if chance
        # explains them. The stripes of a curb repeat, and a desk is in all images of it.
        self.unlike: list[int] = []

    def __len__(self) -> int:
        return len(self._single)

    def add(
        self, scores: np.ndarray, own: np.ndarray, begin: int | None, possible: np.ndarray | None = None
    ) -> np.ndarray:
        """Add a query, and return which references (R,) may be its place.

        scores    (R,) with the references, higher = more similar, NaN where not known
        own       (n,) with the queries of the drive before it, NaN where not known
        begin     the first reference that is a query of this drive, which are the last ones; None: none is
        possible  (R,) bool, which references may be its place by what else is known; None: all
        """
        if not self._known:
            self.usual.add(own)
        before = np.full((AGES, 1), np.nan)
        before[: len(own), 0] = own[::-1][:AGES]
        self._before.append(before)
        candidates = np.isfinite(scores)
        if possible is not None:
            candidates &= possible
        old = candidates
        if begin is not None:
            candidates[begin:] &= self._visits.add(own, self.usual.score, self.usual.visit)
            old = candidates.copy()
            old[max(begin, len(scores) - self.usual.age) :] = False
        self.lines.add(outstanding(np.where(old, -scores, np.nan)), scores)
        single = int(np.where(candidates, scores, -np.inf).argmax()) if candidates.any() else -1
        self._single.append(np.array([[single], [scores[single] if single >= 0 else -np.inf]]))
        for of in (self._image, self._line):
            of.append(np.full((4, 1), np.nan))
        self._agreed.append(np.zeros((2, 1)))
        self._learn(scores, candidates)
        return candidates

    def _learn(self, scores: np.ndarray, candidates: np.ndarray) -> None:
        """Verify a pair of different places: of the least similar quarter, of another rank for each query."""
        query, there = len(self) - 1, np.flatnonzero(candidates)
        if self._agree is None or self.check is None or len(there) < 8 or query % (1 + len(self._unlike) // SAMPLE):
            return
        rank = query % (len(there) // 4)
        other = int(there[np.argpartition(scores[there], rank)[rank]])
        self._unlike.append((float(scores[other]), self.check.enough(self._agree(query, other))))
        self._note_unlike()

    def _note_unlike(self) -> None:
        self.unlike = [points for _, points in sorted(self._unlike)[: (len(self._unlike) + 1) // 2]]

    @property
    def agreed(self) -> tuple[int, int]:
        """How many queries have a match with enough points, and of how many of these only a part agrees."""
        many, part = self._agreed.array.sum(axis=1).astype(int).tolist()
        return many, part

    @property
    def alike(self) -> bool:
        """Whether places must be taken to look alike by now."""
        many, part = self.agreed
        return look_alike(part, many)

    def _evidence(self, found: Agreement) -> float:
        assert self.check is not None
        return self.check.evidence(found, sum(self.unlike) / max(1, len(self.unlike)))

    def _verified(self, query: int, reference: int) -> np.ndarray:
        """Verify a match; return the reference, its evidence, its inliers, and whether it is whole, (4,)."""
        assert self._agree is not None
        assert self.check is not None
        found = self._agree(query, reference)
        evidence = self._evidence(found)
        many = evidence >= SURE
        self._agreed.array[:, query] = np.maximum(self._agreed.array[:, query], (many, many and not found.whole))
        return np.array([reference, evidence, self.check.enough(found), found.whole])

    def look(self, query: int, references: Sequence[int] | None = None) -> Looked:
        """Verify references of a query as single images, until one is a loop by its points; None: the best one."""
        best = int(self._single.array[0, query])
        looked = Looked(best)
        for reference in ([best] if best >= 0 else []) if references is None else references:
            if self._agree is None:
                break
            found = self._verified(query, reference)
            _, evidence, inliers, whole = found.tolist()
            wrong = float(wrong_share(np.array([evidence]), self.alike)[0]) if whole else 1.0
            new = Looked(reference, int(inliers), wrong, bool(evidence >= SURE and not whole))
            if looked.inliers is None or new.wrong < looked.wrong:
                looked = new
                self._image.array[:, query] = found
            if self.is_loop(wrong):
                break
        return looked

    def is_loop(self, wrong: np.ndarray | float) -> Any:
        """Return whether so small a share of wrong ones is what is asked for."""
        return wrong <= (1 - self.settings.precision) * (1 + 1e-9)

    def decide(self, first: int, end: int, new: int = 0) -> Decision:
        """Decide on the queries from ``first`` to ``end``, whose lines are known, from all that is known by now.

        The matches of lines of queries from ``new`` on are verified, if they were not before.
        """
        line = self.lines.best(first, end)
        self._look_at_lines(first, line, new)
        return self._decided(first, line)

    def _look_at_lines(self, first: int, line: Best, new: int) -> None:
        """Verify the matches of lines of queries from ``new`` on, in so far as they are not verified yet."""
        near = np.isfinite(line.wrong) & (np.arange(first, first + len(line.match)) >= new)
        for k in np.flatnonzero((line.match >= 0) & near).tolist() if self._agree else ():
            query, match = first + k, int(line.match[k])
            if self._line.array[0, query] != match:
                same = self._image.array[0, query] == match
                self._line.array[:, query] = self._image.array[:, query] if same else self._verified(query, match)

    def _decided(self, first: int, line: Best) -> Decision:
        part = slice(first, first + len(line.match))
        single, similar = self._single.array[:, part]
        image = self._image.array[:, part]
        single = np.where(np.isfinite(image[0]), image[0], single).astype(int)
        by_line = np.where(self._line.array[0, part] == line.match, self._line.array[1:, part], np.nan)
        # A line is looked at further where in the whole drive less than one as good is expected by chance, or so many
        # that it is still few of all.
        expected = np.sort(line.wrong)
        few = self.is_loop(expected / np.arange(1, len(expected) + 1))
        member = (line.match >= 0) & (line.wrong <= max(1.0, expected[few].max(initial=0)))
        of_line = member | (np.nan_to_num(by_line[0]) > np.nan_to_num(image[1])) | (single < 0)
        match = np.where(of_line, line.match, single)
        evidence, inliers, whole = np.where(of_line, by_line, image[1:])
        verified, whole = evidence >= 1, whole > 0
        image_wrong = np.where(whole, wrong_share(np.nan_to_num(evidence), self.alike), 1.0)
        sure = self.is_loop(image_wrong)
        course = [line.courses[k] for k in line.of]
        speed, back = np.array([c.speed for c in course]), np.array([c.backwards for c in course], bool)
        length = np.array([c.length for c in course], float)
        pairs = neighbors(match, speed, back)
        pairs = pairs[(match[pairs] >= 0).all(axis=1)]
        # Of the stretches, those are loops of which as many wrong ones are expected as the precision allows.
        found, wrong = np.zeros_like(member), np.ones(len(match))
        made = stretches(member, pairs)
        levels = np.array([(line.wrong[queries] / (length[queries] / 2)).min() for queries in made])
        for number, k in enumerate(np.argsort(levels, kind="stable").tolist()):
            queries = made[k]
            wrong[queries] = share = min(1.0, levels[k] / (number + 1))
            # As many matches as a line has steps, and at as many places: one image may be like all of another place.
            passed = VELOCITIES[0] * (length * speed)[queries].min()
            enough = (1 / length[queries]).sum() >= 1 and len(np.unique(match[queries])) >= passed
            found[queries] = (enough and self.is_loop(share)) or sure[queries].any()
        fell = self._fallen(first, found, line.similar, verified, whole & verified, pairs, length)
        lines = found & ~fell
        filled = _between(lines, line.match, speed, back) & ~lines & ~sure
        lines, match = lines | filled, np.where(filled, line.match, match)
        evidence, inliers = np.where(filled, by_line[:2], (evidence, inliers))
        loops, wrong = np.zeros_like(found), np.minimum(wrong, image_wrong)
        for queries in stretches(lines | ((sure | verified) & ~fell), pairs):
            hits = queries[verified[queries]]
            by_points = not in_part(len(hits), np.count_nonzero(whole[hits]))
            starts = lines[queries].any() or sure[queries].any()
            loops[queries] = lines[queries] | (starts & by_points)
            wrong[queries] = np.where(self.is_loop(wrong[queries]), wrong[queries], wrong[queries].min())
        around = np.maximum.accumulate(np.where(lines & ~filled, np.arange(len(lines)), 0))
        wrong[filled] = wrong[around[filled]]
        return Decision(
            match,
            loops,
            loops & lines,
            fell,
            (evidence >= SURE) & ~whole,
            wrong,
            evidence,
            np.where(np.isfinite(inliers), inliers, -1).astype(int),
            line,
            similar,
        )

    def _fallen(
        self,
        first: int,
        found: np.ndarray,
        similar: np.ndarray,
        verified: np.ndarray,
        whole: np.ndarray,
        pairs: np.ndarray,
        length: np.ndarray,
    ) -> np.ndarray:
        """Return the loops of lines that points speak against: ends of stretches, and whole ones.

        An end is a run without a verified match. One that is longer than a line is several lines, which tell enough:
        half a drive may be in another light. A shorter one may be the end of the line through the last place of a loop.
        """
        fell = np.zeros_like(found)
        if self._agree is None:
            return fell
        for queries in stretches(found, pairs):
            seen = np.flatnonzero(verified[queries])
            start, end = (seen[0], seen[-1] + 1) if len(seen) else (0, len(queries))
            for run in (queries[:start], queries[end:]):
                if len(run):
                    fell[run] = len(run) <= length[run].max() and self._against(first, run, similar, verified, whole)
            rest = queries[~fell[queries]]
            fell[rest] = self._against(first, rest, similar, verified, whole)
        return fell

    def _against(
        self, first: int, run: np.ndarray, similar: np.ndarray, verified: np.ndarray, whole: np.ndarray
    ) -> bool:
        """Return whether points speak against all matches of a run of a stretch."""
        hits = int(np.count_nonzero(verified[run]))
        if in_part(hits, np.count_nonzero(whole[run])):
            return True
        if self._among is None or 2 * hits >= len(run):
            return False
        step = 2 ** max(0, int(np.ceil(np.log2(len(run) / SAMPLE))))  # the same ones while the run grows
        some = run[(first + run) % step == 0]
        visits = [self._of_visit(first + int(q), float(similar[q])) for q in some]
        seen = [each for each in visits if each is not None]
        unlike = sum(map(bool, self.unlike)), len(self.unlike)
        return too_few((hits, len(run)), self.usual.together, (sum(seen), len(seen)), unlike)

    def _of_visit(self, query: int, similarity: float) -> bool | None:
        """Return whether points of a query agree with those of a frame of its visit of no more than this similarity."""
        low = np.flatnonzero(self._before.array[:, query] <= similarity)
        if not len(low):
            return None
        assert self._among is not None
        pair = query, query - 1 - int(low[0])
        if pair not in self._of_visits:
            self._of_visits[pair] = self._among(*pair)
        return self._evidence(self._of_visits[pair]) >= 1

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that a file must store to continue."""
        growing = {f"decision_{name}": each.array for name, each in self._growing().items()}
        unlike = np.array(self._unlike, np.float64).reshape(-1, 2)
        return {**growing, **self.lines.arrays(), "decision_unlike": unlike}

    def take(self, arrays: dict[str, Any], count: int) -> None:
        """Continue from the arrays of a file after ``count`` queries, or none.

        Raises LookupError, TypeError or ValueError if they do not fit.
        """
        for name, each in self._growing().items():
            each.append(np.asarray(arrays[f"decision_{name}"], np.float64))
        self.lines.take(arrays)
        self._unlike = [(float(score), int(points)) for score, points in arrays["decision_unlike"].reshape(-1, 2)]
        self._note_unlike()
        counts = {self.lines.added, *map(len, (self._single, self._before, self._image, self._line, self._agreed))}
        if len(counts) > 1 or not counts <= {0, count}:
            raise ValueError(f"{counts} queries of {count}")

    def _growing(self) -> dict[str, Growing]:
        mine = {"before": self._before, "single": self._single, "image": self._image, "line": self._line}
        return {**mine, "agreed": self._agreed, **self.usual.growing(), **self._visits.growing()}


def stretches(loops: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    """Return the queries of each stretch of loops (Q,): loops that are neighbors, and neighbors of these."""
    linked = pairs[loops[pairs].all(axis=1)]
    numbers, queries = np.arange(len(loops)), np.flatnonzero(loops)
    while len(linked):  # each gets the number of the first query that it is linked to, until that is the stretch's
        np.minimum.at(numbers, linked.max(axis=1), linked.min(axis=1))
        while not np.array_equal(numbers, first := numbers[numbers]):
            numbers = first
        linked = numbers[linked]
        linked = linked[linked[:, 0] != linked[:, 1]]
    order = np.argsort(numbers[queries], kind="stable")
    return np.split(queries[order], np.flatnonzero(np.diff(numbers[queries][order])) + 1) if len(queries) else []


def _between(loops: np.ndarray, match: np.ndarray, speed: np.ndarray, backwards: np.ndarray) -> np.ndarray:
    """Return the queries (Q,) between two loops of one line whose matches are on it.

    Nothing leads a match there but the place itself, though its score is no greater than chance makes some.
    """
    filled = np.zeros_like(loops)
    slowest, fastest, _ = VELOCITIES
    for start, last in pairwise(np.flatnonzero(loops).tolist()):
        way, moved = last - start, match[last] - match[start]
        ahead = -moved if backwards[last] else moved
        if way > 1 and slowest * speed[last] * way - WINDOW <= ahead <= fastest * speed[last] * way + WINDOW:
            line = match[start] + moved * np.arange(1, way) / way
            filled[start + 1 : last] = np.abs(match[start + 1 : last] - line) <= WINDOW
    return filled
