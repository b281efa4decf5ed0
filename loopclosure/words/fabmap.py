"""FAB-MAP 1 and 2: the probability that an image was taken at a known place, from the words that it shows.

Cummins and Newman, IJRR 2008 (FAB-MAP 1) and IJRR 2011 (FAB-MAP 2.0). As in openFABMAP, the public baseline, a place
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

    version      1 or 2; version 2 samples the new place from all training images, each once
    hit          p(word seen | its cause is there), PzGe
    false_alarm  p(word seen | its cause is not there), PzGNe; the Oxford model has 0.005
    new_place    "sampled" from training images, or "mean_field": the average place (version 1 only)
    samples      for version 1: training images drawn per query, with replacement; 0: each image once
    naive        treat words as independent, without the tree
    motion       use a motion model: the prior is the previous posterior, moved by one place forward or back
    recent       number of the last images that are not on the map yet, because they look like the query
    smoothing    share of the posterior that is kept; the rest is distributed evenly
    p_new        for the motion model: prior of a new place
    bias         for the motion model: share of the neighbors' weight for the next place; the rest is for the previous
                 place
    seed         seed of the random draws
    """

    version: int = 2
    hit: float = 0.39
    false_alarm: float = 0.0
    new_place: str = "sampled"
    samples: int = 3000
    naive: bool = False
    motion: bool = False
    recent: int = 0
    smoothing: float = 0.99
    p_new: float = 0.9
    bias: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.version not in (1, 2):
            raise InputError(f"FAB-MAP has versions 1 and 2, not {self.version}")
        if self.new_place not in ("sampled", "mean_field"):
            raise InputError(f'new_place is "sampled" or "mean_field", not "{self.new_place}"')
        if self.version == 2 and self.new_place == "mean_field":
            raise InputError("FAB-MAP 2 computes likelihoods only up to a common factor; mean_field needs version 1")
        if not 0.0 <= self.false_alarm < self.hit < 1.0:
            raise InputError(f"need 0 <= false_alarm < hit < 1, got {self.false_alarm:g} and {self.hit:g}")
        if self.samples < 0:
            raise InputError(f"samples is {self.samples}; 0 takes each training image once")
        if self.recent < 0:
            raise InputError(f"recent is {self.recent}; 0 puts each image on the map at once")


def place_table(tree: WordTree, settings: FabMapSettings) -> np.ndarray:
    """Return p(z | L, a) as (v, 2, 2, 2), indexed [word, L, z, a]."""
    return _mix(tree, settings, _belief(tree, settings))


def mean_field_table(tree: WordTree, settings: FabMapSettings) -> np.ndarray:
    """Return p(z | a) for the average place as (v, 2, 2), indexed [word, z, a]."""
    return _mix(tree, settings, tree.marginal[:, None])[:, 0]


def _detector(settings: FabMapSettings) -> np.ndarray:
    """Return p(z | cause) as (2, 2), indexed [z, cause]."""
    seen = np.array([settings.false_alarm, settings.hit])
    return np.stack([1.0 - seen, seen])


def _belief(tree: WordTree, settings: FabMapSettings) -> np.ndarray:
    """Return p(cause of the word is there | L) as (v, 2)."""
    by_cause = _detector(settings)  # [L, cause]
    prior = tree.marginal[:, None]
    there, absent = by_cause[:, 1] * prior, by_cause[:, 0] * (1.0 - prior)
    return there / (there + absent)


def _mix(tree: WordTree, settings: FabMapSettings, belief: np.ndarray) -> np.ndarray:
    """Average p(z | cause, a) over the belief (v, m) in the cause: (v, m, 2, 2), indexed [word, ., z, a]."""
    detector = _detector(settings)[:, :, None]  # [z, cause, a]
    if settings.naive:
        by_cause = np.broadcast_to(detector, (len(tree), 2, 2, 2))  # [word, z, cause, a]
    else:
        marginal = np.stack([1.0 - tree.marginal, tree.marginal], axis=1)[:, :, None, None]  # [word, z, ., .]
        given = np.stack([tree.given_absent, tree.given_present], axis=1)  # p(z = 1 | a) [word, a]
        given = np.stack([1.0 - given, given], axis=1)[:, :, None, :]  # [word, z, ., a]
        unlike = marginal * detector[::-1] * given[:, ::-1]
        like = marginal[:, ::-1] * detector * given
        by_cause = like / (unlike + like)
    weight = np.stack([1.0 - belief, belief], axis=-1)  # [word, m, cause]
    return np.einsum("qmc,qzca->qmza", weight, by_cause)


