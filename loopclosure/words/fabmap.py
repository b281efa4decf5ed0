"""FAB-MAP 2.0: the probability that an image was taken at a known place, from the words that it shows.

Cummins and Newman, IJRR 2008 and IJRR 2011 (FAB-MAP 2.0). As in openFABMAP, the public baseline, a place
is one image; the belief that the cause of a word is at a place ignores the tree; the prior of that cause is the word's
marginal. The results agree with openFABMAP's. Observations are words (v,) as counts or presence; only presence
matters.

Notation: z = 1 if the image shows a word, L = 1 if the place's image showed it, a = 1 if the image shows the word's
parent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from loopclosure.errors import InputError
from loopclosure.words.chow_liu import WordTree

# Query rows processed at a time: 256 x 5000 words need 10 MB per matrix.
BLOCK_ROWS = 256


@dataclass(frozen=True)
class FabMapSettings:
    """Settings of FAB-MAP; the defaults are openFABMAP's.

    hit          p(word seen | its cause is there), PzGe
    false_alarm  p(word seen | its cause is not there), PzGNe; the Oxford model has 0.005
    recent       number of the last images that are not on the map yet, because they look like the query
    """

    hit: float = 0.39
    false_alarm: float = 0.0
    recent: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.false_alarm < self.hit < 1.0:
            raise InputError(f"need 0 <= false_alarm < hit < 1, got {self.false_alarm:g} and {self.hit:g}")
        if self.recent < 0:
            raise InputError(f"recent is {self.recent}; 0 puts each image on the map at once")


def place_table(tree: WordTree, settings: FabMapSettings) -> np.ndarray:
    """Return p(z | L, a) as (v, 2, 2, 2), indexed [word, L, z, a]: p(z | cause, a), averaged over the cause given L."""
    seen = np.array([settings.false_alarm, settings.hit])
    detector = np.stack([1.0 - seen, seen])  # p(z | cause), and p(L | cause) [z or L, cause]
    prior = tree.marginal[:, None]
    there, absent = detector[:, 1] * prior, detector[:, 0] * (1.0 - prior)
    belief = there / (there + absent)  # p(cause | L) [word, L]

    detector = detector[:, :, None]  # [z, cause, a]
    marginal = np.stack([1.0 - tree.marginal, tree.marginal], axis=1)[:, :, None, None]  # [word, z, ., .]
    given = np.stack([tree.given_absent, tree.given_present], axis=1)  # p(z = 1 | a) [word, a]
    given = np.stack([1.0 - given, given], axis=1)[:, :, None, :]  # [word, z, ., a]
    unlike = marginal * detector[::-1] * given[:, ::-1]
    like = marginal[:, ::-1] * detector * given
    by_cause = like / (unlike + like)  # p(z | cause, a) [word, z, cause, a]
    weight = np.stack([1.0 - belief, belief], axis=-1)  # [word, L, cause]
    return np.einsum("qmc,qzca->qmza", weight, by_cause)


class FabMapModel:
    """The observation model of FAB-MAP: likelihoods of images at known places and at a new place.

    tree      the Chow-Liu tree of the words
    training  (n, v) words of the training images, from which a new place is sampled; they must not be test images
    """

    def __init__(self, tree: WordTree, training: np.ndarray, settings: FabMapSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings = settings or FabMapSettings()
        self.log_table = np.log(place_table(tree, settings))
        self.training = np.asarray(training) > 0
        if self.training.shape[1:] != (len(tree),):
            raise InputError(f"training words have shape {self.training.shape}, the vocabulary {len(tree)} words")
        if len(self.training) == 0:
            raise InputError("a new place is sampled from the words of training images; there are none")

    def likelihoods(self, queries: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return ln p(query | place) as (Q, P) for words (Q, v) and (P, v): one matrix product per block of queries."""
        seen = np.asarray(queries) > 0
        known = (np.asarray(places) > 0).astype(np.float64).T
        result = np.empty((len(seen), known.shape[1]))
        for start in range(0, len(seen), BLOCK_ROWS):
            absent, present = self._word_terms(seen[start : start + BLOCK_ROWS])
            result[start : start + len(absent)] = absent.sum(axis=1, keepdims=True) + (present - absent) @ known
        return result

    def new_place(self, queries: np.ndarray) -> np.ndarray:
        """Return ln p(query | new place) as (Q,) for words (Q, v): the mean over the training images."""
        return logsumexp(self.likelihoods(queries, self.training), axis=1) - np.log(len(self.training))

    def _word_terms(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ln p(z_q | L_q = 0, a) and ln p(z_q | L_q = 1, a), (Q, v) each, of observations (Q, v) bool."""
        state = 2 * seen + seen[:, self.tree.parent]  # z, a as one index
        words = np.arange(len(self.tree))
        by_state = self.log_table.reshape(len(self.tree), 2, 4)
        return by_state[words, 0, state], by_state[words, 1, state]


def log_odds(model: FabMapModel, queries: np.ndarray, places: np.ndarray | None = None) -> np.ndarray:
    """Return ln p(place | image) / p(new place | image), (Q, P), of images with words (Q, v), places with words (P, v).

    Of one image they are in the order of the posterior, but the share of a place does not depend on how many others
    show the same. Without ``places``, the images are a sequence, and each is scored on the map of the images before it:
    NaN for itself, for later ones, and for those that are too recent to be on the map.
    """
    found = model.likelihoods(queries, queries if places is None else places) - model.new_place(queries)[:, None]
    if places is None:
        found[~np.tri(len(found), k=-1 - model.settings.recent, dtype=bool)] = np.nan
    return found
