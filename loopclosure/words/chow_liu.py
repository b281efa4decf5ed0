"""The Chow-Liu tree: each word is predicted by one other word (Chow and Liu, 1968; FAB-MAP, IJRR 2008).

The numbers are those of openFABMAP: probabilities are smoothed, and the mutual information is computed from the
*unsmoothed* joint frequencies and the *smoothed* marginals, in float32. This is slightly inaccurate, but the same
trees as in openFABMAP result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import xlogy

from loopclosure.errors import InputError

# p = SHARE * frequency + FLOOR: no word is ever certain or impossible.
SHARE, FLOOR = 0.98, 0.01
LOWER_BOUND = 0.0005


@dataclass(frozen=True)
class WordTree:
    """The prior of v words: a tree of conditional probabilities.

    parent         (v,) the parent of each word; the root is its own parent
    marginal       (v,) p(z_q = 1)
    given_present  (v,) p(z_q = 1 | parent present); for the root, its marginal
    given_absent   (v,) p(z_q = 1 | parent absent); for the root, its marginal
    """

    parent: np.ndarray
    marginal: np.ndarray
    given_present: np.ndarray
    given_absent: np.ndarray

    def __len__(self) -> int:
        return len(self.parent)


def learn_tree(words: np.ndarray, lower_bound: float = LOWER_BOUND) -> WordTree:
    """Learn the tree from the words (n, v) of n training images: counts or presence.

    Pairs with less mutual information than ``lower_bound`` [nat] cannot be edges. Raises InputError if the others do
    not connect all words.
    """
    present = np.asarray(words) > 0
    images, size = present.shape
    if images == 0 or size == 0:
        raise InputError(f"a tree of words needs training images with words, got {images} images and {size} words")
    seen = present.astype(np.float32)
    together = seen.T @ seen  # exact: counts below 2^24
    count = present.sum(axis=0).astype(np.float64)
    marginal = SHARE * count / images + FLOOR
    parent = _rooted(*_strongest_tree(together, images, marginal, lower_bound))

    children = np.arange(size)
    with_parent = together[children, parent].astype(np.float64)
    given_present = _smoothed_share(with_parent, count[parent])
    given_absent = _smoothed_share(count - with_parent, images - count[parent])
    root = parent == children
    given_present[root] = given_absent[root] = marginal[root]
    return WordTree(parent, marginal, given_present, given_absent)


def mutual_information(joint: np.ndarray, frequency: np.ndarray, marginal: np.ndarray, word: int) -> np.ndarray:
    """Return the mutual information [nat] (v,) float32 of ``word`` and each word.

    joint      (v,) frequency with which both words are present
    frequency  (v,) frequency of each word
    marginal   (v,) the smoothed frequency of each word
    """
    one, other = frequency[word], frequency
    p_one, p_other = marginal[word], marginal

    def term(both: np.ndarray, independent: np.ndarray) -> np.ndarray:
        both = np.maximum(both, 0.0)
        return xlogy(both, both / independent)

    # Grouped so that the result is bitwise symmetric in the two words; ties then depend only on the order of the words.
    same = term(joint, p_one * p_other) + term(1.0 - one - other + joint, (1.0 - p_one) * (1.0 - p_other))
    different = term(one - joint, p_one * (1.0 - p_other)) + term(other - joint, (1.0 - p_one) * p_other)
    return (same + different).astype(np.float32)


def _smoothed_share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return SHARE * np.divide(part, whole, out=np.zeros_like(part), where=whole > 0) + FLOOR


def _strongest_tree(
    together: np.ndarray, images: int, marginal: np.ndarray, lower_bound: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (neighbor (v,), information (v,)): the edge that connects each word except word 0 to the tree.

    Prim's algorithm, which needs one row of the information matrix at a time. Equally strong edges are chosen in the
    order (lower word, higher word), so the tree is that of Kruskal's algorithm with a stable sort.
    """
    size = len(together)
    frequency = np.diag(together).astype(np.float64) / images
    neighbor = np.zeros(size, np.intp)
    information = np.full(size, -np.inf, np.float32)
    order = np.full(size, np.iinfo(np.int64).max)
    outside = np.ones(size, bool)
    words = np.arange(size, dtype=np.int64)
    word = 0
    for _ in range(size - 1):
        outside[word] = False
        row = mutual_information(together[word].astype(np.float64) / images, frequency, marginal, word)
        rank = np.minimum(words, word) * size + np.maximum(words, word)
        better = outside & ((row > information) | ((row == information) & (rank < order)))
        neighbor[better], information[better], order[better] = word, row[better], rank[better]
        left = np.flatnonzero(outside)
        best = left[information[left] == information[left].max()]
        word = int(best[np.argmin(order[best])])
        if information[word] < lower_bound:
            raise InputError(
                f"{len(left)} of {size} words, word {word} among them, share less than {lower_bound:g} nat with the "
                "others, so no tree spans them; take more training images, fewer words or a lower bound"
            )
    return neighbor, information


def _rooted(neighbor: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return the parents (v,) with the lower word of the strongest edge as the root."""
    parent = neighbor.copy()
    strongest = np.flatnonzero(information == information.max())
    root = min((min(int(word), int(parent[word])), max(int(word), int(parent[word]))) for word in strongest)[0]
    # The edges point to word 0; those between it and the root are reversed.
    child = word = root
    while word != 0:
        parent[word], child, word = child, word, int(parent[word])
    parent[0] = child
    return parent
