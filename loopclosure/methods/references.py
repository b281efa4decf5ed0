"""More descriptors that need no net: ``hog``, ``cohog`` and ``vlad`` on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from loopclosure.descriptors.thumbnails import Hog
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, compared, describe_each
from loopclosure.methods.baselines import WordModelSource, configure_words
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_gray
from loopclosure.progress import Progress, timed
from loopclosure.words.bag_of_words import vlad
from loopclosure.words.word_model import TRAINING_STAGES, Training

# Few words, each with a whole vector: 64 x 128 numbers for SIFT.
VLAD_WORDS = 64


@dataclass
class HogMethod:
    """HOG of the whole image; the score is the cosine similarity."""

    hog: Hog = field(default_factory=Hog)
    name: str = "hog"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        seconds: dict[str, float] = {}
        rows = describe_each(
            images, "HOG", lambda path: self.hog.blocks(read_gray(path)).reshape(-1), progress, seconds
        )
        result = compared(rows, images, "cosine", seconds)
        return replace(result, notes=[f"{self.hog}", *result.notes])


@dataclass
class CoHogMethod:
    """Like CoHOG: the score is the mean, over the query's regions with texture, of the best cosine similarity.

    least_entropy  regions with less entropy are not compared; a share of the largest possible entropy
    """

    hog: Hog = field(default_factory=lambda: Hog(bins=8))
    least_entropy: float = 0.5
    name: str = "cohog"

    def __post_init__(self) -> None:
        if not 0 <= self.least_entropy <= 1:
            raise InputError(f"least_entropy of cohog is {self.least_entropy:g}; expected 0..1")

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says; in one sequence, against earlier frames only."""
        seconds: dict[str, float] = {}
        regions, textured = [], []
        for path in progress(images.tested, "regions", len(images.tested)):
            with timed(seconds, "regions"):
                image = read_gray(path)
                regions.append(self.hog.blocks(image).reshape(-1, 4 * self.hog.bins))
                rich = self.hog.entropies(image).reshape(-1) >= self.least_entropy
                textured.append(rich if rich.any() else np.ones_like(rich))
        first = 0 if images.references is None else len(images.queries)
        references = np.array(regions[first:])
        scores = np.full((len(images.queries), len(references)), np.nan)
        for query in progress(range(len(scores)), "comparison", len(scores)):
            with timed(seconds, "comparison"):
                end = query if images.references is None else len(references)
                own = regions[query][textured[query]]
                alike = own @ references[:end].reshape(-1, own.shape[1]).T
                scores[query, :end] = alike.reshape(len(own), end, references.shape[1]).max(axis=2).mean(axis=0)
        share = float(np.mean(textured))
        notes = [f"{100 * share:.0f} % of the regions have an entropy of at least {self.least_entropy:g}; {self.hog}"]
        return MethodResult(scores, seconds, notes)


@dataclass
class VladMethod:
    """VLAD of SIFT or ORB words; the score is the cosine similarity."""

    source: WordModelSource = field(default_factory=WordModelSource)
    name: str = "vlad"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        seconds: dict[str, float] = {}
        model, notes = self.source.learn(images, progress, seconds)
        words = model.vocabulary
        rows = describe_each(
            images, "features", lambda path: vlad(words.extractor(read_gray(path)), words), progress, seconds
        )
        result = compared(rows, images, "cosine", seconds)
        return replace(result, notes=[*notes, *result.notes], training_stages=TRAINING_STAGES)


def hog(argument: str, context: MethodContext, inner: Method | None) -> HogMethod:
    """Build ``hog[:setting=value,...]``."""
    method, descriptor = configure("hog", argument, HogMethod(), Hog())
    return replace(method, hog=descriptor)


def cohog(argument: str, context: MethodContext, inner: Method | None) -> CoHogMethod:
    """Build ``cohog[:setting=value,...]``."""
    plain = CoHogMethod()
    method, descriptor = configure("cohog", argument, plain, plain.hog)
    return replace(method, hog=descriptor)


def vlad_method(argument: str, context: MethodContext, inner: Method | None) -> VladMethod:
    """Build ``vlad[:setting=value,...]``; ``kind=orb`` for ORB words."""
    return configure_words(argument, VladMethod(), Training(words=VLAD_WORDS, seed=context.seed))[0]
