"""FAB-MAP 1 and 2: the probability that an image was taken at a known place, from the words that it shows.

Cummins and Newman, IJRR 2008 (FAB-MAP 1) and IJRR 2011 (FAB-MAP 2.0), with the choices of openFABMAP, the public
baseline: a place is one image; the belief in the cause of a word at a place ignores the tree; the prior of that cause
is the word's marginal. The numbers agree with openFABMAP's. Observations are words (v,) as counts or presence: only
presence matters.

Notation: z = 1 if the image shows a word, L = 1 if the place's image showed it, a = 1 if the image shows the word's
parent.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from loopclosure.errors import InputError
from loopclosure.words.chow_liu import WordTree

# Query rows at a time offline: 256 x 5000 words are 10 MB per matrix.
BLOCK_ROWS = 256


@dataclass(frozen=True)
class FabMapSettings:
    """Settings of FAB-MAP; the defaults are openFABMAP's.

    version      2: inverted index, the new place sampled over all training images. 1: every word of every place
    hit          p(word seen | its cause is there), PzGe
    false_alarm  p(word seen | its cause is not there), PzGNe; the Oxford model has 0.005
    new_place    "sampled" from training images, or "mean_field": the average place (version 1 only)
    samples      of version 1: training images drawn per query, with replacement; 0 takes each image once
    naive        words are independent, without the tree
    motion       the prior is the previous posterior, moved by one place forward or back
    recent       how many of the last images are not on the map yet: in one sequence they all look like the query
    smoothing    share of the posterior that is kept; the rest is spread evenly
    p_new        of the motion model: prior of a new place
    bias         of the motion model: share of the neighbors' weight that the next place gets; the previous one gets
                 the rest
    seed         of the random draws
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
            raise InputError(
                "FAB-MAP 2 knows likelihoods only up to a common factor, so it has no mean field; use sampled"
            )
        if not 0.0 <= self.false_alarm < self.hit < 1.0:
            raise InputError(f"need 0 <= false_alarm < hit < 1, got {self.false_alarm:g} and {self.hit:g}")
        if self.samples < 0:
            raise InputError(f"samples is {self.samples}; 0 takes each training image once")
        if self.recent < 0:
            raise InputError(f"recent is {self.recent}; 0 puts each image on the map at once")


