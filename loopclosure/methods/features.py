"""Descriptors from files as a method: ``features`` on the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, check_metric, similarity_matrix
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult
from loopclosure.methods.settings import configure
from loopclosure.progress import Progress, timed


@dataclass(frozen=True)
class FeatureMethod:
    """Descriptors from files, compared by one metric; one file for both queries and references, or one for each."""

    query_file: Path
    reference_file: Path
    metric: str = METRICS[0]

    @property
    def name(self) -> str:
        """The name of the file, and the metric."""
        return f"{self.query_file.stem} ({self.metric})"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says; the net's seconds are read from the file."""
        query_features = read_features(self.query_file)
        views, two = query_features.views, images.references is not None
        if not two or self.reference_file == self.query_file:
            rows = np.split(query_features.rows_of(images.tested), [len(images.queries)])
        else:
            reference_features = read_features(self.reference_file)
            if reference_features.views != views:
                raise InputError(
                    f"has {reference_features.views} view(s) of each image, {self.query_file} has {views}; "
                    "give netspec extract the same --zooms",
                    self.reference_file,
                )
            rows = [query_features.rows_of(images.queries.paths), reference_features.rows_of(images.database.paths)]
        size = rows[0].shape[1] // views
        notes = [f"{f'{views} views of ' if views > 1 else ''}{size} dimensions, {self.metric}"]
        seconds: dict[str, float] = {}
        if np.isfinite(query_features.seconds_per_image):
            seconds["features"] = query_features.seconds_per_image * len(images.tested)
        else:
            notes.append("the file does not say how long the features took")
        with timed(seconds, "similarity"):
            scores = similarity_matrix(rows[0], rows[1] if two else None, self.metric, views)
        return MethodResult(scores, seconds, notes)


def features(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> FeatureMethod:
    """Build ``features:PATH.npz``, or ``features:QUERIES.npz,REFERENCES.npz``; ``metric``: euclidean or cosine."""
    files, others = settings.get("file", ""), {key: value for key, value in settings.items() if key != "file"}
    paths = [Path(name) for name in files.split(",") if name]
    if len(paths) not in (1, 2):
        raise InputError(f'"features:{files}": expected features:PATH.npz, or two files separated by a comma')
    (method,) = configure("features", others, FeatureMethod(paths[0], paths[-1]))
    check_metric(method.metric)
    return method
