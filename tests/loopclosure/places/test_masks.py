"""Masks and coordinates in every format, and errors for broken ones."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
import scipy.sparse

from loopclosure.errors import InputError
from loopclosure.places.masks import (
    CAMERAS,
    comparable,
    images_of_places,
    mask_of_places,
    read_coordinates,
    read_place_pairs,
    read_truth_matrix,
)

MASK = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0]], np.uint8)


def write(path, matrix):
    if path.suffix == ".mat":
        scipy.io.savemat(path, {"something": np.eye(2), "GT": matrix})
    elif path.suffix == ".npy":
        np.save(path, matrix)
    elif path.suffix == ".txt":
        np.savetxt(path, matrix, fmt="%d")
    elif path.suffix == ".csv":
        np.savetxt(path, matrix, fmt="%d", delimiter=",", header="a mask")
    else:
        cv2.imwrite(str(path), matrix * 255)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mat", ".npy", ".txt", ".csv", ".bmp", ".png"])
def test_every_form(tmp_path, suffix):
    hard, soft = read_truth_matrix(write(tmp_path / f"mask{suffix}", MASK))
    np.testing.assert_array_equal(hard, MASK == 1)
    np.testing.assert_array_equal(soft, hard)


@pytest.mark.slow
def test_sparse_and_bool_masks(tmp_path):
    scipy.io.savemat(tmp_path / "sparse.mat", {"truth": scipy.sparse.csc_matrix(MASK.astype(float))})
    np.testing.assert_array_equal(read_truth_matrix(tmp_path / "sparse.mat")[0], MASK == 1)
    np.save(tmp_path / "bool.npy", MASK == 1)
    np.testing.assert_array_equal(read_truth_matrix(tmp_path / "bool.npy")[0], MASK == 1)


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        pytest.param("x.txt", "0 0\n1\n", 2, id="short row"),
        pytest.param("x.txt", "0 0\n0 one\n", 2, id="no number"),
        pytest.param("x.txt", "# nothing\n", 0, id="empty"),
        pytest.param("x.txt", "0 7\n0 0\n", 0, id="seven"),
        pytest.param("x.txt", "0 -1\n1 0\n", 0, id="negative"),
        pytest.param("x.txt", "0 0\n0 0\n", 0, id="no loop"),
        pytest.param("x.jpg", "", 0, id="jpeg"),
        pytest.param("x.npy", "no array", 0, id="npy"),
        pytest.param("x.mat", "no matlab", 0, id="mat"),
        pytest.param("x.mat", "", 0, id="empty mat"),
        pytest.param("x.png", "no image", 0, id="png"),
    ],
)
def test_invalid_masks_are_refused(tmp_path: Path, name: str, content: str, line: int) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as caught:
        read_truth_matrix(tmp_path / name)
    assert caught.value.where is not None
    assert (caught.value.where.file, caught.value.where.line) == (str(tmp_path / name), line)


@pytest.mark.slow
def test_mat_without_the_variable_lists_what_it_has(tmp_path):
    scipy.io.savemat(tmp_path / "x.mat", {"alpha": np.eye(2), "beta": np.eye(3)})
    with pytest.raises(InputError, match=r'no variable "truth".*alpha, beta'):
        read_truth_matrix(tmp_path / "x.mat")
    with pytest.raises(InputError, match="no such file"):
        read_truth_matrix(tmp_path / "absent.mat")


@pytest.mark.slow
def test_coordinates(tmp_path):
    expected = [[1.5, 2.0], [3.0, -4.0]]
    scipy.io.savemat(tmp_path / "a.mat", {"GPS": np.array(expected)})
    (tmp_path / "b.txt").write_text("0001.jpg 1.5 2\n0002.jpg 3 -4\n")
    (tmp_path / "c.txt").write_text("1.5, 2\n3, -4\n")
    for name in ("a.mat", "b.txt", "c.txt"):
        np.testing.assert_allclose(read_coordinates(tmp_path / name), expected)
    np.save(tmp_path / "d.npy", np.zeros((2, 5)))
    with pytest.raises(InputError, match="expected x and y"):
        read_coordinates(tmp_path / "d.npy")


@pytest.mark.parametrize("text", ["place,query,ref\n", "place_id,query,ref\n"])
def test_place_pairs_need_their_columns_and_a_row(text: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(InputError, match=r"pairs.csv:1:1: is not a table of places"):
        read_place_pairs(tmp_path / "pairs.csv")


PLACES = {"all": [0, 1, 2, 3], "left": [0, 2], "right": [1, 3], "both": [0, 1, 2, 3]}


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_images_of_each_place(camera: str) -> None:
    assert images_of_places(camera, 4).tolist() == PLACES[camera]


def test_only_pairs_of_images_need_an_even_number() -> None:
    for camera in ("all", "both"):
        assert len(images_of_places(camera, 5)) == 5
    for camera in ("left", "right"):
        with pytest.raises(InputError, match="5 images cannot be pairs of a left and a right one"):
            images_of_places(camera, 5)
    with pytest.raises(InputError, match='unknown camera "front"'):
        images_of_places("front", 4)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_mask_of_images_becomes_one_of_places(camera: str) -> None:
    mask = np.zeros((4, 4), bool)
    mask[3, 0] = mask[2, 0] = True
    places = images_of_places(camera, 4)
    assert mask_of_places(camera, mask, 4, Path("mask.png")).tolist() == mask[np.ix_(places, places)].tolist()


def test_a_mask_of_places_fits_where_places_are_pairs_of_images() -> None:
    mask = np.array([[False, False], [True, False]])
    for camera in ("left", "right"):
        assert mask_of_places(camera, mask, 4, Path("mask.png")) is mask
    for camera in ("all", "both"):
        with pytest.raises(InputError, match=r"mask\.png: is 2 x 2, but there are 4 images$"):
            mask_of_places(camera, mask, 4, Path("mask.png"))
    with pytest.raises(InputError, match="is 8 x 8, but there are 4 images; does the folder have only one camera's"):
        mask_of_places("left", np.zeros((8, 8), bool), 4, Path("mask.png"))


def test_for_both_cameras_only_images_of_the_same_camera_are_compared() -> None:
    both = comparable("both", images_of_places("both", 4))
    assert both.tolist() == [[(i + j) % 2 == 0 for j in range(4)] for i in range(4)]
    for camera in ("all", "left", "right"):
        assert comparable(camera, images_of_places(camera, 4)).all()
