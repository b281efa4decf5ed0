"""Similarity against the same by brute force, and thumbnails."""

import numpy as np
import pytest

from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.descriptors.thumbnails import Thumbnailer, differences, normalize_patches
from loopclosure.errors import InputError
from loopclosure.places.truth import Exclusion


def brute_force(queries, references, metric):
    if metric == "euclidean":
        return -np.linalg.norm(queries[:, None] - references[None], axis=2)
    lengths = np.linalg.norm(queries, axis=1)[:, None] * np.linalg.norm(references, axis=1)[None]
    return (queries @ references.T) / lengths


@pytest.fixture
def features():
    return np.random.default_rng(0).normal(5.0, 1.0, (40, 7))


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
def test_matrix(features, metric):
    references = features[:25] + 0.1
    np.testing.assert_allclose(
        similarity_matrix(features, references, metric), brute_force(features, references, metric), rtol=1e-9
    )
    np.testing.assert_allclose(
        similarity_matrix(features.astype(np.float32), None, metric), brute_force(features, features, metric), atol=5e-3
    )


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
def test_the_most_similar_two_views_decide(features, metric):
    queries, references = features[:20].reshape(10, -1), features[20:].reshape(10, -1)
    expected = [
        brute_force(queries[:, 7 * u : 7 * u + 7], references[:, 7 * v : 7 * v + 7], metric)
        for u in (0, 1)
        for v in (0, 1)
    ]
    np.testing.assert_allclose(similarity_matrix(queries, references, metric, views=2), np.max(expected, axis=0))


def test_a_zero_feature_has_cosine_similarity_zero():
    scores = similarity_matrix(np.array([[0.0, 0.0], [1.0, 0.0]]), metric="cosine")
    np.testing.assert_array_equal(scores, [[0.0, 0.0], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: similarity_matrix(np.zeros(3)), "shape"),
        (lambda: similarity_matrix(np.zeros((3, 2)), np.zeros((3, 4))), "queries have 2 dimensions, references 4"),
        (lambda: similarity_matrix(np.zeros((3, 2)), metric="l1"), 'unknown metric "l1"'),
        (lambda: similarity_matrix(np.array([[0.0], [np.nan]])), "frame 1"),
        (lambda: Exclusion(frames=-1), "cannot exclude -1"),
    ],
)
def test_errors_are_reported(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


def test_each_patch_has_zero_mean_and_unit_sample_deviation() -> None:
    image = np.random.default_rng(0).random((16, 24)) * np.linspace(1, 200, 24)
    patches = normalize_patches(image, 8).reshape(2, 8, 3, 8).transpose(0, 2, 1, 3).reshape(6, 64)
    np.testing.assert_allclose(patches.mean(axis=1), 0.0, atol=1e-6)
    np.testing.assert_allclose(patches.std(axis=1, ddof=1), 1.0, atol=1e-6)


def test_a_patch_by_hand() -> None:
    image = np.array([[0.0, 2.0, 7.0, 7.0], [2.0, 0.0, 7.0, 7.0]])
    side = 1 / np.sqrt(4 / 3)
    np.testing.assert_allclose(
        normalize_patches(image, 2), [[-side, side, 0, 0], [side, -side, 0, 0]], atol=1e-6
    )  # a uniform patch is 0, not NaN


def test_uniform_patches_whose_mean_is_rounded_are_zero() -> None:
    np.testing.assert_array_equal(normalize_patches(np.full((24, 32), 0.1), 0), 0.0)


def test_the_whole_image_as_one_patch() -> None:
    image = np.random.default_rng(1).random((6, 9))
    np.testing.assert_allclose(normalize_patches(image), (image - image.mean()) / image.std(ddof=1), atol=1e-6)


def test_thumbnails_ignore_brightness_and_contrast_by_default() -> None:
    image = np.random.default_rng(2).integers(0, 100, (48, 64)).astype(np.uint8)
    brighter = 2 * image + 40
    normalized, plain = Thumbnailer(), Thumbnailer(normalize="none")
    assert normalized(image).shape == (24, 32)
    np.testing.assert_allclose(normalized(brighter), normalized(image), atol=0.05)  # gray values are whole numbers
    assert plain(brighter).mean() == pytest.approx(2 * plain(image).mean() + 40, abs=1)


def test_shrinking_averages_and_color_becomes_gray() -> None:
    image = np.kron([[0, 255], [255, 0]], np.ones((12, 16))).astype(np.uint8)
    image[::2, ::2] = 128
    shrunk = Thumbnailer(width=2, height=2, normalize="none")
    expected = np.kron([[0.75 * 0 + 0.25 * 128, 0.75 * 255 + 0.25 * 128]], [[1.0]])
    np.testing.assert_allclose(shrunk(image)[0], expected[0], atol=0.51)
    np.testing.assert_array_equal(shrunk(np.dstack([image] * 3)), shrunk(image))


def test_differences_are_means_over_the_pixels() -> None:
    a = np.array([[[0.0, 1.0], [2.0, 3.0]]])
    b = np.array([[[0.0, 1.0], [2.0, 3.0]], [[1.0, 1.0], [2.0, -3.0]]])
    np.testing.assert_allclose(differences(a, b), [[0.0, 7 / 4]])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"normalize": "both"}, '"both"; known: image, patch, none'),
        ({"normalize": "patch", "width": 30}, "30x24 pixels cannot be divided into patches of 8"),
        ({"width": 0}, "has no pixels"),
    ],
)
def test_impossible_thumbnails_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Thumbnailer(**settings)