class FabMapModel:
    """The observation model of FAB-MAP: likelihoods of images at known places and at a new place.

    tree      the Chow-Liu tree of the words
    training  (n, v) words of the training images, needed for a sampled new place; they must not be test images
    """

    def __init__(self, tree: WordTree, training: np.ndarray | None, settings: FabMapSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings = settings or FabMapSettings()
        self.log_table = np.log(place_table(tree, settings))
        self.log_mean_field = np.log(mean_field_table(tree, settings))
        self.training = np.zeros((0, len(tree)), bool) if training is None else np.asarray(training) > 0
        if self.training.shape[1:] != (len(tree),):
            raise InputError(f"training words have shape {self.training.shape}, the vocabulary {len(tree)} words")
        if settings.new_place == "sampled" and len(self.training) == 0:
            raise InputError("a sampled new place needs the words of training images")

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
        """Return ln p(query | new place) as (Q,) for words (Q, v): the mean over sampled images, or the mean field."""
        if self.settings.new_place == "sampled":
            images, samples = len(self.training), self.settings.samples
            loglik = self.likelihoods(queries, self.training)
            if self.settings.version == 2 or samples == 0:
                return logsumexp(loglik, axis=1) - np.log(images)
            draws = np.random.default_rng(self.settings.seed)
            times_drawn = draws.multinomial(samples, np.full(images, 1.0 / images), size=len(loglik))
            return logsumexp(loglik, axis=1, b=times_drawn) - np.log(samples)
        seen = np.asarray(queries) > 0
        parent_seen = seen[:, self.tree.parent]
        return self.log_mean_field[np.arange(len(self.tree)), seen.astype(int), parent_seen.astype(int)].sum(axis=1)

    def posterior(self, loglik: np.ndarray, loglik_new: float, previous: np.ndarray | None = None) -> np.ndarray:
        """Return the distribution (1 + n,) over a new place (entry 0) and n places.

        ``previous`` is the posterior (1 + m,), m <= n, of the previous image; only the motion model uses it.
        """
        settings = self.settings
        log_p = np.concatenate([[loglik_new], loglik])
        if settings.motion:
            log_p[0] += np.log(settings.p_new)
            # openFABMAP: no prior before three entries are known, and none for newer places.
            if previous is not None and len(previous) > 2:
                here = previous[1:]
                before, after = np.r_[here[0], here[:-1]], np.r_[here[1:], here[-1]]
                moved = (2.0 * (1.0 - settings.bias) * before + here + 2.0 * settings.bias * after) / 3.0
                log_p[1 : len(previous)] += np.log(moved)
        p = np.exp(log_p - logsumexp(log_p))
        return settings.smoothing * p + (1.0 - settings.smoothing) / len(p)

    def _word_terms(self, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ln p(z_q | L_q = 0, a) and ln p(z_q | L_q = 1, a), (Q, v) each, of observations (Q, v) bool."""
        state = 2 * seen + seen[:, self.tree.parent]  # z, a as one index
        words = np.arange(len(self.tree))
        by_state = self.log_table.reshape(len(self.tree), 2, 4)
        return by_state[words, 0, state], by_state[words, 1, state]


@dataclass(frozen=True)
class PlaceScores:
    """The result of FAB-MAP for Q images and P places.

    posterior  (Q, P) probabilities
    new        (Q,) probability of a new place
    log_odds   (Q, P) evidence for each place against a new one [nat]
    """

    posterior: np.ndarray
    new: np.ndarray
    log_odds: np.ndarray


def score_sets(model: FabMapModel, queries: np.ndarray, places: np.ndarray) -> PlaceScores:
    """Score queries with words (Q, v) on a map of places with words (P, v), for two traverses."""
    loglik, loglik_new = model.likelihoods(queries, places), model.new_place(queries)
    posterior, new = np.empty_like(loglik), np.empty(len(loglik))
    previous = None
    for i in range(len(loglik)):
        previous = model.posterior(loglik[i], loglik_new[i], previous)
        new[i], posterior[i] = previous[0], previous[1:]
    return PlaceScores(posterior, new, loglik - loglik_new[:, None])


def score_sequence(model: FabMapModel, words: np.ndarray) -> PlaceScores:
    """Score each image of a sequence with words (n, v) on the map of the images before it.

    The upper triangle with the diagonal is NaN. The posterior of images that are too recent to be on the map is NaN
    too; their log-odds are not.
    """
    loglik, loglik_new = model.likelihoods(words, words), model.new_place(words)
    posterior, new = np.full_like(loglik, np.nan), np.empty(len(loglik))
    previous = None
    for i in range(len(loglik)):
        places = max(0, i - model.settings.recent)
        previous = model.posterior(loglik[i, :places], loglik_new[i], previous)
        new[i], posterior[i, :places] = previous[0], previous[1:]
    earlier = np.tri(len(loglik), k=-1, dtype=bool)
    return PlaceScores(posterior, new, np.where(earlier, loglik - loglik_new[:, None], np.nan))
