from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lmdb_build.mean import write_mean
from netspec.data.datum import array_to_datum, encoded_datum
from netspec.data.random_words import words
from netspec.data.transformer import Transformer
from netspec.errors import SpecError, Where
from netspec.proto.schema import TransformationParameter

TRAIN, TEST = 0, 1
IMAGES = np.random.default_rng(0).integers(0, 256, (40, 3, 9, 12), np.uint8)


def at(*path: str | int) -> Where:
    return Where("net.prototxt", 3, 1, "data " + ".".join(map(str, path)), "Data")


def transformer(phase: int = TEST, **fields: Any) -> Transformer:
    return Transformer(TransformationParameter(**fields), phase, at, seed=5, stream="data")


def caffe(
    image: np.ndarray, mean: np.ndarray, scale: float, crop: int, h_off: int, w_off: int, mirror: bool
) -> np.ndarray:
    """The loops of data_transformer.cpp:92-126."""
    channels = image.shape[0]
    top = np.empty((channels, crop, crop), np.float32)
    for c in range(channels):
        for h in range(crop):
            for w in range(crop):
                value = np.float32(image[c, h_off + h, w_off + w]) - np.float32(mean[c, h_off + h, w_off + w])
                top[c, h, crop - 1 - w if mirror else w] = value * np.float32(scale)
    return top


@pytest.mark.parametrize("mean_value", [[7.5], [1.0, 2.5, 103.939]])
def test_the_mean_is_subtracted_before_the_scale(mean_value: list[float]) -> None:
    found = transformer(mean_value=mean_value, scale=0.017)(list(IMAGES), range(40))
    means = np.array(mean_value, np.float32).reshape(-1, 1, 1)
    assert (found == (IMAGES.astype(np.float32) - means) * np.float32(0.017)).all()


def test_the_crop_is_central_and_floored_in_test() -> None:
    found = transformer(crop_size=6)(list(IMAGES), range(40))
    assert (found == IMAGES[:, :, 1:7, 3:9]).all()


@pytest.mark.parametrize("floats", [False, True])
def test_training_transforms_like_caffe_for_equal_random_numbers(tmp_path: Path, floats: bool) -> None:
    mean = np.random.default_rng(1).uniform(90, 140, (3, 9, 12)).astype(np.float32)
    write_mean(str(tmp_path / "mean.binaryproto"), mean)
    settings = {"crop_size": 6, "mirror": True, "scale": 0.0039, "mean_file": str(tmp_path / "mean.binaryproto")}
    images = list(IMAGES.astype(np.float32) if floats else IMAGES)
    found = transformer(TRAIN, **settings)(images, range(1000, 1040))
    draws = words(5, "data", 1000, len(images)).tolist()
    assert len({(m % 2, h % 4, w % 7) for m, h, w, _ in draws}) > 20
    assert (found == transformer(TRAIN, **settings)(np.stack(images), range(1000, 1040))).all()
    for image, top, (m, h, w, _) in zip(images, found, draws, strict=True):  # drawn in the order mirror, h_off, w_off
        assert (top == caffe(image, mean, 0.0039, 6, h % 4, w % 7, m % 2 == 1)).all()


def test_images_are_also_mirrored_in_phase_test() -> None:  # as in Caffe: only the crop knows the phase
    found = transformer(TEST, mirror=True)(list(IMAGES), range(40))
    mirrored = [(top == image[:, :, ::-1]).all() for top, image in zip(found, IMAGES, strict=True)]
    assert mirrored == [m % 2 == 1 for m in words(5, "data", 0, 40)[:, 0].tolist()]


def test_the_transform_of_a_record_does_not_depend_on_its_batch() -> None:
    train = transformer(TRAIN, crop_size=4, mirror=True)
    whole = train(list(IMAGES), range(40))
    parts = np.concatenate([train(list(IMAGES[i : i + 8]), range(i, i + 8)) for i in range(0, 40, 8)])
    assert (whole == parts).all()
    assert (whole == train(IMAGES, range(40))).all()
    assert (whole[1::3] == train(list(IMAGES[1::3]), range(1, 40, 3))).all()


def test_force_color_and_force_gray_are_for_encoded_images(caplog: pytest.LogCaptureFixture) -> None:
    file = cv2.imencode(".png", IMAGES[0].transpose(1, 2, 0))[1].tobytes()
    assert transformer().decode(encoded_datum(file)).shape == (3, 9, 12)
    assert transformer(force_gray=True).decode(encoded_datum(file)).shape == (1, 9, 12)
    gray = transformer(force_gray=True)
    for _ in range(2):
        assert gray.decode(array_to_datum(IMAGES[0])).shape == (3, 9, 12)
    assert [record.message for record in caplog.records] == ["force_color and force_gray only for encoded datum"]


@pytest.mark.parametrize(
    ("fields", "place", "message"),
    [
        ({"crop_size": 10}, "crop_size", "crop_size 10 is larger than the image, 3 x 9 x 12"),
        ({"mean_value": [1, 2]}, "mean_value", "found 2 mean_value for 3 channels, expected 1 or 3"),
        ({"mean_value": [1], "mean_file": "x"}, "mean_value", "mean_file and mean_value cannot both be set"),
        ({"force_color": True, "force_gray": True}, "force_gray", "force_color and force_gray cannot both be set"),
        ({"mean_file": "nowhere"}, "mean_file", 'mean file "nowhere" cannot be read: No such file'),
    ],
)
def test_contradictory_settings_are_refused_with_their_location(fields: dict, place: str, message: str) -> None:
    with pytest.raises(SpecError) as fault:
        transformer(**fields).output_shape((3, 9, 12))
    assert str(fault.value).startswith(f'net.prototxt:3:1: layer "data transform_param.{place}" (Data): {message}')


def test_a_mean_of_another_size_than_the_uncropped_image_is_refused(tmp_path: Path) -> None:
    write_mean(str(tmp_path / "m"), np.zeros((3, 6, 6), np.float32))
    with pytest.raises(SpecError, match=r"has shape 3 x 6 x 6, the image before cropping 3 x 9 x 12"):
        transformer(crop_size=6, mean_file=str(tmp_path / "m")).output_shape((3, 9, 12))
