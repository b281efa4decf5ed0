"""Ground truth: which pairs of frames show the same place, and which pairs are judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.errors import InputError


@dataclass(frozen=True)
class Exclusion:
    """Excludes pairs of one sequence that are too close in time to be a loop.

    A pair is excluded if |i - j| <= frames, or |t_i - t_j| < seconds. It is not a candidate, and it counts neither as
    right nor as wrong. A frame with itself is always excluded.
    """

    frames: int = 0
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if self.frames < 0 or not self.seconds >= 0:
            raise InputError(f"cannot exclude {self.frames} frames, {self.seconds:g} s; expected 0 or more")

    def excludes(
        self,
        queries: np.ndarray,
        references: np.ndarray,
        query_stamps: np.ndarray | None = None,
        reference_stamps: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return for each query frame (Q,) and reference frame (R,), given by number, whether the pair is excluded.

        The stamps (Q,), (R,) in seconds are needed if seconds are excluded. Returns (Q, R) bool.
        """
        near = np.abs(np.subtract.outer(queries, references)) <= self.frames
        if self.seconds > 0:
            if query_stamps is None or reference_stamps is None:
                raise InputError(f"{self.seconds:g} s are to be excluded, but the frames have no time; exclude frames")
            near |= np.abs(np.subtract.outer(query_stamps, reference_stamps)) < self.seconds
        return near

    def __str__(self) -> str:
        parts = []
        if self.frames:
            parts.append(f"at most {self.frames} {'frame' if self.frames == 1 else 'frames'} apart")
        if self.seconds:
            parts.append(f"less than {self.seconds:g} s apart")
        return f"pairs {' or '.join(parts)} excluded" if parts else "no pair excluded but each frame with itself"


@dataclass(frozen=True)
class Truth:
    """The ground truth for every pair of a query and a reference.

    hard      (Q, R) bool: the same place; must be found
    soft      (Q, R) bool, includes hard: a match that is not a mistake; a pair that is only soft is ignored if found
    judged    (Q, R) bool: the pairs that count; others are not candidates, and neither right nor wrong
    description  the rule for the same place and the exclusion; printed with every result
    """

    hard: np.ndarray
    soft: np.ndarray
    judged: np.ndarray
    description: str

    def __post_init__(self) -> None:
        assert self.hard.shape == self.soft.shape == self.judged.shape
        assert self.hard.dtype == self.soft.dtype == self.judged.dtype == bool
        assert not np.any(self.hard & ~self.soft), "soft truth includes the hard truth"

    @property
    def positives(self) -> int:
        """Return the number of judged pairs that show the same place."""
        return int(np.count_nonzero(self.hard & self.judged))

    @property
    def queries_with_a_loop(self) -> np.ndarray:
        """Return for each query (Q,) whether it has a loop."""
        return np.any(self.hard & self.judged, axis=1)


def sequence_truth(
    hard: np.ndarray,
    exclusion: Exclusion,
    rule: str,
    *,
    soft: np.ndarray | None = None,
    stamps: np.ndarray | None = None,
    comparable: np.ndarray | None = None,
) -> Truth:
    """Make the truth of one sequence that visits its own places again: frame i against each earlier frame j < i.

    hard, soft   (N, N) bool; only the lower triangle is read
    rule         text: what makes two frames the same place
    stamps       (N,) seconds
    comparable   (N, N) bool: pairs that can be judged (not a left with a right image); default: all
    """
    numbers = np.arange(len(hard))
    judged = np.tri(len(hard), k=-1, dtype=bool) & ~exclusion.excludes(numbers, numbers, stamps, stamps)
    if comparable is not None:
        judged &= comparable
    hard = np.asarray(hard, dtype=bool)
    soft = hard if soft is None else np.asarray(soft, dtype=bool) | hard
    description = f"{rule}; each frame against the earlier ones; {exclusion}{_soft_text(hard, soft, judged)}"
    return Truth(hard, soft, judged, description)


def traverse_truth(hard: np.ndarray, rule: str, *, soft: np.ndarray | None = None) -> Truth:
    """Make the truth of two traverses, hard and soft (Q, R) bool: each query against every reference."""
    hard = np.asarray(hard, dtype=bool)
    soft = hard if soft is None else np.asarray(soft, dtype=bool) | hard
    judged = np.ones(hard.shape, dtype=bool)
    description = f"{rule}; each query against all references; no pair excluded{_soft_text(hard, soft, judged)}"
    return Truth(hard, soft, judged, description)


def _soft_text(hard: np.ndarray, soft: np.ndarray, judged: np.ndarray) -> str:
    count = int(np.count_nonzero(soft & ~hard & judged))
    return f"; {count} pairs that nearly show the same place are ignored when found" if count else ""
