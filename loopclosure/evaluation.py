"""Evaluates methods on a data set: their scores, precision and recall, and times.

Measures are computed by two conventions, over all pairs and over the best match of each query. With poses they are
computed by two angles: by that of the rule, and by 45 degrees, up to which views of one place share what they see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from loopclosure.closing.measure import Loop, errors_said, measure
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method
from loopclosure.places.datasets import DataSet
from loopclosure.places.same_place import WIDE_ANGLE_DEG
from loopclosure.places.truth import Truth
from loopclosure.precision_recall import ALL_PAIRS, BestMatches, JudgedScores, PrecisionRecall
from loopclosure.progress import Progress, silent

RECALL_AT = (1, 5, 10)
WIDE = f"; {WIDE_ANGLE_DEG:g} degrees"  # follows the convention of measures by the wide angle
MOST_MEASURED = 200  # loops of a method whose relative pose is measured


@dataclass(frozen=True)
class Judgment:
    """The measures of a matrix of scores by one truth.

    pairs      the curve over all pairs
    best       the curve of the best match of each query
    matches    the best match of each query
    recall_at  k -> share of the queries with a loop for which the best k references include one
    """

    pairs: PrecisionRecall
    best: PrecisionRecall
    matches: BestMatches
    recall_at: dict[int, float]

    @classmethod
    def of(cls, scores: np.ndarray, truth: Truth) -> Judgment:
        """Compute the measures of scores (Q, R) against a truth."""
        judged = JudgedScores(scores, truth)
        return cls(
            judged.all_pairs_curve(), judged.best_match_curve(), judged.best_matches, judged.recall_at(RECALL_AT)
        )

    def answered(self) -> str:
        """Return as text the precision and recall of a method that accepts every best match with a score."""
        if not len(self.best.recall):
            return "nothing accepted, recall 0"
        return f"precision {self.best.precision[-1]:.3f}, recall {self.best.recall[-1]:.3f}"

    def measures(self, angle: str = "") -> dict[str, dict[str, float]]:
        """Return convention + ``angle`` -> name of the measure -> value in 0..1."""
        table = {
            curve.convention + angle: {
                "average precision": curve.average_precision,
                "recall at 100 % precision": curve.recall_at_full_precision,
                "best F1": curve.best_f1,
            }
            for curve in (self.pairs, self.best)
        }
        table[self.best.convention + angle].update({f"recall at {k}": value for k, value in self.recall_at.items()})
        return table


@dataclass(frozen=True)
class Outcome:
    """The result of one method on one data set.

    scores   (Q, R) of the method, higher = more similar
    rule     the measures by the truth of the data set
    wide     the measures by the wide angle; None without poses
    seconds  stage -> total seconds
    training_stages  the stages that run once, on training images
    answer   for a method that makes its own decisions: a summary of them and of how many are right
    measured the errors of the poses that are measured for its loops, by the true poses; "" if there are none
    """

    name: str
    scores: np.ndarray
    rule: Judgment
    wide: Judgment | None
    seconds: dict[str, float]
    training_stages: tuple[str, ...]
    notes: list[str]
    answer: str = ""
    measured: str = ""

    @property
    def pairs(self) -> PrecisionRecall:
        """The curve over all pairs, by the rule."""
        return self.rule.pairs

    @property
    def best(self) -> PrecisionRecall:
        """The curve of the best match of each query, by the rule."""
        return self.rule.best

    @property
    def matches(self) -> BestMatches:
        """The best match of each query, judged by the rule."""
        return self.rule.matches

    @property
    def recall_at(self) -> dict[int, float]:
        """The recall at k by the rule, see :class:`Judgment`."""
        return self.rule.recall_at

    @property
    def seconds_on_frames(self) -> float:
        """Return the total seconds spent on the frames, without training."""
        return sum(seconds for stage, seconds in self.seconds.items() if stage not in self.training_stages)

    @property
    def shown(self) -> dict[str, dict[str, float]]:
        """The measures to print; NaN over all pairs for a method that scores only one pair per query."""
        measures = self.measures
        if self.answer:
            measures = {**measures, ALL_PAIRS: dict.fromkeys(measures[ALL_PAIRS], np.nan)}
        return measures

    @cached_property
    def measures(self) -> dict[str, dict[str, float]]:
        """The measures by both angles: convention and angle -> name of the measure -> value in 0..1."""
        return {**self.rule.measures(), **({} if self.wide is None else self.wide.measures(WIDE))}


@dataclass(frozen=True)
class Evaluation:
    """The results of all methods on one data set; ``train`` describes the training images, as text."""

    data: DataSet
    outcomes: list[Outcome]
    train: str = "no training images"

    @property
    def image_count(self) -> int:
        """Return the number of images a method has to describe."""
        return len(self.data.queries) + len(self.data.references or ())


def evaluate(
    data: DataSet,
    methods: Sequence[tuple[str, Method]],
    train_images: Sequence[Path] = (),
    train: str = "",
    progress: Progress = silent,
) -> Evaluation:
    """Run the methods on ``data``, one after the other, and judge each; ``train`` describes the training images."""
    names = [name for name, _ in methods]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f'two methods are called "{twice[0]}"; give them names, as in --method "first=features:a.npz"')
    outcomes = [judge(name, method, data, train_images, progress) for name, method in methods]
    return Evaluation(data, outcomes, train or f"{len(train_images)} training images")


def judge(
    name: str, method: Method, data: DataSet, train_images: Sequence[Path] = (), progress: Progress = silent
) -> Outcome:
    """Run one method and judge its scores."""
    result = method.score(Images(data.queries, data.references, list(train_images)), progress)
    rule = Judgment.of(result.scores, data.truth)
    unscored = int(np.count_nonzero(np.isnan(result.scores) & data.truth.judged))
    notes = list(result.notes)
    if unscored:
        judged = int(np.count_nonzero(data.truth.judged))
        notes.append(f"no score for {unscored} of {judged} judged pairs, which counts as no loop")
    wide = None if data.wide is None else Judgment.of(result.scores, data.wide)
    answer = ""
    if result.answer:
        angles = [("", rule)] + ([] if wide is None else [(f" by {WIDE_ANGLE_DEG:g} degrees", wide)])
        answer = "; ".join([result.answer, *(f"{judged.answered()}{angle}" for angle, judged in angles)])
        notes.append(answer)
    measured = measured_said(data, rule.matches, progress) if result.answer else ""
    notes += [measured] if measured else []
    return Outcome(
        name=name,
        scores=result.scores,
        rule=rule,
        wide=wide,
        seconds=result.seconds,
        training_stages=result.training_stages,
        notes=notes,
        answer=answer,
        measured=measured,
    )


def measured_said(data: DataSet, matches: BestMatches, progress: Progress = silent) -> str:
    """Measure the loops of a method in their images; return a sentence with the median errors by the true poses.

    It is empty for two sequences, and without a calibrated camera or poses. Of more than MOST_MEASURED loops, as many
    are measured, evenly spread.
    """
    frames = data.queries
    queries = np.flatnonzero(matches.reference >= 0)
    if data.references is not None or frames.camera is None or frames.poses is None or not len(queries):
        return ""
    some = queries[np.unique(np.linspace(0, len(queries) - 1, MOST_MEASURED).round().astype(int))]
    loops = [Loop(query, match) for query, match in zip(some.tolist(), matches.reference[some].tolist(), strict=True)]
    return errors_said(measure(frames, loops, frames.camera, frames.odometry, progress), frames.poses)
