"""Data sets with their truth, on synthetic files; on the real ones where they are available."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.datasets import (
    load_fabmap,
    load_folder,
    load_place_pairs,
    load_sequence,
    load_traverses,
)
from loopclosure.places.frames import Selection
from loopclosure.places.sequences import read_sequence
from loopclosure.places.truth import Exclusion
from paths import shared


def write_images(folder: Path, names, width=8, height=6):
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), np.full((height, width, 3), number, np.uint8))
    return folder


@pytest.fixture
def tum_folder(tmp_path):
    """A camera that turns by 10 degrees each second for 72 s: two rounds on the spot."""
    folder = write_images(tmp_path / "turn" / "rgb", [f"{i}.png" for i in range(72)]).parent
    lines = [f"{i}.0 rgb/{i}.png" for i in range(72)] + ["100.0 rgb/0.png"]  # the last one has no pose
    (folder / "rgb.txt").write_text("# synthetic\n" + "\n".join(lines) + "\n")
    poses = []
    for i in range(72):
        x, y, z, w = Rotation.from_euler("y", 10 * i, degrees=True).as_quat()
        poses.append(f"{i}.01 0 0 0 {x} {y} {z} {w}")
    (folder / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    return folder


def test_tum_truth_is_the_papers_rule(tum_folder):
    data = load_sequence(read_sequence(tum_folder, "tum"))
    assert len(data.queries.paths) == 72
    assert data.references is None
    loops = {(int(i), int(j)) for i, j in np.argwhere(data.truth.hard & data.truth.judged)}
    assert loops == {(i, j) for i in range(72) for j in range(72) if i - j in (35, 36, 37, 71)}
    assert data.truth.judged[10, 0]
    assert not data.truth.judged[9, 0]
    assert data.exclude_frames == 9
    assert "2 m" in data.truth.description
    assert "less than 10 s apart" in data.truth.description
    assert data.notes[0] == "frames without a pose, left out: 1"
    assert data.notes[1].startswith("71 of 180 pairs")


def test_tum_by_a_wider_angle_and_selection(tum_folder):
    data = load_sequence(read_sequence(tum_folder, "tum"), Selection(stride=2))
    assert len(data.queries.paths) == 36
    assert data.wide is not None
    only_wide = {(int(i), int(j)) for i, j in np.argwhere(data.wide.hard & ~data.truth.hard & data.truth.judged)}
    assert only_wide == {(i, j) for i in range(36) for j in range(i) if (i - j) % 18 in (1, 2, 16, 17) and i - j > 10}
    assert "every 2nd" in data.name
    assert load_sequence(read_sequence(tum_folder, "tum"), max_angle_deg=60).wide is None


def test_tum_without_a_revisit_is_refused(tum_folder):
    with pytest.raises(InputError, match="no judged pair shows the same place"):
        load_sequence(read_sequence(tum_folder, "tum"), Selection(stop="40%"))


@pytest.fixture
def fabmap_folder(tmp_path):
    """Twelve images, six places of a left and a right one; place 4 is place 0 again, seen by every camera."""
    folder = write_images(tmp_path / "College", [f"{i + 1:04}.jpg" for i in range(12)])
    truth = np.zeros((12, 12), np.uint8)
    truth[8:10, 0:2] = 1
    truth[10, 2] = 1  # place 5 is place 1 again, to the left camera alone
    scipy.io.savemat(folder / "CollegeGroundTruth.mat", {"truth": truth})
    (folder / "ImageCollectionCoordinates.txt").write_text(
        "".join(f"{i + 1:04}.jpg {i // 2}.0 {10 + i // 2}.5\n" for i in range(12))
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "frames", "loops"),
    [
        ("left", ["0001", "0003", "0005", "0007", "0009", "0011"], {(4, 0), (5, 1)}),
        ("right", ["0002", "0004", "0006", "0008", "0010", "0012"], {(4, 0)}),
        ("both", [f"{i:04}" for i in range(1, 13)], {(8, 0), (9, 1), (10, 2)}),
        ("all", [f"{i:04}" for i in range(1, 13)], {(8, 0), (8, 1), (9, 0), (9, 1), (10, 2)}),
    ],
)
def test_fabmap_cameras(fabmap_folder, camera, frames, loops):
    data = load_fabmap(fabmap_folder, camera=camera, exclusion=Exclusion(frames=1))
    assert [path.stem for path in data.queries.paths] == frames
    assert {(int(i), int(j)) for i, j in np.argwhere(data.truth.hard & data.truth.judged)} == loops
    assert data.positions is not None
    assert data.positions.shape == (len(frames), 3)
    np.testing.assert_allclose(data.positions[-1], [5.0, 15.5, np.nan])  # the set says no height
    if camera == "both":
        assert not data.truth.judged[9, 0]
        assert "left and a right image" in data.notes[0]


@pytest.mark.slow
def test_fabmap_stride_and_limit_count_places(fabmap_folder):
    data = load_fabmap(
        fabmap_folder, camera="left", selection=Selection(stride=4, limit=2), exclusion=Exclusion(frames=0)
    )
    assert [path.stem for path in data.queries.paths] == ["0001", "0009"]
    assert data.truth.positives == 1


@pytest.mark.slow
def test_fabmap_faults(fabmap_folder, tmp_path):
    with pytest.raises(InputError, match="unknown camera"):
        load_fabmap(fabmap_folder, camera="front")
    np.save(tmp_path / "big.npy", np.eye(24, k=-20, dtype=np.uint8))
    with pytest.raises(InputError, match="24 x 24, but there are 12 images; does the folder have only one camera's"):
        load_fabmap(fabmap_folder, truth_file=tmp_path / "big.npy")
    (fabmap_folder / "ImageCollectionCoordinates.txt").write_text("1 2\n3 4\n")
    with pytest.raises(InputError, match="has 2 rows, but there are 12 images"):
        load_fabmap(fabmap_folder, camera="left", exclusion=Exclusion(frames=1))
    (fabmap_folder / "CollegeGroundTruth.mat").unlink()
    with pytest.raises(InputError, match="the mask of loops; give the file"):
        load_fabmap(fabmap_folder)


def test_folder_with_a_mask_in_natural_order(tmp_path):
    folder = write_images(tmp_path / "walk", [f"{i + 1}.png" for i in range(12)])
    truth = np.zeros((12, 12), np.uint8)
    truth[11, 0], truth[10, 0] = 255, 128  # the gray one is soft
    cv2.imwrite(str(tmp_path / "truth.bmp"), truth)
    data = load_folder(folder, tmp_path / "truth.bmp", exclusion=Exclusion(frames=2))
    assert [path.stem for path in data.queries.paths] == [str(i + 1) for i in range(12)]
    assert np.argwhere(data.truth.hard).tolist() == [[11, 0]]
    assert np.argwhere(data.truth.soft).tolist() == [[10, 0], [11, 0]]
    assert "1 pairs that nearly show the same place are ignored" in data.truth.description


def test_folder_masks_on_either_side_of_the_diagonal(tmp_path):
    folder = write_images(tmp_path / "walk", [f"{i}.png" for i in range(6)])
    lower = np.zeros((6, 6))
    lower[5, 0] = 1
    for matrix, notes in ((lower, 0), (lower + lower.T, 0), (lower.T, 1)):
        np.savetxt(tmp_path / "truth.txt", matrix, fmt="%d")
        data = load_folder(folder, tmp_path / "truth.txt", exclusion=Exclusion(frames=1))
        assert np.argwhere(data.truth.hard).tolist() == [[5, 0]]
        assert len(data.notes) == notes


def test_folder_with_references(tmp_path):
    queries = write_images(tmp_path / "night", ["a.png", "b.png"])
    references = write_images(tmp_path / "day", ["a.png", "b.png", "c.png"])
    np.save(tmp_path / "truth.npy", np.array([[1, 0, 0], [0, 0, 1]], bool))
    data = load_traverses(queries, references, truth_file=tmp_path / "truth.npy")
    assert data.references is not None
    assert data.truth.judged.all()
    np.save(tmp_path / "turned.npy", np.ones((3, 2), bool))
    with pytest.raises(InputError, match="2 queries and 3 references; transpose it"):
        load_traverses(queries, references, truth_file=tmp_path / "turned.npy")


def test_exclusion_that_takes_every_loop_is_refused(tmp_path):
    folder = write_images(tmp_path / "walk", [f"{i}.png" for i in range(6)])
    np.save(tmp_path / "truth.npy", np.eye(6, k=-3))
    with pytest.raises(InputError, match=r"no judged pair shows the same place .*at most 3 frames apart excluded"):
        load_folder(folder, tmp_path / "truth.npy", exclusion=Exclusion(frames=3))


def test_traverses(tmp_path):
    night = write_images(tmp_path / "night", [f"{i}.png" for i in range(10)])
    day = write_images(tmp_path / "day", [f"{i}.png" for i in range(10)])
    data = load_traverses(night, day, tolerance=2, selection=Selection(stride=2))
    assert data.truth.hard.shape == (5, 5)
    np.testing.assert_array_equal(data.truth.hard, np.abs(np.subtract.outer(np.arange(5), np.arange(5))) <= 1)
    (day / "9.png").unlink()
    with pytest.raises(InputError, match=r"10 queries .* 9 references"):
        load_traverses(night, day)
    with pytest.raises(InputError, match="tolerance is -1"):
        load_traverses(night, night, tolerance=-1)


def test_place_pairs(tmp_path):
    write_images(tmp_path / "query", ["1.png", "2.png", "3.png"])
    write_images(tmp_path / "ref", ["1.png", "2.png", "3.png"])
    table = "place_id,query,ref,w\n7,query/1.png,ref/1.png,8\n8,query/2.png,ref/2.png,8\n7,query/3.png,ref/3.png,8\n"
    (tmp_path / "pairs.csv").write_text(table)
    data = load_place_pairs(tmp_path)
    np.testing.assert_array_equal(data.truth.hard, [[1, 0, 1], [0, 1, 0], [1, 0, 1]])
    (tmp_path / "ref" / "2.png").unlink()
    with pytest.raises(InputError, match=r"pairs.csv:3:1: no such image"):
        load_place_pairs(tmp_path)


@pytest.mark.slow
def test_new_college_mask():
    from loopclosure.places.masks import read_truth_matrix

    hard, soft = read_truth_matrix(shared("data/NewCollegeGroundTruth.mat"))
    assert hard.shape == (2146, 2146)
    assert int(hard.sum()) == 14832
    assert int(hard.any(axis=1).sum()) == 853
    assert np.array_equal(hard, soft)
    assert not np.triu(hard).any()
    rows, columns = np.nonzero(hard)
    assert int((rows - columns).min()) == 142
    assert int(hard[::2, ::2].sum()) == 3541
    assert int(hard[1::2, 1::2].sum()) == 3543
