"""features.npz: matching descriptors to images, and errors for files that do not match."""

from pathlib import Path

import numpy as np
import pytest

from loopclosure.descriptors.feature_file import read_features
from loopclosure.errors import InputError
from loopclosure.methods.base import Images
from loopclosure.methods.features import FeatureMethod
from loopclosure.methods.named import make_method
from loopclosure.progress import silent

ROWS = np.arange(8, dtype=np.float32).reshape(4, 2)


def save(path, names=None, **more):
    arrays = {"features": ROWS, **more}
    if names is not None:
        arrays["names"] = np.array(names)
    np.savez(path, **arrays)
    return path


def test_rows_are_found_by_name_in_any_order(tmp_path):
    features = read_features(save(tmp_path / "f.npz", ["rgb/1.png", "rgb/2.png", "rgb/10.png", "rgb/11.png"]))
    images = [Path("/data/fr1/rgb/10.png"), Path("/data/fr1/rgb/1.png")]
    np.testing.assert_array_equal(features.rows_of(images), ROWS[[2, 0]])


def test_rows_by_bare_file_names_and_by_absolute_ones(tmp_path):
    images = [Path("walk/rgb/b.png"), Path("walk/rgb/a.png")]
    bare = read_features(save(tmp_path / "bare.npz", ["a.png", "b.png", "c.png", "d.png"]))
    np.testing.assert_array_equal(bare.rows_of(images), ROWS[[1, 0]])
    names = [f"/elsewhere/walk/rgb/{c}.png" for c in "abcd"]
    absolute = read_features(save(tmp_path / "absolute.npz", names))
    np.testing.assert_array_equal(absolute.rows_of(images), ROWS[[1, 0]])


def test_equal_file_names_in_two_folders_are_distinguished_by_the_folder(tmp_path):
    names = ["query/1.jpg", "query/2.jpg", "ref/1.jpg", "ref/2.jpg"]
    features = read_features(save(tmp_path / "f.npz", names))
    np.testing.assert_array_equal(features.rows_of([Path("x/ref/1.jpg"), Path("x/query/1.jpg")]), ROWS[[2, 0]])
    with pytest.raises(InputError, match=r"names 1.jpg 2 times"):
        features.rows_of([Path("elsewhere/1.jpg")])


def test_a_descriptor_is_that_of_one_image(tmp_path):
    summer = save(tmp_path / "summer.npz", ["1.jpg", "2.jpg", "3.jpg", "4.jpg"])
    queries, references = [Path("summer/1.jpg"), Path("summer/2.jpg")], [Path("winter/1.jpg"), Path("winter/2.jpg")]
    with pytest.raises(InputError, match=r"one descriptor of 1.jpg; is it that of summer/1.jpg or of winter/1.jpg"):
        make_method(f"features:{summer}").score(Images.of_files(queries, references), silent)
    assert make_method(f"features:{summer}").score(Images.of_files(queries, queries), silent).scores.shape == (2, 2)


def test_images_without_a_descriptor_are_named(tmp_path):
    features = read_features(save(tmp_path / "f.npz", ["1.png", "2.png", "3.png", "4.png"]))
    with pytest.raises(InputError, match=r"no descriptor of 7.png \(1 of 2 images are not in it\)"):
        features.rows_of([Path("1.png"), Path("7.png")])


def test_without_names_the_order_counts(tmp_path):
    features = read_features(save(tmp_path / "f.npz"))
    images = [Path(f"{i}.png") for i in range(4)]
    np.testing.assert_array_equal(features.rows_of(images), ROWS)
    with pytest.raises(InputError, match="4 descriptors and no names, but there are 3 images"):
        features.rows_of(images[:3])


def test_an_array_named_after_its_blob(tmp_path):
    np.savez(tmp_path / "f.npz", feat=ROWS.reshape(4, 2, 1, 1), keys=np.array(["a", "b", "c", "d"]))
    np.testing.assert_array_equal(read_features(tmp_path / "f.npz").features, ROWS)


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({"feat": ROWS, "feat_p": ROWS}, "found feat, feat_p"),
        ({"features": ROWS[0]}, r"shape \(2,\)"),
        ({"features": ROWS, "names": np.array(["a"])}, "4 descriptors but 1 names"),
        ({"features": ROWS, "stamps": np.zeros(3)}, "4 descriptors but 3 stamps"),
        ({"features": ROWS, "zooms": np.ones(3)}, "2 numbers per image, which cannot be 3 views"),
        (
            {"features": [[0], [np.nan], [np.inf]]},
            "2 of 3 descriptors have a NaN or an infinity, the first in row 1",
        ),
    ],
)
def test_invalid_files_are_refused(tmp_path, arrays, sentence):
    np.savez(tmp_path / "f.npz", **arrays)
    with pytest.raises(InputError, match=sentence):
        read_features(tmp_path / "f.npz")


def test_missing_and_damaged_files_are_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_features(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InputError, match="cannot be read"):
        read_features(tmp_path / "text.npz")
    np.save(tmp_path / "one.npy", ROWS)
    with pytest.raises(InputError, match="cannot be read"):
        read_features(tmp_path / "one.npy")


def test_the_method_includes_the_time_of_the_net(tmp_path):
    path = save(tmp_path / "f.npz", ["1.png", "2.png", "3.png", "4.png"], seconds_per_image=np.array(0.25))
    images = [Path("1.png"), Path("2.png"), Path("3.png")]
    found = make_method(f"features:{path}").score(Images.of_files(images), silent)
    assert found.scores.shape == (3, 3)
    assert found.scores[0, 2] == pytest.approx(-np.sqrt(32))
    assert found.seconds["features"] == pytest.approx(0.75)
    assert list(found.seconds) == ["features", "similarity"]


def test_specification_of_files_and_metric(tmp_path):
    assert make_method("features:a/b.npz") == FeatureMethod(Path("a/b.npz"), Path("a/b.npz"), "euclidean")
    two = make_method("features:q.npz,r.npz", settings={"features.metric": "cosine"})
    assert two == FeatureMethod(Path("q.npz"), Path("r.npz"), "cosine")
    for spec, metric in (("features:", "cosine"), ("features:a.npz,b.npz,c.npz", "cosine"), ("features:a.npz", "city")):
        with pytest.raises(InputError):
            make_method(spec, settings={"features.metric": metric})


def test_queries_and_references_of_two_files(tmp_path):
    save(tmp_path / "q.npz", ["1.png", "2.png", "3.png", "4.png"])
    np.savez(tmp_path / "r.npz", features=ROWS + 1, names=np.array(["1.png", "2.png", "3.png", "4.png"]))
    method = make_method(f"features:{tmp_path}/q.npz,{tmp_path}/r.npz")
    scores = method.score(Images.of_files([Path("1.png")], [Path("1.png"), Path("2.png")]), silent).scores
    np.testing.assert_allclose(scores, [[-np.sqrt(2), -np.sqrt(18)]], rtol=1e-5)
