"""Descriptors from files as a method, with or without whitening: ``features`` on the command line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, check_metric, similarity_matrix
from loopclosure.descriptors.whitening import COMPONENTS, Whitening, learn_whitening
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, refuse_overlap
from loopclosure.methods.settings import configure
from loopclosure.progress import Progress, timed

# Where the settings of features:FILES[:METRIC][:SETTINGS] begin; after a comma, whiten= begins the settings too.
SETTINGS_BEGIN = re.compile(r":(?=\w+=)|,(?=whiten=)")


@dataclass(frozen=True)
class WhitenBy:
    """The settings of a whitening: the file ``whiten`` has descriptors of other images; empty: no whitening."""

    whiten: str = ""
    components: int = COMPONENTS
    power: float = 1.0

    def learn(self, *tested: tuple[Sequence[Path], np.ndarray]) -> Whitening:
        """Learn the whitening from all views in the file.

        Raises InputError if the file has an image that is ``tested``: N images, the descriptors (N, D) of their first
        views.
        """
        training = read_features(self.whiten)
        views = np.split(training.features, training.views, axis=1)
        whitening = learn_whitening(np.concatenate(views), self.components, self.power, self.whiten)
        for images, rows in tested:
            whitening.check(rows)
            refuse_overlap(replace(training, features=views[0]).also_described(images, rows), images, self.whiten)
        return whitening


@dataclass(frozen=True)
class FeatureMethod:
    """Descriptors from files, compared by one metric; one file for both queries and references, or one for each."""

    query_file: Path
    reference_file: Path
    metric: str = "euclidean"
    whitening: WhitenBy = WhitenBy()

    @property
    def name(self) -> str:
        """The name of the file, the metric, and whether descriptors are whitened."""
        return f"{self.query_file.stem} ({self.metric}{', whitened' if self.whitening.whiten else ''})"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says; the net's seconds are read from the file."""
        query_features = read_features(self.query_file)
        views = query_features.views
        described = [images.queries.paths]
        rows = [query_features.rows_of(images.queries.paths)]
        if images.references is not None:
            same = self.reference_file == self.query_file
            reference_features = query_features if same else read_features(self.reference_file)
            if reference_features.views != views:
                raise InputError(
                    f"has {reference_features.views} view(s) of each image, {self.query_file} has {views}; "
                    "give netspec extract the same --zooms",
                    self.reference_file,
                )
            described.append(images.references.paths)
            rows.append(reference_features.rows_of(images.references.paths))
        size = rows[0].shape[1] // views
        notes = [f"{f'{views} views of ' if views > 1 else ''}{size} dimensions, {self.metric}"]
        seconds: dict[str, float] = {}
        if np.isfinite(query_features.seconds_per_image):
            seconds["features"] = query_features.seconds_per_image * len(images.tested)
        else:
            notes.append("the file does not say how long the features took")
        training_stages: tuple[str, ...] = ()
        if self.whitening.whiten:
            training_stages = ("training whitening",)
            with timed(seconds, *training_stages):
                whole = [descriptors[:, :size] for descriptors in rows]
                whitening = self.whitening.learn(*zip(described, whole, strict=True))
            with timed(seconds, "whitening"):
                rows = [whitening.of_views(descriptors, views) for descriptors in rows]
            notes.append(str(whitening))
        with timed(seconds, "similarity"):
            scores = similarity_matrix(rows[0], rows[1] if len(rows) == 2 else None, self.metric, views)
        return MethodResult(scores, seconds, notes, training_stages)


def features(argument: str, context: MethodContext, inner: Method | None) -> FeatureMethod:
    """Build the method ``features:FILES[:euclidean|cosine][:whiten=OTHER.npz,components=512,power=1]``.

    FILES is PATH.npz, or QUERIES.npz,REFERENCES.npz.
    """
    described, *settings = SETTINGS_BEGIN.split(argument, maxsplit=1)
    files, colon, metric = described.rpartition(":")
    if not colon or metric.endswith(".npz"):
        files, metric = described, METRICS[0]
    check_metric(metric)
    paths = [Path(name) for name in files.split(",") if name]
    if len(paths) not in (1, 2):
        raise InputError(f'"features:{argument}": expected features:PATH.npz, or two files separated by a comma')
    (whitening,) = configure("features", "".join(settings), WhitenBy())
    if settings and not whitening.whiten:
        raise InputError(f'"features:{argument}": its settings belong to a whitening; add whiten=OTHER.npz')
    return FeatureMethod(paths[0], paths[-1], metric, whitening)
