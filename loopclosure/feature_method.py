"""Descriptors of files as a method of the judge, compared as they are or whitened: ``features`` on the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from loopclosure.baselines.images import refuse_overlap, timed
from loopclosure.baselines.settings import configure
from loopclosure.errors import InputError
from loopclosure.features import read_features
from loopclosure.methods import Method, MethodResult, Progress, Setting
from loopclosure.similarity import METRICS, check_metric, similarity_matrix
from loopclosure.whitening import COMPONENTS, Whitening, learn_whitening

# Where the settings of features:FILES[:METRIC][:SETTINGS] begin; after a comma, whiten= is a setting too and no file.
SETTINGS_BEGIN = re.compile(r":(?=\w+=)|,(?=whiten=)")


@dataclass(frozen=True)
class WhitenBy:
    """The settings of a whitening: the file ``whiten`` with descriptors of other images, none where it is empty."""

    whiten: str = ""
    components: int = COMPONENTS
    power: float = 1.0

    def learn(self, *tested: tuple[list[Path], np.ndarray]) -> Whitening:
        """Learn the whitening; refuse to learn it from what is ``tested``: N images with their descriptors (N, D)."""
        training = read_features(self.whiten)
        whitening = learn_whitening(training.features, self.components, self.power, self.whiten)
        for images, rows in tested:
            whitening.check(rows)
            refuse_overlap(training.described_too(images, rows), images, self.whiten)
        return whitening


@dataclass(frozen=True)
class FeatureMethod:
    """Descriptors from files, compared in one metric; one file for queries and references, or one for each."""

    query_file: Path
    reference_file: Path
    metric: str = "euclidean"
    whitening: WhitenBy = WhitenBy()

    @property
    def name(self) -> str:
        """The file's name, the metric, whether whitened."""
        return f"{self.query_file.stem} ({self.metric}{', whitened' if self.whitening.whiten else ''})"

    def score(
        self,
        query_images: list[Path],
        reference_images: list[Path] | None,
        train_images: list[Path],
        progress: Progress,
    ) -> MethodResult:
        """Score as :class:`loopclosure.methods.Method` says; the seconds of the net are those the file carries."""
        query_features = read_features(self.query_file)
        tested = [(query_images, query_features.rows_of(query_images))]
        if reference_images is not None:
            same = self.reference_file == self.query_file
            reference_features = query_features if same else read_features(self.reference_file)
            tested.append((reference_images, reference_features.rows_of(reference_images)))
        rows = [descriptors for _, descriptors in tested]
        notes = [f"{rows[0].shape[1]} dimensions, {self.metric}"]
        seconds: dict[str, float] = {}
        if np.isfinite(query_features.seconds_per_image):
            seconds["features"] = query_features.seconds_per_image * sum(len(images) for images, _ in tested)
        else:
            notes.append("the file does not say how long the features took")
        once: tuple[str, ...] = ()
        if self.whitening.whiten:
            once = ("training whitening",)
            with timed(seconds, *once):
                whitening = self.whitening.learn(*tested)
            with timed(seconds, "whitening"):
                rows = [whitening(descriptors) for descriptors in rows]
            notes.append(str(whitening))
        with timed(seconds, "similarity"):
            scores = similarity_matrix(rows[0], rows[1] if len(rows) == 2 else None, self.metric)
        return MethodResult(scores, seconds, notes, once)


def features(argument: str, setting: Setting, inner: Method | None) -> FeatureMethod:
    """Build the method ``features:FILES[:euclidean|cosine][:whiten=OTHER.npz,components=512,power=1]``.

    FILES is PATH.npz, or QUERIES.npz,REFERENCES.npz.
    """
    if inner is not None:
        raise InputError("features refines no other method; write features:PATH.npz")
    described, *settings = SETTINGS_BEGIN.split(argument, maxsplit=1)
    files, colon, metric = described.rpartition(":")
    if not colon or metric.endswith(".npz"):
        files, metric = described, METRICS[0]
    check_metric(metric)
    paths = [Path(name) for name in files.split(",") if name]
    if len(paths) not in (1, 2):
        raise InputError(f'"features:{argument}": expected features:PATH.npz, or two files with a comma between')
    (whitening,) = configure("features", "".join(settings), WhitenBy())
    if settings and not whitening.whiten:
        raise InputError(f'"features:{argument}": its settings are those of a whitening; add whiten=OTHER.npz')
    return FeatureMethod(paths[0], paths[-1], metric, whitening)
