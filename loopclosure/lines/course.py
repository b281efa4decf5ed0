"""How lines of similar pairs run: their length, their speed and their direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.lines.trajectories import SequenceSettings

WINDOW = 5  # references to each side of a line, and at least so many queries along it, where a loop has neighbors
LENGTHS = (10, 30)  # steps of a line that are tried; a stretch of the fewer matches needs no verified one
VELOCITIES = (0.8, 1.2, 0.1)  # least, greatest and step, as shares of the speed


@dataclass(frozen=True)
class Course:
    """How lines run: steps of a line, references for a query, and whether the references are passed backwards."""

    length: int
    speed: float = 1.0
    backwards: bool = False

    @property
    def sequence(self) -> SequenceSettings:
        """The search for such lines, among references in the order in which they are passed."""
        slowest, fastest, step = (self.speed * velocity for velocity in VELOCITIES)
        return SequenceSettings(self.length, slowest, fastest, step, contrast=0)

    def __str__(self) -> str:
        s, back = self.sequence, ", backwards" if self.backwards else ""
        return f"sequences of {s.length} frames, at {s.slowest:.3g} to {s.fastest:.3g} times the speed{back}"


def on_course(moved: np.ndarray | int, way: int, course: Course) -> np.ndarray | bool:
    """Return which matches that ``moved`` so many references are on one line, over ``way`` queries."""
    ahead, sequence = -moved if course.backwards else moved, course.sequence
    return (sequence.slowest * way - WINDOW <= ahead) & (ahead <= sequence.fastest * way + WINDOW)
