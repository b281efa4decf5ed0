import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree

from loopclosure.errors import InputError
from loopclosure.words.chow_liu import learn_tree, mutual_information


def rows(text: str) -> np.ndarray:
    return np.array([[int(digit) for digit in row] for row in text.split()])


# test_fabmap.py compares what follows from its tree with a compiled openFABMAP.
EXAMPLE_B = rows(
    "111001 111111 100001 000110 101001 101000 111111 111111 000001 001001 111101 011000 011111 011001 011000 111001"
)


def information(words: np.ndarray) -> np.ndarray:
    """Return the information of all pairs (v, v)."""
    frequency = words.mean(axis=0)
    joint = words.T @ words / len(words)
    return np.stack([mutual_information(joint[q], frequency, 0.98 * frequency + 0.01, q) for q in range(len(joint))])


def test_the_tree_has_maximal_information() -> None:
    words = (np.random.default_rng(3).random((60, 40)) < 0.3).astype(int)
    words[:, 20:] |= words[:, :20] & (np.random.default_rng(4).random((60, 20)) < 0.8)
    tree = learn_tree(words, lower_bound=0.0)
    gains = information(words).astype(np.float64)
    np.fill_diagonal(gains, 0)
    strongest = -minimum_spanning_tree(-gains).sum()
    children = np.flatnonzero(tree.parent != np.arange(40))
    assert len(children) == 39
    assert gains[children, tree.parent[children]].sum() == pytest.approx(strongest, rel=1e-6)
    root = min(np.unravel_index(np.argmax(gains), gains.shape))
    for word in range(40):  # every word hangs from the root
        for _ in range(40):
            word = tree.parent[word]
        assert word == root


def test_only_the_presence_of_words_matters() -> None:
    shuffled = EXAMPLE_B[np.random.default_rng(0).permutation(len(EXAMPLE_B))] * 3
    np.testing.assert_array_equal(learn_tree(shuffled).parent, learn_tree(EXAMPLE_B).parent)


def test_words_of_no_or_all_images() -> None:
    words = np.concatenate([EXAMPLE_B, np.zeros((16, 1), int), np.ones((16, 1), int)], axis=1)
    tree = learn_tree(words)
    assert tree.marginal[6] == pytest.approx(0.01)
    assert tree.marginal[7] == pytest.approx(0.99)
    never = tree.parent == 6
    np.testing.assert_allclose(tree.given_present[never], 0.01)
    for p in (tree.marginal, tree.given_present, tree.given_absent):
        assert np.all((p >= 0.01 - 1e-12) & (p <= 0.99 + 1e-12))


def test_words_with_too_little_information_are_refused() -> None:
    with pytest.raises(InputError, match=r"4 of 6 words.*share less than 0.03 nat.*lower bound"):
        learn_tree(EXAMPLE_B, lower_bound=0.03)


def test_no_images_are_refused() -> None:
    with pytest.raises(InputError, match="got 0 images and 6 words"):
        learn_tree(EXAMPLE_B[:0])
