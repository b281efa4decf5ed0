"""Lists of pairs: as files, with hard negatives, joined, reported and drawn."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from lmdb_build.pairs.build import Plan, Split, build_lists, report
from lmdb_build.pairs.by_list import PlaceSource
from lmdb_build.pairs.choose import NEGATIVE, Wanted, choose_pairs, hard_negatives
from lmdb_build.pairs.list_file import (
    contact_sheet,
    join_lists,
    read_pair_list,
    read_settings,
    root_of,
    write_contact_sheet,
    write_pair_list,
)
from loopclosure.descriptors.feature_file import Features
from loopclosure.errors import InputError


def picture(seed: int, height: int = 60, width: int = 80) -> np.ndarray:
    """Smooth random blobs."""
    coarse = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for number in range(8):
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), picture(number))
    return tmp_path


def ring(count: int = 30) -> PlaceSource:
    """Places 0 to count - 1, each photographed twice."""
    places = [str(number) for number in range(count)]
    positives = [(number, number + count) for number in range(count)]
    return PlaceSource([(f"{side}/{place}.png", place) for side in "ab" for place in places], positives, {})


class TestFile:
    def test_written_lists_can_be_read(self, tmp_path: Path) -> None:
        path = tmp_path / "deep" / "list.txt"
        write_pair_list(path, [("a/1.png", "b.png", 1), ("c.png", "d.png", 0)], {"seed": "3", "rule": "2 m: 15 deg"})
        assert [(pair.first, pair.second, pair.label) for pair in read_pair_list(path)] == [
            ("a/1.png", "b.png", 1),
            ("c.png", "d.png", 0),
        ]
        assert read_pair_list(path)[0].line == 4
        assert read_settings(path)["rule"] == "2 m: 15 deg"

    @pytest.mark.parametrize(
        ("contents", "said"),
        [
            (b"# head\na.png b.png\n", ":2:1: found 'a.png b.png', expected two images and a label"),
            (b"# head\na.png b.png 2\n", ":2:13: "),
            (b"# head\na.png b c.png 1\n", ":2:1: "),
            (b"# nothing\n", ": lists no pair"),
            (b"\x89PNG\r\n\x1a\n\0\0", ": is not a text file"),
            (None, ": cannot be read: No such file"),
        ],
    )
    def test_an_invalid_list_is_reported_with_its_line(self, tmp_path: Path, contents: bytes | None, said: str) -> None:
        path = tmp_path / "list.txt"
        if contents is not None:
            path.write_bytes(contents)
        with pytest.raises(InputError) as caught:
            read_pair_list(path)
        assert str(caught.value).startswith(f"{path}{said}")

    def test_a_name_with_spaces_is_quoted(self, tmp_path: Path) -> None:
        path = tmp_path / "list.txt"
        write_pair_list(path, [("my photo.png", "#b.png", 1)], {})
        (pair,) = read_pair_list(path)
        assert (pair.first, pair.second) == ("my photo.png", "#b.png")

    def test_a_name_can_be_any_bytes(self, tmp_path: Path) -> None:
        path = tmp_path / "list.txt"
        write_pair_list(path, [(os.fsdecode(b"caf\xe9.png"), "b.png", 1)], {})
        assert b"caf\xe9.png b.png 1\n" in path.read_bytes()
        assert os.fsencode(read_pair_list(path)[0].first) == b"caf\xe9.png"

    def test_a_name_that_a_list_cannot_contain_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="cannot list the image"):
            write_pair_list(tmp_path / "list.txt", [('my "photo".png', "b.png", 1)], {})


class TestHardNegatives:
    def test_hard_negatives_are_the_nearest_negatives(self) -> None:
        source = ring()
        # On a line: places 2k and 2k + 1 lie close together, both photographs of a place closer still.
        line = np.array([2.0 * place - 0.8 * (place % 2) for place in range(30)])
        features = np.concatenate([line, line + 0.01])[:, None]
        found = hard_negatives(source, np.arange(60), features, 15)
        places = np.sort(found % 30, axis=1)
        assert len(found) == 15
        assert (source.judge(found[:, 0], found[:, 1]) == NEGATIVE).all()
        assert (places[:, 1] - places[:, 0] == 1).all()
        assert (places[:, 0] % 2 == 0).all()

    def test_hard_negatives_are_spread_over_the_images(self) -> None:
        source = ring()
        rng = np.random.default_rng(0)
        features = rng.normal(size=(60, 4))
        features[:6] *= 1e-3  # six images that a net cannot tell apart
        found = hard_negatives(source, np.arange(60), features, 40)
        assert len(np.unique(found)) > 40

    def test_images_of_one_place_have_no_hard_negatives(self) -> None:
        source = PlaceSource([("a.png", "x"), ("b.png", "x")], [(0, 1)], {})
        assert len(hard_negatives(source, np.arange(2), np.eye(2), 5)) == 0

    def test_the_share_of_hard_negatives_in_a_list(self, tmp_path: Path) -> None:
        source = ring()
        line = np.concatenate([np.arange(30.0), np.arange(30.0)])
        features = Features(tmp_path / "f.npz", line[:, None].astype(np.float32), list(source.names))
        for share, near in ((0.0, 5), (1.0, 20)):
            plan = Plan({"train": 40}, by="group", features=features, hard_share=share)
            path = build_lists(source, plan, tmp_path, tmp_path / str(share))["train"].path
            gaps = [
                abs(int(Path(pair.first).stem) - int(Path(pair.second).stem))
                for pair in read_pair_list(path)
                if not pair.label
            ]
            assert (sum(gap == 1 for gap in gaps) >= near) if share else (sum(gap == 1 for gap in gaps) < near)

    def test_images_without_features_are_an_error(self, tmp_path: Path) -> None:
        source = ring()
        features = Features(tmp_path / "f.npz", np.zeros((1, 2), np.float32), ["a/0.png"])
        with pytest.raises(InputError, match="has no descriptor of"):
            build_lists(source, Plan({"train": 4}, by="group", features=features), tmp_path, tmp_path)


class TestJoin:
    def test_joined_lists_keep_every_pair_below_the_common_root(self, tmp_path: Path) -> None:
        write_pair_list(tmp_path / "x/lists/a.txt", [("1.png", "2.png", 1)] * 3, {"root folder": ".."})
        write_pair_list(tmp_path / "y/b.txt", [("3.png", "4.png", 0)] * 3, {"root folder": "."})
        number, root = join_lists([tmp_path / "x/lists/a.txt", tmp_path / "y/b.txt"], tmp_path / "z/all.txt", seed=1)
        assert (number, root) == (6, tmp_path.resolve())
        joined = read_pair_list(tmp_path / "z/all.txt")
        assert sorted((pair.first, pair.second, pair.label) for pair in joined) == [
            *[("x/1.png", "x/2.png", 1)] * 3,
            *[("y/3.png", "y/4.png", 0)] * 3,
        ]
        assert root_of(tmp_path / "z/all.txt").resolve() == tmp_path.resolve()

    def test_a_root_that_is_not_above_all_is_refused(self, tmp_path: Path) -> None:
        write_pair_list(tmp_path / "x/a.txt", [("1.png", "2.png", 1)], {})
        with pytest.raises(InputError, match="not below the root folder"):
            join_lists([tmp_path / "x/a.txt"], tmp_path / "all.txt", 1, root=tmp_path / "y")


def test_the_report_counts_each_kind_and_every_pair() -> None:
    source = ring()
    chosen = choose_pairs(source, np.arange(60), Wanted(40), np.random.default_rng(0), "train")
    lines = report(source, Split("train", np.arange(60), chosen)).splitlines()
    assert lines[0].startswith("train: 40 pairs of 60 images, ")
    counts = {line[:46].strip(): int(line[46:]) for line in lines[1:]}
    assert sum(counts.values()) == 40
    assert counts["positive, same place"] == 20


class TestContactSheet:
    @pytest.fixture
    def listed(self, photos: Path) -> Path:
        write_pair_list(
            photos / "list.txt",
            [
                ("photos/0.png", "photos/1.png", 1),
                ("photos/2.png", "photos/3.png", 0),
                ("photos/4.png", "photos/5.png", 0),
            ],
            {},
        )
        return photos / "list.txt"

    def test_positives_are_framed_green_on_the_left_and_negatives_red_on_the_right(self, listed: Path) -> None:
        sheet = contact_sheet(listed, listed.parent, rows=2)
        height, width = sheet.shape[:2]
        green = (sheet == (60, 150, 40)).all(axis=2)
        red = (sheet == (50, 50, 200)).all(axis=2)
        assert green[:, : width // 2].sum() > 1000
        assert red[:, width // 2 :].sum() > 1000
        assert not green[:, width // 2 :].any()
        assert not red[:, : width // 2].any()
        assert red[height // 2 :].sum() > 1000  # two negatives
        assert not green[height * 2 // 3 :].any()  # but one positive

    def test_the_sheet_has_the_images_of_pairs(self, listed: Path) -> None:
        sheet = contact_sheet(listed, listed.parent, rows=1)
        shown = cv2.resize(sheet[50:230, 6:246], (80, 60), interpolation=cv2.INTER_AREA)
        assert np.abs(shown.astype(int) - picture(0)).mean() < 4

    def test_a_missing_image_is_reported_with_its_line(self, listed: Path) -> None:
        (listed.parent / "photos/1.png").unlink()
        with pytest.raises(InputError, match=r"list\.txt:2:1: .*photos/1\.png cannot be read: No such file"):
            contact_sheet(listed, listed.parent)

    def test_the_format_follows_from_the_file_name(self, listed: Path) -> None:
        write_contact_sheet(listed, listed.parent, listed.parent / "deep/sheet.png")
        assert cv2.imread(str(listed.parent / "deep/sheet.png")) is not None
        with pytest.raises(InputError, match="cannot be written as a picture"):
            write_contact_sheet(listed, listed.parent, listed.parent / "sheet.nothing")
