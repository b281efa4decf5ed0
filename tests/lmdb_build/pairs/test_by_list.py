"""Pairs from lists: masks, folders, tables, single images."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lmdb_build.pairs.by_list import MaskSource, PlaceSource, folders_source
from lmdb_build.pairs.choose import (
    LEFT_OUT,
    NEGATIVE,
    POSITIVE,
    split_by_group,
    split_by_time,
)
from loopclosure.errors import InputError


def images(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.zeros((4, 6, 3), np.uint8))
    return folder


def label(source: MaskSource | PlaceSource, first: str, second: str) -> int:
    a, b = (np.array([source.names.index(name)]) for name in (first, second))
    assert source.judge(a, b) == source.judge(b, a)
    return int(source.judge(a, b)[0])


class TestMask:
    @pytest.fixture
    def run(self, tmp_path: Path) -> Path:
        """Twelve images, the last six a second lap; frame 6 looks like 0, and so on, 11 like 5 only a little."""
        images(tmp_path / "run", *(f"{number}.png" for number in range(1, 13)))
        mask = np.zeros((12, 12), np.uint8)
        for number in range(5):
            mask[number + 6, number] = 255
        mask[11, 5] = 128
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        return tmp_path

    def test_marked_pairs_are_positive_and_neighbors_left_out(self, run: Path) -> None:
        source = MaskSource(run / "mask.png", run / "run", run)
        assert source.names[:2] == ["run/1.png", "run/2.png"]  # natural order: row 1 is 2.png, not 10.png
        assert label(source, "run/1.png", "run/7.png") == POSITIVE
        assert label(source, "run/1.png", "run/8.png") == NEGATIVE
        assert label(source, "run/1.png", "run/6.png") == LEFT_OUT  # nearer than any marked pair
        assert label(source, "run/6.png", "run/12.png") == LEFT_OUT  # soft
        assert len(source.positives()) == 5

    def test_the_gap_can_be_given(self, run: Path) -> None:
        source = MaskSource(run / "mask.png", run / "run", run, min_gap=3)
        assert label(source, "run/1.png", "run/4.png") == NEGATIVE
        assert label(source, "run/1.png", "run/3.png") == LEFT_OUT

    def test_left_and_right_images_alternate(self, run: Path) -> None:
        left = MaskSource(run / "mask.png", run / "run", run, camera="left")
        assert left.names == [f"run/{number}.png" for number in (1, 3, 5, 7, 9, 11)]
        assert len(left.positives()) == 3
        both = MaskSource(run / "mask.png", run / "run", run, camera="both")
        assert label(both, "run/1.png", "run/8.png") == LEFT_OUT
        assert label(both, "run/1.png", "run/7.png") == POSITIVE
        right = MaskSource(run / "mask.png", run / "run", run, camera="right")
        assert right.names[:2] == ["run/2.png", "run/4.png"]

    def test_pairs_that_are_not_compared_set_no_gap(self, run: Path) -> None:
        mask = cv2.imread(str(run / "mask.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        mask[1, 0] = 255  # the left and the right image of one place
        cv2.imwrite(str(run / "mask.png"), mask)
        source = MaskSource(run / "mask.png", run / "run", run, camera="both")
        assert label(source, "run/1.png", "run/2.png") == LEFT_OUT
        assert label(source, "run/1.png", "run/3.png") == LEFT_OUT  # nearer than any marked pair of one camera
        assert len(source.positives()) == 5


class TestFolders:
    @pytest.fixture
    def source(self, tmp_path: Path) -> PlaceSource:
        images(tmp_path, *(f"day/{number}.png" for number in (1, 2, 3, 10, 11)))
        images(tmp_path, *(f"night/{number}.jpg" for number in (1, 2, 3, 10, 99)))
        return folders_source(tmp_path / "day", tmp_path / "night", tmp_path)

    def test_equal_names_with_any_extension_are_the_same_place(self, source: PlaceSource) -> None:
        assert len(source.names) == 8
        assert label(source, "day/2.png", "night/2.jpg") == POSITIVE
        assert label(source, "day/2.png", "night/3.jpg") == NEGATIVE
        assert "2 unpaired" in source.settings["source"]

    def test_pairs_join_the_two_folders_only(self, source: PlaceSource) -> None:
        assert label(source, "day/2.png", "day/3.png") == LEFT_OUT

    def test_neighboring_places_can_be_omitted(self, source: PlaceSource, tmp_path: Path) -> None:
        apart = folders_source(tmp_path / "day", tmp_path / "night", tmp_path, min_gap=2)
        assert label(apart, "day/3.png", "night/10.jpg") == LEFT_OUT
        assert label(apart, "day/1.png", "night/3.jpg") == NEGATIVE
        assert label(apart, "day/1.png", "night/1.jpg") == POSITIVE

    def test_a_split_keeps_the_two_images_of_a_place_together(self, source: PlaceSource) -> None:
        shares = {"train": 0.5, "val": 0.5}
        for splits in (split_by_group(source, shares, 1), split_by_time(source, shares)):
            assert sum(len(part) for part in splits.values()) == 8
            for part in splits.values():
                stems = [Path(source.names[index]).stem for index in part]
                assert len(stems) == 4
                assert all(stems.count(stem) == 2 for stem in stems)

    def test_folders_without_equal_names_are_refused(self, tmp_path: Path) -> None:
        images(tmp_path, "a/1.png", "b/2.png")
        with pytest.raises(InputError, match="have no image of equal name"):
            folders_source(tmp_path / "a", tmp_path / "b", tmp_path)


def test_images_outside_the_root_are_refused(tmp_path: Path) -> None:
    images(tmp_path, "day/1.png", "night/1.png")
    with pytest.raises(InputError, match="is not below the root folder"):
        folders_source(tmp_path / "day", tmp_path / "night", tmp_path / "elsewhere")
