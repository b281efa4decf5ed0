from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.methods.base import refuse_overlap
from loopclosure.words.vocabulary import Extractor
from loopclosure.words.word_model import Training, WordModel, train

pytestmark = pytest.mark.slow


def write_textures(folder: Path, count: int, first_seed: int = 0) -> list[Path]:
    """Write gray images with features, the last one blank."""
    folder.mkdir(exist_ok=True)
    paths = []
    for i in range(count):
        noise = np.random.default_rng(first_seed + i).random((120, 160)).astype(np.float32)
        blotches = cv2.GaussianBlur(noise, (0, 0), 2.5)
        image = cv2.normalize(blotches, blotches, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        paths.append(folder / f"{i:03d}.png")
        cv2.imwrite(str(paths[-1]), image if i < count - 1 else np.full_like(image, 128))
    return paths


@pytest.fixture(scope="module")
def training_images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_textures(tmp_path_factory.mktemp("training"), 12)


@pytest.fixture(scope="module")
def model(training_images: list[Path]) -> WordModel:
    return train(training_images, Training(words=40, lower_bound=0.0))


def test_training_counts_the_words_of_its_images_and_times_its_stages(training_images: list[Path]) -> None:
    seconds: dict[str, float] = {}
    model = train(training_images, Training(words=40, lower_bound=0.0), seconds=seconds)
    assert list(seconds) == ["training features", "vocabulary", "training words", "tree"]
    assert all(value > 0 for value in seconds.values())
    assert model.training_words.shape == (12, 40)
    np.testing.assert_array_equal(model.count_words(training_images), model.training_words)
    assert model.training_words[-1].sum() == 0  # the blank image
    assert "k-means, 40 words" in model.vocabulary.made
    assert "12 training images" in model.vocabulary.made


def test_the_same_seed_makes_the_same_model(training_images: list[Path], model: WordModel) -> None:
    again = train(training_images, Training(words=40, lower_bound=0.0))
    np.testing.assert_array_equal(again.vocabulary.centers, model.vocabulary.centers)
    np.testing.assert_array_equal(again.tree.parent, model.tree.parent)


def test_descriptors_are_clustered_with_the_same_limit_for_each_image(training_images: list[Path]) -> None:
    model = train(training_images, Training(words=40, lower_bound=0.0, max_descriptors=60))
    assert "of 55 descriptors" in model.vocabulary.made  # 5 of each image but the blank one


def test_a_saved_model_can_be_loaded(tmp_path: Path, training_images: list[Path], model: WordModel) -> None:
    path = tmp_path / "words.npz"
    model.save(path)
    loaded = WordModel.load(path)
    assert loaded.vocabulary.extractor == model.vocabulary.extractor
    assert loaded.vocabulary.made == model.vocabulary.made
    assert loaded.training == model.training
    assert loaded.training_images == [path.resolve() for path in training_images]
    for name in ("parent", "marginal", "given_present", "given_absent"):
        np.testing.assert_array_equal(getattr(loaded.tree, name), getattr(model.tree, name))
    np.testing.assert_array_equal(loaded.training_words, model.training_words)
    np.testing.assert_array_equal(loaded.count_words(training_images[:3]), model.training_words[:3])


def test_orb_words_keep_their_extractor(tmp_path: Path, training_images: list[Path]) -> None:
    extractor = Extractor("orb", max_features=60)
    train(training_images, Training(extractor, words=10, lower_bound=0.0)).save(tmp_path / "orb.npz")
    assert WordModel.load(tmp_path / "orb.npz").vocabulary.extractor == extractor


def test_files_without_a_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.npz: no such file; expected a word model"):
        WordModel.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("words")
    with pytest.raises(InputError, match=r"text.npz: cannot be read .*; expected a word model"):
        WordModel.load(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", features=np.eye(3))
    with pytest.raises(InputError, match=r"other.npz: not a word model"):
        WordModel.load(tmp_path / "other.npz")


def test_training_needs_existing_images(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs training images"):
        train([])
    with pytest.raises(InputError, match=r"gone.png: cannot be read: No such file"):
        train([tmp_path / "gone.png"])


def test_training_images_are_not_tested(tmp_path: Path, training_images: list[Path]) -> None:
    others = write_textures(tmp_path / "others", 3, first_seed=50)
    refuse_overlap(training_images, others)
    link = tmp_path / "link.png"
    link.symlink_to(training_images[4])
    with pytest.raises(InputError, match=r"words.npz: 2 of 5 test images are training images too, the first is .*link"):
        refuse_overlap(training_images, [*others, link, training_images[0]], "words.npz")
