"""The baselines as methods: ``fabmap``, ``bow`` and ``thumbnails`` on the command line.

Their settings are the fields of the classes below and of the classes of these fields. With ``fabmap.model=words.npz``
the vocabulary is written to a file, and read from it the next time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from loopclosure.descriptors.thumbnails import Thumbnailer, differences
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, describe_each, refuse_overlap
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.progress import Progress, timed
from loopclosure.words.bag_of_words import BagOfWords, check_metric
from loopclosure.words.fabmap import FabMapModel, FabMapSettings, log_odds
from loopclosure.words.vocabulary import Extractor
from loopclosure.words.word_model import TRAINING_STAGES, Training, WordModel, train


@dataclass(frozen=True)
class WordModelSource:
    """The source of the word model: the file ``model``, or training, which then writes that file.

    given   names of the settings of ``training`` that a file must have been made with; the others are the file's own
    """

    training: Training = field(default_factory=Training)
    model: str = ""
    given: tuple[str, ...] = ()

    def learn(self, images: Images, progress: Progress, seconds: dict[str, float]) -> tuple[WordModel, list[str]]:
        """Return the model and notes about it; refuse a model that was trained on a test image."""
        path = Path(self.model)
        if self.model and path.exists():
            model = WordModel.load(path)
            asked, made = self.training.settings, model.training.settings
            for name in self.given:
                if asked[name] != made[name]:
                    raise InputError(f"was made with {name} {made[name]}, not {asked[name]}; give another file", path)
            source = f"read from {path}"
        else:
            refuse_overlap(images.train, images.tested)
            model = train(images.train, self.training, progress, seconds)
            source = f"written to {path}" if self.model else "made for this run"
            if self.model:
                model.save(path)
        refuse_overlap(model.training_images, images.tested, self.model)
        present = (model.training_words > 0).mean(axis=0)
        return model, [
            f"vocabulary ({source}): {model.vocabulary.made}; {model.vocabulary.extractor}",
            f"a word occurs in {100 * present.mean():.1f} % of the training images on average, "
            f"{int((present > 0.3).sum())} of {len(present)} in more than 30 %",
        ]


@dataclass
class _WordMethod:
    """The common part of methods on visual words."""

    source: WordModelSource = field(default_factory=WordModelSource)
    stage: ClassVar[str] = "similarity"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        seconds: dict[str, float] = {}
        model, notes = self.source.learn(images, progress, seconds)
        counts = model.count_words(images.tested, progress, seconds)
        empty = int((counts.sum(axis=1) == 0).sum())
        if empty:
            notes.append(f"{empty} of {len(counts)} images have no features: places without words")
        queries, references = np.split(counts, [len(images.queries)])
        with timed(seconds, self.stage):
            scores, said = self._compared(model, queries, None if images.references is None else references)
        return MethodResult(scores, seconds, [*notes, said], TRAINING_STAGES)

    def _compared(self, model: WordModel, queries: np.ndarray, references: np.ndarray | None) -> tuple[np.ndarray, str]:
        """Return the scores of words (Q, v) and (R, v), None for one sequence, and a note."""
        raise NotImplementedError


@dataclass
class FabMapMethod(_WordMethod):
    """FAB-MAP 2.0; the score is the log of the posterior odds of the place against a new place."""

    settings: FabMapSettings = field(default_factory=FabMapSettings)
    name: str = "fabmap"
    stage: ClassVar[str] = "likelihoods"

    def _compared(self, model: WordModel, queries: np.ndarray, references: np.ndarray | None) -> tuple[np.ndarray, str]:
        fabmap = FabMapModel(model.tree, model.training_words, self.settings)
        said = f"FAB-MAP 2.0, score: log odds against a new place; {self.settings}"
        return log_odds(fabmap, queries, references), said


@dataclass
class BagOfWordsMethod(_WordMethod):
    """Bag of words with tf-idf; ``metric`` as in :class:`BagOfWords`."""

    metric: str = "l1"
    name: str = "bow"

    def __post_init__(self) -> None:
        check_metric(self.metric)

    def _compared(self, model: WordModel, queries: np.ndarray, references: np.ndarray | None) -> tuple[np.ndarray, str]:
        bag = BagOfWords.learn(model.training_words, self.metric)
        return bag.similarity(queries, queries if references is None else references), f"tf-idf, {self.metric}"


@dataclass
class ThumbnailMethod:
    """Thumbnails; the score is minus the mean absolute difference."""

    thumbnailer: Thumbnailer = field(default_factory=Thumbnailer)
    name: str = "thumbnails"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        seconds: dict[str, float] = {}
        small = np.array(
            describe_each(images, "thumbnails", lambda path: self.thumbnailer(read_gray(path)), progress, seconds),
            np.float32,
        )
        with timed(seconds, "differences"):
            queries, references = np.split(small, [len(images.queries)])
            scores = -differences(queries, queries if images.references is None else references)
        return MethodResult(scores, seconds, [f"mean absolute difference of gray thumbnails; {self.thumbnailer}"])


def _configured(settings: Mapping[str, str], method: Any, seed: int, *parts: Any) -> list[Any]:
    """Return a method with a word model as its ``source``, and other parts, with their settings."""
    method, source, training, extractor, *others = configure(
        method.name, settings, method, WordModelSource(), Training(seed=seed), Extractor(), *parts
    )
    training = replace(training, extractor=extractor)
    given = tuple(name for name in settings if name in training.settings)
    return [replace(method, source=replace(source, training=training, given=given)), *others]


def fabmap(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> FabMapMethod:
    """Build ``fabmap``."""
    plain = FabMapSettings(recent=context.exclude_frames)
    method, model = _configured(settings, FabMapMethod(), context.seed, plain)
    return replace(method, settings=model)


def bag_of_words(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> BagOfWordsMethod:
    """Build ``bow``."""
    return _configured(settings, BagOfWordsMethod(), context.seed)[0]


def thumbnails(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> ThumbnailMethod:
    """Build ``thumbnails``."""
    method, thumbnailer = configure("thumbnails", settings, ThumbnailMethod(), Thumbnailer())
    return replace(method, thumbnailer=thumbnailer)