@dataclass(frozen=True)
class Location:
    """Where one image was taken: the full distribution over a new place and the n places of the map.

    new          posterior probability of a new place
    places       (n,) posterior probabilities of the places; with ``new`` they sum to 1
    loglik       (n,) log-likelihoods of the image given each place [nat]; version 2: up to a term common to all
    loglik_new   the same for a new place
    """

    new: float
    places: np.ndarray
    loglik: np.ndarray
    loglik_new: float

    @property
    def log_odds(self) -> np.ndarray:
        """Evidence for each place against a new one [nat] (n,): a better score, since the posterior saturates."""
        return self.loglik - self.loglik_new

    @property
    def best(self) -> int:
        """The most probable place, -1 for a new place."""
        if self.places.size == 0 or self.new >= self.places.max():
            return -1
        return int(np.argmax(self.places))


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
    """What FAB-MAP computes from words alone: likelihoods of images at known places and at a new place.

    tree      of the words
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

    def draws(self) -> np.random.Generator:
        """Return the random generator of one run, from the seed."""
        return np.random.default_rng(self.settings.seed)

    def new_place(self, queries: np.ndarray, draws: np.random.Generator) -> np.ndarray:
        """Return ln p(query | new place) as (Q,) for words (Q, v)."""
        if self.settings.new_place == "sampled":
            return self.mean_over_samples(self.likelihoods(queries, self.training), draws)
        seen = np.asarray(queries) > 0
        parent_seen = seen[:, self.tree.parent]
        return self.log_mean_field[np.arange(len(self.tree)), seen.astype(int), parent_seen.astype(int)].sum(axis=1)

    def mean_over_samples(self, loglik: np.ndarray, draws: np.random.Generator) -> np.ndarray:
        """Return the log of the mean likelihood (Q,) over sampled training images, given those of all (Q, n)."""
        images, samples = len(self.training), self.settings.samples
        if self.settings.version == 2 or samples == 0:
            return logsumexp(loglik, axis=1) - np.log(images)
        times_drawn = draws.multinomial(samples, np.full(images, 1.0 / images), size=len(loglik))
        return logsumexp(loglik, axis=1, b=times_drawn) - np.log(samples)

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


class _AllWords:
    """The places of FAB-MAP 1: the words of each place, all of them evaluated for every query."""

    def __init__(self, model: FabMapModel) -> None:
        self._model = model
        self._words = array("q")
        self._owners = array("q")
        self._size = 0

    def add(self, seen: np.ndarray) -> None:
        present = np.flatnonzero(seen)
        self._words.extend(present.tolist())
        self._owners.extend([self._size] * len(present))
        self._size += 1

    def loglik(self, seen: np.ndarray) -> np.ndarray:
        absent, present = self._model._word_terms(seen[None])
        gain = (present - absent)[0, np.frombuffer(self._words, np.int64)] if self._words else np.zeros(0)
        owners = np.frombuffer(self._owners, np.int64) if self._owners else np.zeros(0, np.int64)
        return absent.sum() + np.bincount(owners, gain, minlength=self._size)


class _InvertedIndex:
    """The places of FAB-MAP 2: for each word the places that have it, so that a query reads only its own words.

    Log-likelihoods are relative to a place without words: the omitted term is common to all places.
    """

    def __init__(self, model: FabMapModel) -> None:
        self._parent = model.tree.parent
        gain = model.log_table[:, 1] - model.log_table[:, 0]  # what L = 1 adds [word, z, a]
        self._default = gain[:, 0, 0]  # neither the word nor its parent is seen
        self._seen = gain[:, 1] - self._default[:, None]  # [word, a]
        self._orphan = gain[:, 0, 1] - self._default  # the parent is seen, the word is not
        self._defaults = array("d")
        self._places_with = [array("q") for _ in range(len(model.tree))]

    def add(self, seen: np.ndarray) -> None:
        present = np.flatnonzero(seen)
        place = len(self._defaults)
        self._defaults.append(float(self._default[present].sum()))
        for word in present:
            self._places_with[word].append(place)

    def loglik(self, seen: np.ndarray) -> np.ndarray:
        result = np.array(self._defaults)
        parent_seen = seen[self._parent]
        observed = np.flatnonzero(seen)
        orphans = np.flatnonzero(~seen & parent_seen)
        for words, gains in (
            (observed, self._seen[observed, parent_seen[observed].astype(int)]),
            (orphans, self._orphan[orphans]),
        ):
            for word, gain in zip(words, gains, strict=True):
                places = self._places_with[word]
                if places:
                    result[np.frombuffer(places, np.int64)] += gain
        return result


class FabMap:
    """FAB-MAP online, image by image.

    ``add(words)`` locates an image and puts it on the map; ``locate(words)`` only locates it. ``images`` has, for each
    place of the map, the number of its image (every call is counted, from 0).
    """

    def __init__(self, tree: WordTree, training: np.ndarray | None, settings: FabMapSettings | None = None) -> None:
        self.model = FabMapModel(tree, training, settings)
        self.images: list[int] = []
        self._calls = 0
        self._waiting: deque[tuple[int, np.ndarray]] = deque()
        self._previous: np.ndarray | None = None
        self._draws = self.model.draws()
        store = _AllWords if self.model.settings.version == 1 else _InvertedIndex
        self._places = store(self.model)
        self._samples = store(self.model)
        if self.model.settings.new_place == "sampled":
            for seen in self.model.training:
                self._samples.add(seen)

    def locate(self, words: np.ndarray) -> Location:
        """Locate the image with the words (v,); the map does not change, the state of the motion model does."""
        seen = np.asarray(words) > 0
        if seen.shape != (len(self.model.tree),):
            raise InputError(f"words have shape {seen.shape}, the vocabulary {len(self.model.tree)} words")
        while self._waiting and self._waiting[0][0] < self._calls - self.model.settings.recent:
            image, place = self._waiting.popleft()
            self._places.add(place)
            self.images.append(image)
        loglik = self._places.loglik(seen)
        if self.model.settings.new_place == "sampled":
            loglik_new = self.model.mean_over_samples(self._samples.loglik(seen)[None], self._draws)
        else:
            loglik_new = self.model.new_place(seen[None], self._draws)
        p = self.model.posterior(loglik, loglik_new[0], self._previous)
        self._previous = p
        self._calls += 1
        return Location(float(p[0]), p[1:], loglik, float(loglik_new[0]))

    def add(self, words: np.ndarray, only_new: bool = False) -> Location:
        """Locate the image with the words (v,), then make it a place.

        ``only_new``: only if a new place is the most probable (openFABMAP's NewMaximumOnly); otherwise always ("All").
        """
        location = self.locate(words)
        if not only_new or location.best == -1:
            self._waiting.append((self._calls - 1, np.asarray(words) > 0))
        return location


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
    """Score the queries' words (Q, v) on a finished map with the words (P, v), for two traverses."""
    loglik, loglik_new = model.likelihoods(queries, places), model.new_place(queries, model.draws())
    posterior, new = np.empty_like(loglik), np.empty(len(loglik))
    previous = None
    for i in range(len(loglik)):
        previous = model.posterior(loglik[i], loglik_new[i], previous)
        new[i], posterior[i] = previous[0], previous[1:]
    return PlaceScores(posterior, new, loglik - loglik_new[:, None])


def score_sequence(model: FabMapModel, words: np.ndarray, only_new: bool = False) -> PlaceScores:
    """Score each image of a sequence, words (n, v), on the map of the images before it, as :class:`FabMap` does.

    The upper triangle with the diagonal is NaN, and with ``only_new`` the columns of images that were not made places.
    The posterior of images too recent to be on the map is NaN as well; their log-odds are not.
    """
    loglik, loglik_new = model.likelihoods(words, words), model.new_place(words, model.draws())
    posterior, log_odds = np.full_like(loglik, np.nan), np.full_like(loglik, np.nan)
    new = np.empty(len(loglik))
    founders: list[int] = []
    previous = None
    for i in range(len(loglik)):
        places = founders[: bisect_left(founders, i - model.settings.recent)]
        previous = model.posterior(loglik[i, places], loglik_new[i], previous)
        new[i], posterior[i, places] = previous[0], previous[1:]
        log_odds[i, founders] = loglik[i, founders] - loglik_new[i]
        if not only_new or previous[0] >= previous.max():
            founders.append(i)
    return PlaceScores(posterior, new, log_odds)
