from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from loopclosure.errors import InputError
from loopclosure.words.bag_of_words import METRICS, BagOfWords
from loopclosure.words.vocabulary import Extractor, Vocabulary, kmeans, nearest_centers


def texture(seed: int) -> np.ndarray:
    """Return a blotchy gray image (120, 160) that has features."""
    noise = np.random.default_rng(seed).random((120, 160)).astype(np.float32)
    blotches = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return cv2.normalize(blotches, blotches, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def unit_vectors(count: int, size: int = 8, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, size))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("root", [True, False])
def test_sift_descriptors_are_unit_vectors(root: bool) -> None:
    found = Extractor(root=root)(texture(0))
    assert found.dtype == np.float32
    assert found.shape[1] == 128
    assert len(found) > 20
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)


def test_root_sift_is_the_root_of_the_shares() -> None:
    plain, root = Extractor(root=False)(texture(0)), Extractor(root=True)(texture(0))
    np.testing.assert_allclose(root**2, plain / plain.sum(axis=1, keepdims=True), atol=1e-6)


def test_orb_descriptors_are_bits() -> None:
    found = Extractor("orb", max_features=50)(texture(0))
    assert found.shape[1] == 256
    assert 0 < len(found) <= 50
    assert set(np.unique(found)) == {0.0, 1.0}


@pytest.mark.parametrize("kind", ["sift", "orb"])
def test_a_blank_image_has_no_features_and_no_words(kind: str) -> None:
    extractor = Extractor(kind)
    blank = np.full((120, 160), 90, np.uint8)
    assert extractor(blank).shape == (0, extractor.size)
    vocabulary = Vocabulary(np.eye(3, extractor.size, dtype=np.float32), extractor)
    np.testing.assert_array_equal(vocabulary.count_descriptors(extractor(blank)), [0, 0, 0])


def test_the_number_of_features_is_limited_and_color_becomes_gray() -> None:
    extractor = Extractor(max_features=15)
    assert len(extractor(texture(1))) == 15
    np.testing.assert_array_equal(extractor(cv2.cvtColor(texture(1), cv2.COLOR_GRAY2BGR)), extractor(texture(1)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Extractor(kind="surf"), '"surf"; known: sift, orb'),
        (lambda: Extractor(max_features=0), "is 0"),
        (lambda: kmeans(unit_vectors(7), 8), "7 descriptors cannot make 8 words"),
    ],
)
def test_impossible_settings_and_descriptors_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_nearest_center_across_blocks() -> None:
    descriptors, centers = unit_vectors(9000, seed=1), unit_vectors(30, seed=2) * 0.7
    np.testing.assert_array_equal(nearest_centers(descriptors, centers), np.argmin(cdist(descriptors, centers), axis=1))


def test_words_are_counted() -> None:
    centers = unit_vectors(5, 128)
    vocabulary = Vocabulary(centers, Extractor())
    np.testing.assert_array_equal(vocabulary.count_descriptors(centers[[3, 1, 3]]), [0, 1, 0, 2, 0])
    assert len(vocabulary) == 5


@pytest.mark.slow
def test_kmeans_finds_clusters_and_follows_the_seed() -> None:
    heaps = unit_vectors(10, 16, seed=4)
    points = np.repeat(heaps, 200, axis=0) + np.random.default_rng(0).normal(0, 0.01, (2000, 16)).astype(np.float32)
    centers = kmeans(points, 10, seed=1)
    assert centers.shape == (10, 16)
    assert centers.dtype == np.float32
    spread = np.linalg.norm(points - centers[nearest_centers(points, centers)], axis=1)
    assert spread.mean() < 0.2
    np.testing.assert_array_equal(centers, kmeans(points, 10, seed=1))


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
def test_an_image_without_words_has_similarity_0(metric: str) -> None:
    words = np.array([[0, 0, 0, 0], [0, 2, 0, 1], [5, 0, 0, 0]])  # the last has only a word that all images have
    similarity = BagOfWords.learn(TRAINING, metric).similarity(words, words)
    np.testing.assert_allclose(similarity, [[0, 0, 0], [0, 1, 0], [0, 0, 0]], atol=1e-12)
