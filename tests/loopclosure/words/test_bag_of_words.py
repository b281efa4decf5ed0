import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.words.bag_of_words import METRICS, BagOfWords

TRAINING = np.array([[1, 2, 0, 0], [1, 0, 3, 0], [4, 1, 0, 0], [1, 0, 0, 0]])


def test_rare_words_weigh_more() -> None:
    bag = BagOfWords.learn(TRAINING)
    # In all four images, in two, in one, in none (which counts as one).
    np.testing.assert_allclose(bag.idf, [0.0, np.log(2), np.log(4), np.log(4)])


def test_cosine_by_hand() -> None:
    bag = BagOfWords(np.array([1.0, 2.0, 1.0]), "cosine")
    similarity = bag.similarity(np.array([[3, 0, 0], [1, 1, 0]]), np.array([[1, 0, 0], [0, 1, 1]]))
    np.testing.assert_allclose(similarity, [[1.0, 0.0], [1 / np.sqrt(5), 4 / 5]])


def test_l1_by_hand() -> None:
    bag = BagOfWords(np.array([1.0, 2.0, 1.0]), "l1")
    # Shares (1/3, 2/3, 0) and (0, 2/3, 1/3) have 2/3 in common.
    np.testing.assert_allclose(bag.similarity(np.array([[1, 1, 0]]), np.array([[0, 1, 1], [2, 2, 0]])), [[2 / 3, 1.0]])


@pytest.mark.parametrize("metric", METRICS)
def test_similarity_lies_between_nothing_and_the_same(metric: str) -> None:
    words = np.random.default_rng(0).poisson(0.5, (30, 50))
    bag = BagOfWords.learn(words, metric)
    similarity = bag.similarity(words, words)
    np.testing.assert_allclose(np.diag(similarity), 1.0)
    np.testing.assert_allclose(similarity, similarity.T)
    assert similarity.min() >= -1e-12
    assert similarity.max() <= 1 + 1e-12
    np.testing.assert_allclose(bag.similarity(3 * words, words), similarity)  # shares, not numbers, of words


@pytest.mark.parametrize("metric", METRICS)
def test_an_image_without_words_is_like_nothing_not_even_another_one(metric: str) -> None:
    words = np.array([[0, 0, 0, 0], [0, 2, 0, 1], [5, 0, 0, 0]])  # the last has only a word that all images have
    similarity = BagOfWords.learn(TRAINING, metric).similarity(words, words)
    np.testing.assert_allclose(similarity, [[0, 0, 0], [0, 1, 0], [0, 0, 0]], atol=1e-12)


def test_an_unknown_metric() -> None:
    with pytest.raises(InputError, match='"chi2" of the bag of words; known: l1, cosine'):
        BagOfWords(np.ones(3), "chi2")
