"""HOG, CoHOG-like regions and VLAD."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.descriptors.thumbnails import Hog
from loopclosure.errors import InputError
from loopclosure.evaluate import evaluate, named_method
from loopclosure.methods.base import Images, MethodContext
from loopclosure.methods.named import make_method
from loopclosure.places.datasets import load_sequence
from loopclosure.places.sequences import read_sequence
from loopclosure.progress import silent
from loopclosure.words.bag_of_words import vlad
from loopclosure.words.vocabulary import Extractor, Vocabulary
from tests.loopclosure.conftest import blots


def stripes(turn_deg: float) -> np.ndarray:
    """Stripes whose gradient has this direction, (128, 128)."""
    y, x = np.mgrid[:128, :128]
    along = x * np.cos(np.radians(turn_deg)) + y * np.sin(np.radians(turn_deg))
    return (127 + 100 * np.sin(along / 3)).astype(np.uint8)


@pytest.mark.parametrize(("turn_deg", "bin_"), [(10, 0), (90, 4), (170, 8)])
def test_gradients_are_counted_in_the_bin_of_their_direction(turn_deg, bin_):
    blocks = Hog(side=128).blocks(stripes(turn_deg))
    assert blocks.shape == (7, 7, 36)
    assert np.argmax(blocks.reshape(49, 4, 9).sum(axis=(0, 1))) == bin_
    np.testing.assert_allclose(np.linalg.norm(blocks, axis=2), 1, rtol=1e-5)


def test_blocks_do_not_depend_on_brightness_and_contrast():
    image = blots(0)
    darker = (image * 0.5 + 20).astype(np.uint8)
    a, b, other = (Hog().blocks(picture) for picture in (image, darker, blots(1)))
    assert np.sum(a * b) > 0.97 * np.sum(a * a)
    assert np.sum(a * other) < 0.8 * np.sum(a * a)


def test_entropy_is_that_of_the_gray_values():
    image = np.zeros((256, 256), np.uint8)
    image[:, 128:] = np.random.default_rng(0).integers(0, 256, (256, 128), np.uint8)
    entropies = Hog().entropies(image)
    assert entropies.shape == (15, 15)
    assert entropies[:, :6].max() == 0
    assert entropies[:, 9:].min() > 0.98
    assert not Hog().blocks(np.zeros((50, 50), np.uint8)).any()


def test_vlad_sums_differences_to_the_nearest_word():
    words = Vocabulary(np.array([[0, 0], [10, 10], [-10, 0]], np.float32), Extractor())
    found = vlad(np.array([[1, 0], [2, 0], [10, 13]], np.float32), words).reshape(3, 2)
    np.testing.assert_allclose(found, np.array([[1, 0], [0, 1], [0, 0]]) / np.sqrt(2), atol=1e-6)
    assert not vlad(np.zeros((0, 2), np.float32), words).any()


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["hog", "cohog:side=128", "vlad:words=8"])
def test_references_find_the_second_lap(spec, two_laps, tmp_path):
    data = load_sequence(read_sequence(two_laps, "tum"))
    train = []
    for i in range(10):
        train.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(train[-1]), blots(100 + i))
    (outcome,) = evaluate(data, [named_method(spec, MethodContext())], train).outcomes
    assert outcome.recall_at[1] == 1.0
    assert outcome.name == spec.partition(":")[0]


@pytest.mark.slow
def test_vlad_of_orb_words(tmp_path):
    paths = []
    for i in range(10):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), cv2.resize(blots(i % 5), (320, 240)))
    train, laps = paths[:5], [path.rename(tmp_path / f"lap_{path.name}") for path in paths[5:]]
    images = Images.of_files(laps, laps, train)
    scores = make_method("vlad:words=4,kind=orb").score(images, silent).scores
    np.testing.assert_array_equal(np.argmax(scores, axis=1), np.arange(5))
    np.testing.assert_allclose(scores.diagonal(), 1, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["hog", "cohog:side=128"])
def test_two_traverses_are_compared_in_full(spec, two_laps):
    images = load_sequence(read_sequence(two_laps, "tum")).queries.paths
    scores = make_method(spec).score(Images.of_files(images[20:], images[:20]), silent).scores
    assert scores.shape == (20, 20)
    np.testing.assert_array_equal(np.argmax(scores, axis=1), np.arange(20))


# A function of the user's as a method
MEANS = (Path(__file__).parent / "programs" / "means.py").read_text()


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "means.py"
    path.write_text(MEANS)
    return path


def test_a_function_describes_the_images(file, two_laps):
    data = load_sequence(read_sequence(two_laps, "tum"))
    methods = [named_method(f"describe:{file}:describe{metric}", MethodContext()) for metric in ("", ":cosine")]
    euclidean, cosine = evaluate(data, methods).outcomes
    assert euclidean.name == f"{file}:describe (euclidean)"
    assert euclidean.recall_at[1] == cosine.recall_at[1] == 1.0
    assert euclidean.notes[0] == "144 dimensions, euclidean"
    assert set(euclidean.seconds) == {"loading", "descriptors", "similarity"}


def test_descriptors_of_different_lengths_are_refused(file, two_laps):
    method = named_method(f"describe:{file}:growing", MethodContext())
    with pytest.raises(InputError, match="growing gave 2 numbers, and 1 before"):
        evaluate(load_sequence(read_sequence(two_laps, "tum")), [method])


@pytest.mark.parametrize("spec", ["describe", "describe:cosine", "describe:net.py", "describe:net.py:cosine"])
def test_a_function_must_be_named(spec):
    with pytest.raises(InputError, match="expected describe:"):
        make_method(spec)


# The online detector judged as a method
def test_only_accepted_matches_have_scores(two_laps, two_laps_features):
    data = load_sequence(read_sequence(two_laps, "tum"))
    context = MethodContext(data.exclude_frames)
    spec = f"detector:{two_laps_features}:threshold=-0.3,consistency=2"
    (outcome,) = evaluate(data, [named_method(spec, context)]).outcomes
    assert np.argwhere(np.isfinite(outcome.scores)).tolist() == [[i, i - 20] for i in range(22, 40)]
    assert outcome.best.precision.tolist() == [1.0] * len(outcome.best.precision)
    assert outcome.measures["best match of each query"]["recall at 100 % precision"] == pytest.approx(18 / 20)
    assert outcome.answer.startswith("frames: 10 no candidate")
    assert "best score" in outcome.answer
    assert "precision 1.000, recall 0.900" in outcome.answer


@pytest.mark.slow
def test_without_a_threshold_its_candidates_are_verified(two_laps, two_laps_features):
    method = make_method(f"detector:{two_laps_features}:verify=yes,min_inliers=500", MethodContext(9))
    result = method.score(Images.of_files(load_sequence(read_sequence(two_laps, "tum")).queries.paths), silent)
    assert not np.isfinite(result.scores).any()
    assert "30 not verified" in result.answer


def test_two_traverses_are_refused(two_laps, two_laps_features):
    images = load_sequence(read_sequence(two_laps, "tum")).queries.paths
    method = make_method(f"detector:{two_laps_features}:threshold=-1")
    with pytest.raises(InputError, match="finds loops in one sequence"):
        method.score(Images.of_files(images, images), silent)
