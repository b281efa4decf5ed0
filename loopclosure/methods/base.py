"""The interface of a place-recognition method, and the names of the methods on the command line.

A method gets the images of the queries and of the references and returns one matrix of scores. So all methods can be
compared in one table, whether they use features of a net, words or sequences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.verification import Pairs
from loopclosure.errors import InputError
from loopclosure.places.frames import read_gray
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.progress import Progress, timed

BLOCK = 512  # rows of a matrix of scores that are processed at a time, which limits the memory


@dataclass(frozen=True)
class Images:
    """The sequences for a method: those of a DataSet without its truth, and training images.

    queries     Q image files
    references  R image files; None for one sequence that visits its own places again: the queries are the references,
                and frame i may match an earlier frame
    train       training images, for example for vocabularies; if it is empty, a method that needs them raises
                InputError
    """

    queries: ImageSequence
    references: ImageSequence | None = None
    train: list[Path] = field(default_factory=list)

    @classmethod
    def of_files(
        cls, queries: Sequence[Path], references: Sequence[Path] | None = None, train: Sequence[Path] = ()
    ) -> Images:
        """Make images from files only."""
        others = None if references is None else ImageSequence.of_files(references)
        return cls(ImageSequence.of_files(queries), others, list(train))

    @property
    def database(self) -> ImageSequence:
        """The images that are searched: the references, or the queries themselves in one sequence."""
        return self.queries if self.references is None else self.references

    @property
    def tested(self) -> list[Path]:
        """The queries, then the references if they are other images."""
        return [*self.queries.paths, *(() if self.references is None else self.references.paths)]


@dataclass
class MethodResult:
    """The result of a method.

    scores           (Q, R) floats, higher = more similar; NaN if the method gives no score (the upper triangle of an
                     online one)
    seconds          stage -> total seconds, in the order of the stages
    notes            sentences for the report: settings, sizes of vocabularies, what was left out
    training_stages  the stages that run once, on training images, not for each frame
    answer           the results for the queries, for a method that decides by itself what is a loop
    """

    scores: np.ndarray
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    training_stages: tuple[str, ...] = ()
    answer: str = ""


class Method(Protocol):
    """A place-recognition method, for example a dataclass with its settings as fields."""

    @property
    def name(self) -> str:
        """The name in reports."""
        ...

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score each query against each reference."""
        ...


@dataclass(frozen=True)
class MethodContext:
    """What a method may need to know about the evaluation.

    exclude_frames   in one sequence, frames with |i - j| <= exclude_frames are not candidates (SeqSLAM needs this
                     before the search)
    seed             the seed of all random numbers
    pairs            verified pairs, shared by all methods of a run
    """

    exclude_frames: int = 0
    seed: int = 0
    pairs: Pairs = field(default_factory=lambda: Pairs(read_gray))


def earlier(frames: int, exclude: int) -> np.ndarray:
    """Return which pairs (query, reference) of one sequence can be loops: reference < query - exclude, (n, n) bool."""
    return np.tri(frames, frames, -1 - exclude, dtype=bool)


def refuse_overlap(train_images: Sequence[Path], test_images: Sequence[Path], model: str | Path = "") -> None:
    """Raise InputError if an image is used for both training and testing, which would make the result too good."""
    trained = {Path(path).resolve() for path in train_images}
    shared = [path for path in test_images if Path(path).resolve() in trained]
    if shared:
        raise InputError(
            f"{len(shared)} of {len(test_images)} test images are training images too, the first is {shared[0]}; "
            "train on images of other places",
            model,
        )


def describe_each(
    images: Images, stage: str, describe: Callable[[Path], np.ndarray], progress: Progress, seconds: dict[str, float]
) -> list[np.ndarray]:
    """Return the result of ``describe`` for each tested image; the time is added to ``stage``."""
    found = []
    for path in progress(images.tested, stage, len(images.tested)):
        with timed(seconds, stage):
            found.append(describe(path))
    return found


def compared(
    rows: Sequence[np.ndarray],
    images: Images,
    metric: str,
    seconds: dict[str, float],
    views: int = 1,
) -> MethodResult:
    """Compare the descriptors (D,) of the tested images, each with ``views`` views; add the time to ``seconds``."""
    with timed(seconds, "similarity"):
        queries, references = np.split(np.array(rows), [len(images.queries)])
        scores = similarity_matrix(queries, None if images.references is None else references, metric, views)
    return MethodResult(scores, seconds, [f"{len(rows[0])} dimensions, {metric}"])
