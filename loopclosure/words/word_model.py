"""The model that FAB-MAP and the bag of words learn from training images, and its file.

A model file (.npz) has the vocabulary, the words of the training images, the Chow-Liu tree, the settings of the
extractor and the paths of the training images. FAB-MAP 2 samples its new place from the words of the training images,
and the bag of words computes its weights from them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.frames import read_gray
from loopclosure.progress import Progress, silent, timed
from loopclosure.stored import check_array, from_json
from loopclosure.words.chow_liu import LOWER_BOUND, WordTree, learn_tree
from loopclosure.words.vocabulary import Extractor, Vocabulary, kmeans
from netspec.errors import SpecError
from netspec.files.arrays import read_npz
from netspec.files.whole_file import whole_file

# The stages of ``train``, which run once for any number of tested images.
TRAINING_STAGES = ("training features", "vocabulary", "training words", "tree")


@dataclass(frozen=True)
class Training:
    """Settings for learning a word model.

    words            number of words
    max_descriptors  number of descriptors that are clustered, with the same limit for each image
    lower_bound      see :func:`learn_tree`
    seed             seed of all random numbers
    """

    extractor: Extractor = field(default_factory=Extractor)
    words: int = 2000
    max_descriptors: int = 200_000
    lower_bound: float = LOWER_BOUND
    seed: int = 0

    @property
    def settings(self) -> dict[str, Any]:
        """All of them by name, those of the extractor too."""
        return {**{name: value for name, value in vars(self).items() if name != "extractor"}, **vars(self.extractor)}


@dataclass(frozen=True)
class WordModel:
    """What was learned from n training images: v words, and what predicts them.

    training_words   (n, v) how often each image shows each word
    training_images  the n paths
    training         the settings
    """

    vocabulary: Vocabulary
    training_words: np.ndarray
    training_images: list[Path]
    tree: WordTree
    training: Training

    def count_words(
        self, images: list[Path], progress: Progress = silent, seconds: dict[str, float] | None = None
    ) -> np.ndarray:
        """Count each word in each image: (n, v) int32."""
        seconds = {} if seconds is None else seconds
        counts = np.zeros((len(images), len(self.vocabulary)), np.int32)
        for i, path in enumerate(progress(images, "features", len(images))):
            with timed(seconds, "features"):
                descriptors = self.vocabulary.extractor(read_gray(path))
            with timed(seconds, "words"):
                counts[i] = self.vocabulary.count_descriptors(descriptors)
        return counts

    def save(self, path: Path) -> None:
        """Write the model to ``path``, a .npz file."""
        settings = {**asdict(self.training), "made": self.vocabulary.made}
        with whole_file(path) as unfinished, unfinished.open("wb") as file:
            np.savez_compressed(
                file,
                settings=json.dumps(settings),
                centres=self.vocabulary.centers,
                training_words=self.training_words,
                training_images=np.array([str(image) for image in self.training_images], str),
                parent=self.tree.parent,
                marginal=self.tree.marginal,
                given_present=self.tree.given_present,
                given_absent=self.tree.given_absent,
            )

    @classmethod
    def load(cls, path: Path) -> WordModel:
        """Read a model that :meth:`save` wrote. Raises InputError for any other file."""
        expected = "a word model; give another name, and a new one is written there"
        file = read_npz(path, expected)
        try:
            settings = json.loads(str(file["settings"]))
            made = settings.pop("made")
            extractor = from_json(Extractor, settings.pop("extractor"))
            training = Training(extractor, **settings)
            count, dimensions = file["centres"].shape
            images = [Path(image) for image in file["training_images"].tolist()]
            check_array(file, "centres", "f", (count, dimensions))
            check_array(file, "training_words", "iu", (len(images), count))
            check_array(file, "parent", "iu", (count,))
            for name in ("marginal", "given_present", "given_absent"):
                check_array(file, name, "f", (count,))
            parents = file["parent"]
            if len(parents) and (parents.min() < 0 or parents.max() >= count):
                raise ValueError("the parent of a word is not a word")
            tree = WordTree(*(file[name] for name in ("parent", "marginal", "given_present", "given_absent")))
            vocabulary = Vocabulary(file["centres"], extractor, made)
            return cls(vocabulary, file["training_words"], images, tree, training)
        except SpecError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
            raise InputError(f"not {expected} ({' '.join(str(error).split())})", path) from None


def train(
    images: Iterable[Path],
    training: Training | None = None,
    progress: Progress = silent,
    seconds: dict[str, float] | None = None,
) -> WordModel:
    """Learn the words and their tree from images that will not be tested.

    The time of each stage is added to ``seconds``. Raises InputError if there are no images or no features in them.
    """
    training = training or Training()
    seconds = {} if seconds is None else seconds
    paths = [Path(image).resolve() for image in images]
    if not paths:
        raise InputError("a vocabulary needs training images, of other places than the tested ones; none are given")
    rng = np.random.default_rng(training.seed)
    share = max(1, training.max_descriptors // len(paths))
    found = []
    for path in progress(paths, "training features", len(paths)):
        with timed(seconds, "training features"):
            found.append(training.extractor(read_gray(path)))
    with timed(seconds, "vocabulary"):
        sample = np.concatenate([d if len(d) <= share else rng.choice(d, share, replace=False) for d in found])
        centers = kmeans(sample, training.words, training.seed)
    of = f"{len(sample)} descriptors of {len(paths)} training images, seed {training.seed}"
    made = f"k-means, {len(centers)} words of {of}"
    vocabulary = Vocabulary(centers, training.extractor, made)
    with timed(seconds, "training words"):
        words = np.stack([vocabulary.count_descriptors(descriptors) for descriptors in found])
    with timed(seconds, "tree"):
        tree = learn_tree(words, training.lower_bound)
    return WordModel(vocabulary, words, paths, tree, training)
