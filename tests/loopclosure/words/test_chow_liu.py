import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree

from loopclosure.errors import InputError
from loopclosure.words.chow_liu import learn_tree, mutual_information


def rows(text: str) -> np.ndarray:
    return np.array([[int(digit) for digit in row] for row in text.split()])


# Both compared with a compiled openFABMAP.
EXAMPLE_A = rows("11001 11000 11100 00110 00111 00100 10001 01010 00010 11001")
EXAMPLE_B = rows(
    "111001 111111 100001 000110 101001 101000 111111 111111 000001 001001 111101 011000 011111 011001 011000 111001"
)


def information(words: np.ndarray) -> np.ndarray:
    """Return the information of all pairs (v, v)."""
    frequency = words.mean(axis=0)
    joint = words.T @ words / len(words)
    return np.stack([mutual_information(joint[q], frequency, 0.98 * frequency + 0.01, q) for q in range(len(joint))])


def test_example_a_with_ties_resolved_by_order() -> None:
    tree = learn_tree(EXAMPLE_A)
    np.testing.assert_array_equal(tree.parent, [0, 0, 0, 0, 0])
    np.testing.assert_allclose(tree.marginal, [0.5, 0.5, 0.402, 0.402, 0.402], atol=1e-12)
    np.testing.assert_allclose(tree.given_present, [0.5, 0.794, 0.206, 0.01, 0.598], atol=1e-12)
    np.testing.assert_allclose(tree.given_absent, [0.5, 0.206, 0.598, 0.794, 0.206], atol=1e-12)


def test_example_b() -> None:
    tree = learn_tree(EXAMPLE_B)
    np.testing.assert_array_equal(tree.parent, [2, 3, 1, 3, 3, 0])
    np.testing.assert_allclose(tree.marginal, [0.56125, 0.6225, 0.80625, 0.3775, 0.31625, 0.745], atol=1e-12)
    np.testing.assert_allclose(
        tree.given_present, [0.613076923, 0.826666667, 0.99, 0.3775, 0.826666667, 0.881111111], atol=1e-9
    )
    np.testing.assert_allclose(tree.given_absent, [0.336666667, 0.5, 0.5, 0.3775, 0.01, 0.57], atol=1e-9)


@pytest.mark.parametrize(
    ("one", "other", "nats"), [(3, 4, 0.452172), (1, 2, 0.222787), (0, 5, 0.067414), (1, 3, 0.059412), (0, 2, 0.024746)]
)
def test_information_of_example_b(one: int, other: int, nats: float) -> None:
    assert information(EXAMPLE_B)[one, other] == pytest.approx(nats, abs=1e-6)
    assert information(EXAMPLE_B)[other, one] == information(EXAMPLE_B)[one, other]


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
