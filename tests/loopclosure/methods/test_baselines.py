"""The baselines as the evaluation calls them: one sequence and two traverses, with files and settings."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.methods.base import Images, MethodContext
from loopclosure.methods.baselines import BagOfWordsMethod, FabMapMethod, ThumbnailMethod
from loopclosure.methods.named import make_method
from loopclosure.progress import silent
from loopclosure.words.word_model import WordModel

pytestmark = pytest.mark.slow

PLACES = 8


def scene(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).random((140, 180)).astype(np.float32)
    blotches = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(blotches, blotches, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Write 10 training scenes, and a walk past 8 other ones, twice, the second time shifted and darker."""
    folder = tmp_path_factory.mktemp("scenes")

    def write(name: str, image: np.ndarray) -> Path:
        cv2.imwrite(str(folder / f"{name}.png"), image)
        return folder / f"{name}.png"

    train = [write(f"train{i}", scene(i)[:120, :160]) for i in range(10)]
    first = [write(f"first{i}", scene(100 + i)[:120, :160]) for i in range(PLACES)]
    again = [write(f"again{i}", (scene(100 + i)[2:122, 2:162] * 0.8).astype(np.uint8)) for i in range(PLACES)]
    return {"train": train, "first": first, "again": again}


def of(name: str) -> dict[str, str]:
    """The settings for few images of a method with words."""
    return {} if name == "thumbnails" else {f"{name}.words": "200", f"{name}.lower_bound": "0"}


@pytest.mark.parametrize("name", ["fabmap", "bow", "thumbnails"])
def test_two_traverses(name: str, images: dict[str, list[Path]]) -> None:
    result = make_method(name, settings=of(name)).score(
        Images.of_files(images["again"], images["first"], images["train"]), silent
    )
    assert result.scores.shape == (PLACES, PLACES)
    np.testing.assert_array_equal(np.argmax(result.scores, axis=1), np.arange(PLACES))
    assert result.notes
    assert all(value >= 0 for value in result.seconds.values())


@pytest.mark.parametrize("name", ["fabmap", "bow", "thumbnails"])
def test_one_sequence(name: str, images: dict[str, list[Path]]) -> None:
    walk = images["first"] + images["again"]
    result = make_method(name, MethodContext(exclude_frames=2), of(name)).score(
        Images.of_files(walk, None, images["train"]), silent
    )
    assert result.scores.shape == (2 * PLACES, 2 * PLACES)
    assert np.isfinite(result.scores[np.tril_indices(2 * PLACES, -3)]).all()
    earlier = np.where(np.tri(2 * PLACES, 2 * PLACES, -3, dtype=bool), result.scores, -np.inf)
    np.testing.assert_array_equal(np.argmax(earlier[PLACES:], axis=1), np.arange(PLACES))


def test_every_stage_has_progress_and_time(images: dict[str, list[Path]]) -> None:
    shown: dict[str, int | None] = {}

    def progress(items, stage, total=None):
        shown[stage] = total
        return items

    result = make_method("fabmap", settings=of("fabmap")).score(
        Images.of_files(images["again"], images["first"], images["train"]), progress
    )
    assert shown == {"training features": 10, "features": 16}
    assert list(result.seconds) == [
        "training features", "vocabulary", "training words", "tree", "features", "words", "likelihoods",
    ]  # fmt: skip


