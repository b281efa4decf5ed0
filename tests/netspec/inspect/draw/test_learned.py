"""``netspec look``: filters, maps, saliency and embeddings, and what they are computed from."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.offsetbox import AnnotationBbox

import netspec
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.learned import embedding_figure, filters_figure, maps_figure, saliency_figure
from netspec.inspect.features.embedding import in_plane, read_features, thumbnails
from netspec.inspect.features.images import ImageInput, ImageNet
from netspec.inspect.features.saliency import of_distance, of_unit
from netspec.inspect.stored_weights import stored_layers
from paths import GOLDEN

WEIGHTS = GOLDEN / "snapshot" / "ref_iter_40.caffemodel"
Run = Callable[..., Any]
LINEAR = """
layer {{ name: "data" type: "Input" top: "data" input_param {{ shape {{ dim: 1 dim: {c} dim: 4 dim: 5 }} }} }}
layer {{ name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param {{ num_output: 3
  weight_filler {{ type: "gaussian" std: 1 }} }} }}
"""


def image(seed: int = 0, shape: tuple[int, ...] = (4, 5, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def linear(tmp_path: Path, channels: int = 3) -> tuple[ImageNet, np.ndarray]:
    """Return a net with one InnerProduct, and its weights (3, C, 4, 5)."""
    (tmp_path / "net.prototxt").write_text(LINEAR.format(c=channels))
    net = netspec.load_net(tmp_path / "net.prototxt", seed=1)
    netspec.save_weights(net, tmp_path / "w.caffemodel")
    weights = net.params["ip"][0].detach().numpy().reshape(3, channels, 4, 5)
    built = ImageNet(
        tmp_path / "net.prototxt",
        [tmp_path / "w.caffemodel"],
        "ip",
        ImageInput("data"),
        options=BuildOptions(exact="none", passes=()),
    )
    return built, weights


def test_stored_layers_reads_weights_without_a_net() -> None:
    layers = stored_layers(WEIGHTS)
    assert [layer.name for layer in layers][:3] == ["conv1", "conv2", "ip1"]
    assert [layer.has_filters for layer in layers[:3]] == [True, True, False]
    assert layers[0].type == "Convolution"
    h5 = {layer.name: layer for layer in stored_layers(GOLDEN / "snapshot" / "h5_iter_10.caffemodel.h5")}
    assert {layer.name: [blob.shape for blob in layer.blobs] for layer in layers if layer.name in h5} == {
        name: [blob.shape for blob in layer.blobs] for name, layer in h5.items()
    }


def test_saliency_of_a_linear_unit_is_its_largest_weight_over_the_channels(tmp_path: Path) -> None:
    net, weights = linear(tmp_path)
    for samples in (1, 4):
        found, unit, value = of_unit(net, image(), unit=1, samples=samples)
        np.testing.assert_allclose(found, np.abs(weights[1]).max(axis=0), rtol=1e-5)
        assert unit == 1
    pixels = image().transpose(2, 0, 1).astype(np.float64)
    assert value == pytest.approx((weights[1] * pixels).sum(), rel=1e-4)
    _, greatest, _ = of_unit(net, image())
    assert greatest == int((weights * pixels).sum(axis=(1, 2, 3)).argmax())
    with pytest.raises(ValueError, match="found unit 3, expected 0 to 2"):
        of_unit(net, image(), unit=3)


def test_saliency_of_a_distance_is_computed_for_both_images(tmp_path: Path) -> None:
    net, weights = linear(tmp_path, channels=1)
    a, b = (image(k, (4, 5)) for k in range(2))
    difference = weights.reshape(3, -1) @ (a.astype(float) - b).reshape(-1)
    first, second, distance = of_distance(net, a, b, samples=1)
    expected = np.abs(2 * difference @ weights.reshape(3, -1)).reshape(4, 5)
    np.testing.assert_allclose(first, expected, rtol=1e-4)
    np.testing.assert_allclose(first, second, rtol=1e-5)
    assert distance == pytest.approx(float(np.linalg.norm(difference)), rel=1e-5)


def test_principal_components_keep_distances_in_a_plane() -> None:
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(30, 2)) * [3, 1]
    points, words = in_plane(flat @ np.linalg.qr(rng.normal(size=(8, 2)))[0].T + 5)
    assert words == "two principal components, 100 % of the variance"
    expected = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    np.testing.assert_allclose(np.linalg.norm(points[:, None] - points[None], axis=2), expected, atol=1e-9)


@pytest.mark.slow
def test_tsne_separates_clusters_and_is_reproducible() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(size=(20, 6)), rng.normal(size=(20, 6)) + 20])
    points, _ = in_plane(values, "tsne")
    near = np.linalg.norm(points[:20] - points[:20].mean(axis=0), axis=1).max()
    assert np.linalg.norm(points[:20].mean(axis=0) - points[20:].mean(axis=0)) > 2 * near
    np.testing.assert_array_equal(points, in_plane(values, "tsne")[0])


def test_descriptors_of_one_number_are_drawn_on_a_line() -> None:
    points, _ = in_plane(np.arange(4.0)[:, None])
    np.testing.assert_allclose(points[:, 0], [-1.5, -0.5, 0.5, 1.5])
    assert not points[:, 1].any()


@pytest.mark.parametrize(
    "shape",
    [(8, 3, 5, 5), (4, 1, 3, 3), (4, 6, 3, 3), (4, 2, 3, 3), (40, 40, 3, 3), (1, 1, 1, 1)],
    ids=lambda shape: "x".join(map(str, shape)),
)
def test_filters_figure_draws_any_number_of_channels(shape: tuple[int, ...]) -> None:
    for of_images in (True, False):
        figure = filters_figure(np.random.default_rng(0).normal(size=shape), "t", of_images)
        assert figure.axes[0].images


def test_filters_figure_draws_zero_gray_and_the_first_channel_blue() -> None:
    filters = np.zeros((1, 3, 2, 2))
    filters[0, 0] = 1
    shown = np.asarray(filters_figure(filters, "t").axes[0].images[0].get_array())
    np.testing.assert_allclose(shown[0, 0], [0.5, 0.5, 1])
    shown = np.asarray(filters_figure(filters, "t", rgb=True).axes[0].images[0].get_array())
    np.testing.assert_allclose(shown[0, 0], [1, 0.5, 0.5])


def test_maps_figure_describes_maps_and_numbers_in_its_title() -> None:
    maps = np.random.default_rng(0).normal(size=(5, 4, 6))
    maps[2] = 0
    figure = maps_figure(maps, image(), "x")
    assert figure.get_suptitle() == "x: 5 x 4 x 6; 1 constant"
    figure = maps_figure(np.array([1.0, 7, 2]), image(shape=(4, 5)), "x")
    assert "largest: 1 (7), 2 (2), 0 (1)" in figure.get_suptitle()


def test_saliency_figure_has_a_row_of_three_axes_per_image() -> None:
    figure = saliency_figure([image(0), image(1)], [np.ones((4, 5)), np.zeros((4, 5))], "t")
    assert len(figure.axes) == 6


def test_embedding_figure_has_a_legend_of_labels_and_thumbnails() -> None:
    points = np.array([[0.0, 0], [0, 1e-6], [1, 1]])
    figure = embedding_figure(points, "t", [0, 1, None], {k: image(k) for k in range(3)})
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["label 0", "label 1", "no label"]
    boxes = [artist for artist in figure.axes[0].artists if isinstance(artist, AnnotationBbox)]
    assert len(boxes) == 2  # two of the three would overlap
    assert sum(len(np.atleast_1d(line.get_xdata())) for line in figure.axes[0].lines) == 3


def test_thumbnails_are_found_by_name_in_folders_and_by_key_in_databases(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image(k, (200, 100, 3)))
    found = thumbnails(tmp_path, ["2.png", "0.png"], 2)
    assert [picture.shape for picture in found.images.values()] == [(112, 56, 3)] * 2
    records = thumbnails(GOLDEN / "pairs" / "test_lmdb", ["00000003", "00000002"], 2)
    assert records.labels is not None
    assert len(records.labels) == 2
    assert records.images[0].shape == (28, 28)
    with pytest.raises(ValueError, match=r'has no image "9.png"'):
        thumbnails(tmp_path, ["9.png"], 1)
    with pytest.raises(ValueError, match="has 3 images, but there are 2 descriptors"):
        thumbnails(tmp_path, None, 2)


NET = ("sgd_step/train_val.prototxt", "--weights", "sgd_step/init.caffemodel")


@pytest.mark.slow
def test_look_filters_maps_and_saliency_write_pictures(run: Run) -> None:
    cv2.imwrite("a.png", image(0, (30, 40, 3)))
    cv2.imwrite("b.png", image(1, (30, 40, 3)))
    for words, said in (
        (("look", "filters", WEIGHTS), "x.png: conv1 (6, 1, 5, 5)"),
        (("look", "filters", WEIGHTS, "--layer", "conv2"), "x.png: conv2 (8, 6, 5, 5)"),
        (("look", "maps", *NET, "--blob", "conv1", "--image", "a.png"), "x.png: conv1 (6, 24, 24)"),
        (("look", "maps", *NET, "--blob", "feat", "--image", "a.png"), "x.png: feat (8,)"),
        (
            ("look", "saliency", *NET, "--blob", "feat", "--image", "a.png", "--unit", 3),
            "x.png: number 3 of feat of a.png: ",
        ),
        (
            ("look", "saliency", *NET, "--blob", "feat", "--image", "a.png", "--to", "b.png"),
            "x.png: distance of feat between ",
        ),
    ):
        result = run(*words, "--out", "x.png")
        assert (result.status, result.err) == (0, "")
        assert result.out.startswith(said)
        assert cv2.imread("x.png") is not None
        Path("x.png").unlink()


@pytest.mark.slow
def test_look_embedding_draws_descriptors_of_extract(run: Run) -> None:
    assert run("extract", *NET, "--blob", "feat", "--out", "f.npz").status == 0
    result = run("look", "embedding", "f.npz", "--images", "pairs/test_lmdb", "--out", "x.svg")
    assert (result.status, result.err) == (0, "")
    assert result.out.startswith("x.svg: feat of 200 images: two principal components, ")
    text = Path("x.svg").read_text()
    assert text.count("<image") > 5
    assert "label 1" in text
    assert run("look", "embedding", "f.npz", "--out", "y.png").status == 0


NO_NPZ = "cannot be read (File is not a zip file); expected a features.npz written by netspec extract"
INVALID = {
    "unknown_layer": (f"filters {WEIGHTS} --layer conv3", 'no layer "conv3" with filters; did you mean "conv'),
    "missing_weights": ("filters none.caffemodel", "none.caffemodel: cannot be read: No such file"),
    "unknown_blob": (f"maps {' '.join(NET)} --blob no --image a.png", 'no blob "no"'),
    "missing_image": (f"maps {' '.join(NET)} --blob conv1 --image no.png", "no.png: cannot be read"),
    "not_an_npz": ("embedding a.png", f"a.png: {NO_NPZ}"),
    "truncated_npz": ("embedding cut.npz", f"cut.npz: {NO_NPZ}"),
    "missing_npz": ("embedding no.npz", "no.npz: no such file; expected a features.npz written by netspec extract"),
    "unknown_array": ("embedding f.npz --array fea", 'f.npz: has no descriptors "fea"; did you mean "feat"?'),
    "no_images": ("embedding f.npz --images pairs", "pairs: contains no images"),
}


@pytest.mark.parametrize(("words", "said"), INVALID.values(), ids=INVALID)
def test_invalid_arguments_of_look_are_refused(run: Run, words: str, said: str) -> None:
    cv2.imwrite("a.png", image(0, (30, 40, 3)))
    np.savez("f.npz", feat=np.zeros((3, 2), np.float32))
    Path("cut.npz").write_bytes(Path("f.npz").read_bytes()[:150])
    shutil.rmtree("none", ignore_errors=True)
    assert said in run("look", *words.split(), "--out", "x.png").fault
    assert not Path("x.png").exists()


def test_nonfinite_descriptors_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "f.npz", feat=np.full((3, 2), np.nan))
    with pytest.raises(ValueError, match="expected two or more, of finite numbers"):
        read_features(tmp_path / "f.npz")
