import numpy as np
import pytest

from loopclosure.descriptors.thumbnails import Thumbnailer, differences, normalize_patches
from loopclosure.errors import InputError


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


def test_thumbnails_ignore_brightness_and_contrast_unless_told() -> None:
    image = np.random.default_rng(2).integers(0, 100, (48, 64)).astype(np.uint8)
    brighter = 2 * image + 40
    normalized, plain = Thumbnailer(), Thumbnailer(normalize="none")
    assert normalized(image).shape == (24, 32)
    np.testing.assert_allclose(normalized(brighter), normalized(image), atol=0.05)  # gray values are whole numbers
    assert plain(brighter).mean() == pytest.approx(2 * plain(image).mean() + 40, abs=1)


def test_shrinking_averages_and_color_is_taken_as_gray() -> None:
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
def test_impossible_thumbnails(settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Thumbnailer(**settings)
