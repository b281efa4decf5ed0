"""Data layers of images with a label for each pixel: those of SegNet and ENet, of HED and of RCF."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from netspec import use_dialect
from netspec.errors import SpecError
from netspec.layers import Context, Layer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TRAIN

Build = Callable[..., Layer]


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """A list of two images 6 x 8 whose blue is the place of a pixel, and their labels, which are the same."""
    place = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for name in ("a", "b"):
        value = place if name == "a" else 255 - place
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.stack([value, value * 0, value * 0], axis=2))
        cv2.imwrite(str(tmp_path / f"{name}_labels.png"), value)
    (tmp_path / "list.txt").write_text("/a.png /a_labels.png\n/b.png /b_labels.png\n")
    return tmp_path


def dense(pairs: Path, given: str = "", transform: str = "") -> Layer:
    use_dialect("segmentation")
    settings = f'source: "{pairs}/list.txt" root_folder: "{pairs}" batch_size: 2 {given}'
    text = f"type: 'DenseImageData' dense_image_data_param {{ {settings} }} transform_param {{ {transform} }}"
    return make_layer(text, (), Context(TRAIN), 2)


def test_labels_are_mirrored_and_cropped_as_their_images(pairs: Path) -> None:
    layer = dense(pairs, "mirror: true crop_height: 4 crop_width: 5 shuffle: true", "mean_value: 3 scale: 0.5")
    seen = set()
    for _ in range(12):
        images, labels = layer.run()
        assert images.shape == (2, 3, 4, 5)
        assert labels.shape == (2, 1, 4, 5)
        assert torch.equal(images[:, :1], (labels - 3) * 0.5)
        seen |= {tuple(label.flatten()[:2].tolist()) for label in labels}
    layer.close()
    assert len(seen) > 12  # other windows, mirrored or not


def test_labels_are_resized_by_nearest_neighbor_and_label_divide_factor(pairs: Path) -> None:
    layer = dense(pairs, "new_height: 12 new_width: 16 label_divide_factor: 4")
    images, labels = layer.run()
    layer.close()
    assert images.shape == (2, 3, 12, 16)
    assert labels.shape == (2, 1, 3, 4)
    assert labels[0, 0, 1].tolist() == [16, 18, 20, 22]


@pytest.mark.parametrize(
    ("given", "transform", "fault"),
    [
        ("new_height: 4", "", "new_height and new_width must be given together"),
        ("", "mirror: true", "mirror would not change the labels; give mirror in dense_image_data_param"),
        ("", "crop_size: 4", "give crop_height and crop_width in dense_image_data_param"),
        ("crop_height: 7 crop_width: 7", "", "smaller than the crop"),
        ("label_divide_factor: 0", "", "label_divide_factor must be at least 1"),
    ],
    ids=["new_width", "mirror", "crop_size", "crop_height", "label_divide_factor"],
)
def test_invalid_settings_are_refused(pairs: Path, given: str, transform: str, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        dense(pairs, given, transform)


def test_lines_other_than_two_existing_names_are_refused(pairs: Path) -> None:
    (pairs / "list.txt").write_text("/a.png 0 1\n")
    with pytest.raises(SpecError, match=r'list\.txt:1:1: found "/a.png 0 1", expected the names of an image'):
        dense(pairs)
    (pairs / "list.txt").write_text("/a.png /c.png\n")
    with pytest.raises(SpecError, match=r"c\.png"):
        dense(pairs)


EDGES = """layer { name: "data" type: "ImageLabelmapData" top: "data" top: "label"
  image_data_param { source: "%s/list.txt" root_folder: "%s" batch_size: 2 }
  transform_param { mirror: true crop_size: 4 mean_value: 1 } }"""


@pytest.mark.parametrize("dialect", ["hed", "rcf"])
def test_values_below_127_in_edge_maps_are_zero_for_hed_and_kept_for_rcf(pairs: Path, dialect: str) -> None:
    use_dialect(dialect)
    (text,) = (EDGES % (pairs, pairs)).partition("{")[2:]
    layer = make_layer(text.rpartition("}")[0], (), Context(TRAIN), 2)
    images, labels = layer.run()
    layer.close()
    gray = images[:, :1] + 1
    below = torch.zeros_like(gray) if dialect == "hed" else gray / 255
    assert torch.equal(labels, torch.where(gray > 127, 1, below))


def test_segnets_bn_has_tops_for_mean_and_variance_of_the_batch(build: Build) -> None:
    """The program that prepares SegNet and ENet for testing averages them over all batches."""
    data = torch.arange(12.0).reshape(2, 2, 1, 3).requires_grad_()
    layer = build("blocks", "type: 'BN' bn_param { scale_filler { value: 1 } }", data.shape, tops=3)
    top, mean, variance = layer.run(data)
    assert mean.tolist() == [[[[4.0]], [[7.0]]]]
    np.testing.assert_allclose(variance.flatten(), [29 / 3, 29 / 3], rtol=1e-6)
    np.testing.assert_allclose(top.detach(), (data.detach() - mean) / variance.sqrt(), rtol=1e-5)
    assert [tuple(each.shape) for each in (top, mean, variance)] == layer.top_shapes
    assert not mean.requires_grad
