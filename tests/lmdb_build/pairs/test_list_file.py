"""Lists of pairs: as files, reported and drawn."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from lmdb_build.pairs.build import Split, report
from lmdb_build.pairs.by_list import PlaceSource
from lmdb_build.pairs.choose import choose_pairs
from lmdb_build.pairs.list_file import (
    contact_sheet,
    read_pair_list,
    read_settings,
    write_contact_sheet,
    write_pair_list,
)
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


def test_the_report_counts_each_kind_and_every_pair() -> None:
    source = ring()
    chosen = choose_pairs(source, np.arange(60), 40, np.random.default_rng(0), "train")
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
