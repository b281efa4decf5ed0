"""Classifier and Detector, on a net whose prediction is the mean color of what it sees."""

from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe

pytest.importorskip("skimage")

MEAN_COLOR = """
name: "mean color"
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 10 dim: 3 dim: 8 dim: 8 } } }
layer { name: "mean" type: "Pooling" bottom: "data" top: "mean" pooling_param { pool: AVE global_pooling: true } }
layer { name: "prob" type: "InnerProduct" bottom: "mean" top: "prob"
  inner_product_param { num_output: 3 bias_term: false } }
"""


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """The net, and weights that pass the three means through."""
    model, weights = tmp_path / "deploy.prototxt", tmp_path / "net.caffemodel"
    model.write_text(MEAN_COLOR)
    net = caffe.Net(str(model), caffe.TEST)
    net.params["prob"][0].data[...] = np.eye(3)
    net.save(str(weights))
    return str(model), str(weights)


@pytest.fixture
def images() -> list[np.ndarray]:
    return [np.random.RandomState(seed).rand(16, 12, 3).astype(np.float32) for seed in range(3)]


def test_prediction_uses_the_center_crop(files: tuple[str, str], images: list[np.ndarray]) -> None:
    net = caffe.Classifier(*files, image_dims=(16, 12), raw_scale=255, channel_swap=(2, 1, 0), mean=np.ones(3))
    got = net.predict(images, oversample=False)
    assert got.shape == (3, 3)
    expected = [image[4:12, 2:10, ::-1].mean((0, 1)) * 255 - 1 for image in images]
    np.testing.assert_allclose(got, expected, rtol=1e-4)


def test_oversampling_is_the_mean_over_ten_crops(files: tuple[str, str], images: list[np.ndarray]) -> None:
    net = caffe.Classifier(*files, image_dims=np.array([16, 12]), input_scale=2.0)
    got = net.predict(images)
    crops = caffe.io.oversample(images, (8, 8)).reshape(3, 10, 64, 3)
    np.testing.assert_allclose(got, crops.mean((1, 2)) * 2, rtol=1e-4)


def test_without_a_size_images_are_resized_to_the_nets(files: tuple[str, str], images: list[np.ndarray]) -> None:
    net = caffe.Classifier(*files)
    expected = [caffe.io.resize_image(image, (8, 8)).mean((0, 1)) for image in images]
    np.testing.assert_allclose(net.predict(images, False), expected, rtol=1e-4)
    assert net.predict(images * 9, False).shape == (27, 3)  # more than a batch


@pytest.fixture
def picture(tmp_path: Path, images: list[np.ndarray]) -> str:
    from skimage.io import imsave

    path = tmp_path / "picture.png"
    imsave(path, (images[0] * 255).astype(np.uint8), check_contrast=False)
    return str(path)


def test_windows_are_warped_to_the_net(files: tuple[str, str], picture: str) -> None:
    net = caffe.Detector(*files)
    windows = [(0, 0, 8, 8), (2, 3, 16, 10)]
    found = net.detect_windows([(picture, windows)])
    assert [f["window"] for f in found] == windows
    assert {f["filename"] for f in found} == {picture}
    image = caffe.io.load_image(picture)
    for one, (top, left, bottom, right) in zip(found, windows, strict=True):
        seen = caffe.io.resize_image(image[top:bottom, left:right], (8, 8))
        np.testing.assert_allclose(one["prediction"], seen.mean((0, 1)), rtol=1e-4)


def test_windows_can_include_context(files: tuple[str, str], picture: str) -> None:
    net = caffe.Detector(*files, mean=np.array([0.25, 0.5, 0.75]), context_pad=2)
    image = caffe.io.load_image(picture)
    inside = net.crop(image, np.array([6, 4, 9, 7]))
    assert inside.shape == (8, 8, 3)
    # Half of the net's input is context: a window of 4 by 4 is seen with as much again around it.
    np.testing.assert_array_equal(inside, caffe.io.resize_image(image[4:12, 2:10], (8, 8)))
    corner = net.crop(image, np.array([0, 0, 3, 3]))
    np.testing.assert_allclose(corner[0], np.broadcast_to([0.25, 0.5, 0.75], (8, 3)), rtol=1e-6)
    prediction = net.detect_windows([(picture, [(6, 4, 9, 7)])])[0]["prediction"]
    np.testing.assert_allclose(prediction, inside.mean((0, 1)) - [0.25, 0.5, 0.75], rtol=1e-4, atol=1e-5)


def test_selective_search_is_its_authors_module(files: tuple[str, str], picture: str) -> None:
    with pytest.raises(ModuleNotFoundError, match="selective_search_ijcv_with_python"):
        caffe.Detector(*files).detect_selective_search([picture])