def test_a_vocabulary_is_saved_and_reused(tmp_path: Path, images: dict[str, list[Path]]) -> None:
    path = tmp_path / "words.npz"
    first = make_method("fabmap", settings={**of("fabmap"), "fabmap.model": str(path)}).score(
        Images.of_files(images["again"], images["first"], images["train"]), silent
    )
    assert len(WordModel.load(path).vocabulary) == 200
    images_of_two = Images.of_files(images["again"], images["first"])
    second = make_method("fabmap", settings={"fabmap.model": str(path)}).score(images_of_two, silent)
    np.testing.assert_array_equal(first.scores, second.scores)
    assert "vocabulary" not in second.seconds
    assert f"read from {path}" in second.notes[0]
    with pytest.raises(InputError, match=r"words.npz: 10 of 10 test images are training images too"):
        make_method("bow", settings={"bow.model": str(path)}).score(Images.of_files(images["train"]), silent)
    for setting, value, sentence in (("words", "50", "words 200, not 50"), ("kind", "orb", "kind sift, not orb")):
        other = make_method("bow", settings={"bow.model": str(path), f"bow.{setting}": value})
        with pytest.raises(InputError, match=f"words.npz: was made with {sentence}"):
            other.score(images_of_two, silent)


@pytest.mark.parametrize("spec", ["fabmap", "bow"])
def test_training_images_are_required_and_not_tested(spec: str, images: dict[str, list[Path]]) -> None:
    with pytest.raises(InputError, match="needs training images"):
        make_method(spec).score(Images.of_files(images["again"], images["first"]), silent)
    with pytest.raises(InputError, match=r"8 of 16 test images are training images too"):
        make_method(spec).score(Images.of_files(images["again"], images["first"], images["first"]), silent)


def test_settings_are_passed_to_their_part() -> None:
    fabmap = make_method(
        "fabmap",
        MethodContext(exclude_frames=6, seed=4),
        {"fabmap.words": "77", "fabmap.kind": "orb", "fabmap.hit": "0.5"},
    )
    assert isinstance(fabmap, FabMapMethod)
    assert (fabmap.source.training.words, fabmap.source.training.extractor.kind) == (77, "orb")
    assert (fabmap.settings.hit, fabmap.settings.recent, fabmap.source.training.seed) == (0.5, 6, 4)
    bow = make_method("bow", settings={"bow.metric": "cosine", "bow.lower_bound": "0.5", "bow.root": "no"})
    assert isinstance(bow, BagOfWordsMethod)
    assert (bow.metric, bow.source.training.lower_bound, bow.source.training.extractor.root) == ("cosine", 0.5, False)
    small = make_method("thumbnails", settings={"thumbnails.width": "16", "thumbnails.normalize": "none"})
    assert isinstance(small, ThumbnailMethod)
    assert (small.thumbnailer.width, small.thumbnailer.normalize) == (16, "none")


@pytest.mark.parametrize(
    ("message", "spec", "settings"),
    [
        ("unknown kind of features", "bow", "kind=surf"),
        (r"write verified\+METHOD", "verified", ""),
        ("k = 0; expected 1 or more", "verified+thumbnails", "k=0"),
        ("expected at least 8", "verified+thumbnails", "max_features=3"),
        ("needs focal_px, center_x_px and center_y_px", "verified+thumbnails", "focal_px=300"),
        ('order of verified is "size"; expected score or inliers', "verified+thumbnails", "order=size"),
        ('verified has no setting "depth"', "verified+thumbnails", "depth=3"),
        ('fabmap has no setting "wrods"; known: .*words', "fabmap", "wrods=5"),
        ('fabmap: words is a whole number, not "many"', "fabmap", "words=many"),
        ('fabmap: hit is a number, not "high"', "fabmap", "hit=high"),
        ('bow: root is yes or no, not "2"', "bow", "root=2"),
        ("fabmap has no setting", "fabmap", "name=x"),
        ('unknown metric "chi2"', "bow", "metric=chi2"),
        (r"bow\+thumbnails: bow works on images", "bow+thumbnails", ""),
        ("settings are given apart", "bow:words=9", ""),
        ("settings are given apart", "verified:k=2+thumbnails", ""),
    ],
)
def test_invalid_methods_and_settings_are_refused(spec: str, settings: str, message: str) -> None:
    name, (key, _, value) = spec.partition("+")[0], settings.partition("=")
    with pytest.raises(InputError, match=message):
        make_method(spec, settings={f"{name}.{key}": value} if settings else {})
