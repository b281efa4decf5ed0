"""Folders in which left and right images alternate: which images are taken, which mask fits, what is compared."""

from pathlib import Path

import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.masks import CAMERAS, comparable, images_of_places, mask_of_places

PLACES = {
    "all": [[0], [1], [2], [3]],
    "left": [[0], [2]],
    "right": [[1], [3]],
    "both": [[0], [1], [2], [3]],
    "joined": [[0, 1], [2, 3]],
}


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_images_of_each_place(camera: str) -> None:
    assert images_of_places(camera, 4).tolist() == PLACES[camera]


def test_only_pairs_of_images_need_an_even_number() -> None:
    for camera in ("all", "both"):
        assert len(images_of_places(camera, 5)) == 5
    for camera in ("left", "right", "joined"):
        with pytest.raises(InputError, match="5 images cannot be pairs of a left and a right one"):
            images_of_places(camera, 5)
    with pytest.raises(InputError, match='unknown camera "front"; known: all, left, right, both, joined'):
        images_of_places("front", 4)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_mask_of_images_becomes_one_of_places(camera: str) -> None:
    mask = np.zeros((4, 4), bool)
    mask[3, 0] = True  # the second place's right image shows what the first one's left image does
    found = mask_of_places(camera, mask, 4, Path("mask.png"))
    places = images_of_places(camera, 4)
    expected = [[any(mask[a, b] for a in first for b in second) for second in places] for first in places]
    assert found.tolist() == expected
    assert found.any() == (camera not in ("left", "right"))


def test_a_mask_of_places_fits_where_places_are_pairs_of_images() -> None:
    mask = np.array([[False, False], [True, False]])
    for camera in ("left", "right", "joined"):
        assert mask_of_places(camera, mask, 4, Path("mask.png")) is mask
    for camera in ("all", "both"):
        with pytest.raises(InputError, match=r"mask\.png: is 2 x 2, but there are 4 images$"):
            mask_of_places(camera, mask, 4, Path("mask.png"))
    with pytest.raises(InputError, match="is 8 x 8, but there are 4 images; does the folder have only one camera's"):
        mask_of_places("left", np.zeros((8, 8), bool), 4, Path("mask.png"))


def test_only_of_both_cameras_some_pairs_are_not_compared() -> None:
    both = comparable("both", images_of_places("both", 4))
    assert both.tolist() == [[(i + j) % 2 == 0 for j in range(4)] for i in range(4)]
    for camera in ("all", "left", "right", "joined"):
        assert comparable(camera, images_of_places(camera, 4)).all()
