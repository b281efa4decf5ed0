"""PCA whitening: its algebra, its benefit, and its use in the commands."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.stats import ortho_group

from loopclosure.cli import main
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.descriptors.whitening import learn_whitening
from loopclosure.errors import InputError
from loopclosure.methods.base import Images
from loopclosure.methods.features import FeatureMethod, WhitenBy
from loopclosure.methods.named import make_method
from loopclosure.places.frames import read_bgr
from loopclosure.progress import silent

PLACES = 20
DIMENSIONS = 24
# What all images vary in together, say the light: three directions, fifty times as strong as what tells places apart.
LIGHT = 50 * np.random.default_rng(0).normal(size=(3, DIMENSIONS))


def under_any_light(places: np.ndarray, seed: int) -> np.ndarray:
    """The descriptors (N, D) of places, each in a different light."""
    rng = np.random.default_rng(seed)
    noise = 0.05 * rng.normal(size=places.shape)
    return (7 + places + rng.normal(size=(len(places), 3)) @ LIGHT + noise).astype(np.float32)


def places(seed: int, count: int = PLACES) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, DIMENSIONS))


@pytest.fixture
def training() -> np.ndarray:
    return under_any_light(places(seed=1, count=400), seed=2)


@pytest.fixture
def laps() -> np.ndarray:
    """Twice the same places (2 * PLACES, D); none of them is in ``training``."""
    return under_any_light(np.tile(places(seed=3), (2, 1)), seed=4)


@pytest.fixture
def files(tmp_path: Path, training: np.ndarray, laps: np.ndarray) -> Path:
    """A folder with laps.npz, which has the image names of ``two_laps``, and other.npz, with some of them."""
    np.savez(tmp_path / "laps.npz", features=laps, names=np.array([f"rgb/{i}.png" for i in range(len(laps))]))
    np.savez(tmp_path / "other.npz", features=training, names=np.array([f"{i}.png" for i in range(len(training))]))
    return tmp_path


def found(scores: np.ndarray) -> float:
    """The share of frames of the second lap that match the same place in the first lap."""
    return float(np.mean(scores.argmax(axis=1) == np.arange(PLACES)))


def test_training_descriptors_come_out_with_unit_covariance(training):
    whitening = learn_whitening(training)
    rows = whitening.project(training)
    assert rows.dtype == np.float32
    assert rows.shape == (400, DIMENSIONS)
    np.testing.assert_allclose(rows.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(rows.T), np.eye(DIMENSIONS), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(whitening(training), axis=1), 1, rtol=1e-5)


def test_the_power_interpolates_between_original_and_equal_variances(training):
    turned = np.cov(learn_whitening(training, power=0.0).project(training).T)
    variances = np.sort(np.linalg.eigvalsh(np.cov(training.T)))[::-1]
    np.testing.assert_allclose(np.diag(turned), variances, rtol=1e-3)
    half = np.cov(learn_whitening(training, power=0.5).project(training).T)
    np.testing.assert_allclose(np.diag(half), np.sqrt(variances), rtol=1e-3)


def test_without_division_all_components_keep_the_distances(training, laps):
    rows = learn_whitening(training, power=0.0).project(laps)
    np.testing.assert_allclose(pdist(rows), pdist(laps), rtol=1e-4)


def test_the_strongest_components_are_kept(training, laps):
    everything, few = learn_whitening(training), learn_whitening(training, components=5)
    np.testing.assert_array_equal(few.projection, everything.projection[:, :5])
    assert few(laps).shape == (2 * PLACES, 5)
    assert str(few) == "whitened by other descriptors: 400 images, 5 components, power 1"


def test_order_and_rotation_of_the_dimensions_do_not_matter(training, laps):
    expected = similarity_matrix(learn_whitening(training)(laps))
    shuffled = np.random.default_rng(5).permutation(DIMENSIONS)
    turned = ortho_group.rvs(DIMENSIONS, random_state=6).astype(np.float32)
    for change in (np.eye(DIMENSIONS, dtype=np.float32)[shuffled], turned):
        scores = similarity_matrix(learn_whitening(training @ change)(laps @ change))
        np.testing.assert_allclose(scores, expected, atol=2e-3)


def test_dimensions_without_variance_are_omitted(training, laps):
    def widened(rows):
        constant = np.full((len(rows), 1), 1000.1, np.float32)
        return np.hstack([rows, constant, rows[:, :1], np.zeros_like(constant)])

    whitening = learn_whitening(widened(training))
    assert whitening.projection.shape == (DIMENSIONS + 3, DIMENSIONS)
    np.testing.assert_allclose(np.cov(whitening.project(widened(training)).T), np.eye(DIMENSIONS), atol=0.01)
    assert found(similarity_matrix(whitening(widened(laps[PLACES:])), whitening(widened(laps[:PLACES])))) == 1


def test_few_images_give_few_components(training):
    assert learn_whitening(training[:4]).projection.shape == (DIMENSIONS, 3)
    assert learn_whitening(training[:2]).projection.shape == (DIMENSIONS, 1)


def test_a_descriptor_at_the_mean_stays_zero(training):
    whitening = learn_whitening(training)
    np.testing.assert_array_equal(whitening(whitening.mean[None]), np.zeros((1, DIMENSIONS)))


def test_whitening_finds_pairs_hidden_by_common_variation(training, laps):
    first, second = laps[:PLACES], laps[PLACES:]
    assert found(similarity_matrix(second, first)) < 0.3
    assert found(similarity_matrix(second, first, "cosine")) < 0.3
    whitening = learn_whitening(training)
    assert found(similarity_matrix(whitening(second), whitening(first))) == 1


@pytest.mark.parametrize(
    ("descriptors", "settings", "sentence"),
    [
        (np.ones((1, 3)), {}, "other.npz: has 1 descriptors; a whitening is learned from at least 2"),
        (np.full((5, 3), 0.1), {}, "other.npz: has 5 descriptors that are all the same"),
        (np.array([[1.0], [np.nan]]), {}, "other.npz: has a descriptor with a NaN"),
        (np.eye(3), {"components": 0}, "components is 0; expected 1 or more"),
        (np.eye(3), {"power": 1.5}, "power is 1.5; expected 0"),
    ],
)
def test_unusable_training_images_are_refused(descriptors, settings, sentence):
    with pytest.raises(InputError, match=sentence):
        learn_whitening(descriptors.astype(np.float32), source="other.npz", **settings)


def test_specifications():
    a, t = Path("a.npz"), "t.npz"
    assert make_method("features:a.npz:whiten=t.npz") == FeatureMethod(a, a, "euclidean", WhitenBy(t))
    written_out = "features:q.npz,r.npz:cosine:components=128,power=0.5,whiten=t.npz"
    assert make_method(written_out) == FeatureMethod(Path("q.npz"), Path("r.npz"), "cosine", WhitenBy(t, 128, 0.5))
    assert make_method("features:a.npz,whiten=t.npz") == FeatureMethod(a, a, "euclidean", WhitenBy(t))
    assert make_method("features:a.npz:cosine,whiten=t.npz") == FeatureMethod(a, a, "cosine", WhitenBy(t))
    odd = Path("run:1/lr=0.1.npz")
    assert make_method(f"features:{odd}:cosine") == FeatureMethod(odd, odd, "cosine")
    assert make_method("features:a.npz:whiten=t.npz").name == "a (euclidean, whitened)"


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ("whitne=t.npz", 'features has no setting "whitne=t.npz"; write setting=value with components, power, whiten'),
        ("components=128", "add whiten=OTHER.npz"),
        ("whiten=", "add whiten=OTHER.npz"),
        ("whiten=t.npz,components=many", 'components is a whole number, not "many"'),
    ],
)
def test_invalid_specifications_are_refused(settings, sentence):
    with pytest.raises(InputError, match=sentence):
        make_method(f"features:a.npz:{settings}")


def test_queries_and_references(tmp_path, training, laps):
    names = np.array([f"{i}.png" for i in range(PLACES)])
    np.savez(tmp_path / "r.npz", features=laps[:PLACES], names=names)
    np.savez(tmp_path / "q.npz", features=laps[PLACES:], names=names)
    np.savez(tmp_path / "other.npz", features=training)
    method = make_method(f"features:{tmp_path}/q.npz,{tmp_path}/r.npz:whiten={tmp_path}/other.npz")
    images = [Path(name) for name in names]
    result = method.score(Images.of_files(images, images), silent)
    assert found(result.scores) == 1
    assert list(result.seconds) == ["training whitening", "whitening", "similarity"]
    assert result.training_stages == ("training whitening",)


def test_each_view_is_whitened(files, training, laps):
    """The first lap sees the places in its first views, the second lap in its second ones."""
    elsewhere = under_any_light(places(seed=5, count=2 * PLACES), seed=6)
    rows = np.hstack([laps, elsewhere])
    rows[PLACES:] = np.hstack([elsewhere, laps])[PLACES:]
    names = np.array([f"rgb/{i}.png" for i in range(len(rows))])
    np.savez(files / "views.npz", features=rows, names=names, zooms=np.array([1, 0.7]))
    halves = np.hstack([training[:200], training[200:]])
    np.savez(files / "halves.npz", features=halves, zooms=np.array([1, 0.7]))  # the same, as 200 images of two views
    images = [Path(f"/data/two_laps/rgb/{i}.png") for i in range(len(laps))]
    shares = {}
    for other in ("other.npz", "halves.npz"):
        result = make_method(f"features:{files}/views.npz:whiten={files / other}").score(
            Images.of_files(images), silent
        )
        shares[other] = found(result.scores[PLACES:, :PLACES])
        assert "2 views of 24 dimensions, euclidean" in result.notes
    assert min(shares.values()) >= 0.95
    with pytest.raises(InputError, match=r"laps.npz: has 1 view\(s\) of each image, .*views.npz has 2"):
        make_method(f"features:{files}/views.npz,{files}/laps.npz").score(Images.of_files(images, images), silent)


def test_whitened_features_are_those_of_the_same_images(files, training, laps):
    stamps = np.arange(len(laps), dtype=float)
    np.savez(files / "views.npz", features=np.hstack([laps, laps[::-1]]), stamps=stamps, zooms=np.array([1, 0.7]))
    features, whitening = read_features(files / "views.npz"), learn_whitening(training, components=5)
    white = features.whitened(whitening)
    np.testing.assert_allclose(white.features, np.hstack([whitening(laps), whitening(laps[::-1])]), atol=1e-6)
    assert (white.names, white.views, white.path) == (features.names, 2, features.path)
    np.testing.assert_array_equal(white.stamps, stamps)


def test_detect_finds_loops_through_the_views(two_laps, tmp_path):
    rng = np.random.default_rng(0)
    lap, other = rng.normal(size=(2, 2 * PLACES, 8))
    rows = np.hstack([lap, other])
    rows[PLACES:, :8] = other[:PLACES]  # the second lap's whole image is what the first saw in the middle
    np.savez(tmp_path / "views.npz", features=rows, zooms=np.array([1, 0.7]))
    words = ["detect", str(two_laps), "--features", str(tmp_path / "views.npz"), "--threshold", "-0.01"]
    assert main([*words, "--exclude-recent", "10", "--out", str(tmp_path)]) == 0
    with (tmp_path / "loops.csv").open() as stream:
        assert [int(row["match_id"]) for row in csv.DictReader(stream)] == list(range(PLACES))


def test_tested_images_are_refused_for_training(files, training, laps):
    images = [Path(f"/data/two_laps/rgb/{i}.png") for i in range(len(laps))]
    nearly = laps[5] * np.float32(1.0001)
    np.savez(files / "overlap.npz", features=np.vstack([training, nearly]), names=np.array(["x"] * 400 + ["a/5.png"]))
    np.savez(files / "nameless.npz", features=np.vstack([nearly, training]))
    for other in ("overlap.npz", "nameless.npz"):
        method = make_method(f"features:{files}/laps.npz:whiten={files / other}")
        sentence = rf"{other}: 1 of 40 test images are training images too, the first is .*rgb/5.png"
        with pytest.raises(InputError, match=sentence):
            method.score(Images.of_files(images), silent)
        with pytest.raises(InputError, match=r"1 of 10 test images are"):
            method.score(Images.of_files(images[20:], images[:10]), silent)
    # Equal names alone are no equal images: those of other.npz are 0.png to 399.png as well.
    assert make_method(f"features:{files}/laps.npz:whiten={files}/other.npz").score(Images.of_files(images), silent)


def test_files_of_two_nets(files, laps):
    np.savez(files / "wide.npz", features=np.random.default_rng(0).normal(size=(9, 30)))
    method = make_method(f"features:{files}/laps.npz:whiten={files}/wide.npz")
    with pytest.raises(InputError, match=r"wide.npz: has descriptors of 30 dimensions, those to be whitened have 24"):
        method.score(Images.of_files([Path("rgb/1.png"), Path("rgb/2.png")]), silent)


@pytest.mark.slow
def test_evaluate(two_laps, files, tmp_path, capsys):
    plain = f"features:{files}/laps.npz"
    white = f"{plain}:whiten={files}/other.npz,components=100"
    methods = [f"plain={plain}", white, f"with sequences=seqslam+{white}"]
    words = ["evaluate", str(two_laps), "--out", str(tmp_path / "report")]
    assert main([*words, *(word for method in methods for word in ("--method", method))]) == 0
    assert "laps (euclidean, whitened)" in capsys.readouterr().out
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    plain, white, sequences = report["methods"]
    note = f"whitened by {files}/other.npz: 400 images, 24 components, power 1"
    assert note in white["notes"]
    assert note in sequences["notes"]
    assert not any("whitened" in line for line in plain["notes"])
    assert "training whitening" not in white["milliseconds_a_frame"]
    averages = [[f["average precision"] for c, f in m["figures"].items() if "all pairs" in c] for m in (plain, white)]
    assert max(averages[0]) < 0.5
    assert min(averages[1]) > 0.99


def test_detect(two_laps, files, tmp_path):
    words = ["detect", str(two_laps), "--features", str(files / "laps.npz"), "--exclude-recent", "10"]
    words += ["--threshold", "-0.9", "--out", str(tmp_path)]

    def right():
        with (tmp_path / "loops.csv").open() as stream:
            loops = [(int(row["query_id"]), int(row["match_id"])) for row in csv.DictReader(stream)]
        return len(loops) >= PLACES - 2 and all(query - match == PLACES for query, match in loops)

    assert main(words) == 0
    assert not right()
    assert main([*words, "--whiten", str(files / "other.npz")]) == 0
    assert right()


def test_detect_whitens_what_describe_returns(two_laps, tmp_path, capsys):
    describe = Thumbnailer()
    rows = np.stack([describe(read_bgr(two_laps / "rgb" / f"{i}.png")).reshape(-1) for i in range(PLACES)])
    np.savez(tmp_path / "other.npz", features=rows)
    saved = tmp_path / "detector.npz"
    words = ["detect", str(two_laps), "--threshold", "-0.5", "--save", str(saved), "--out", str(tmp_path)]
    words += ["--describe", "loopclosure.descriptors.thumbnails:Thumbnailer"]
    assert main([*words, "--whiten", str(tmp_path / "other.npz")]) == 0
    with np.load(saved) as detector:
        np.testing.assert_allclose(detector["rows"][:PLACES], learn_whitening(rows)(rows), atol=1e-5)

    np.savez(tmp_path / "wide.npz", features=np.random.default_rng(0).random((50, 7)))
    assert main([*words, "--whiten", str(tmp_path / "wide.npz")]) == 1
    assert "wide.npz: has descriptors of 7 dimensions, those to be whitened have" in capsys.readouterr().err
