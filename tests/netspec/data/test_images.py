from __future__ import annotations

from pathlib import Path

import pytest

from netspec.data.images import list_lines, read_image, read_image_list
from netspec.errors import SpecError, Where


def test_missing_and_damaged_images_are_distinguished(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r'image ".*nix.png" cannot be read: No such file'):
        read_image(str(tmp_path / "nix.png"))
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(ValueError, match=r'image ".*text.png" cannot be decoded as an image'):
        read_image(str(tmp_path / "text.png"))


def test_list_lines_are_split_at_the_last_space(tmp_path: Path) -> None:
    (tmp_path / "l").write_text("#what.png 9\n\na b.png 3\n  c.png -1  \r\nd.png\t7\n")
    images = read_image_list(str(tmp_path / "l"))
    assert [(image.name, image.label, image.where.line) for image in images] == [
        ("#what.png", 9, 1),
        ("a b.png", 3, 3),
        ("c.png", -1, 4),
        ("d.png", 7, 5),
    ]


@pytest.mark.parametrize(
    "line", ["a.png", "a.png x", "a.png 1.5", "3", "a.png 3.0", "a.png 0x10", "a.png nan", "a.png 1_000", "a.png ٣"]
)
def test_a_line_without_a_label_is_reported(tmp_path: Path, line: str) -> None:
    (tmp_path / "l").write_text(f"ok.png 1\n{line}\n")
    with pytest.raises(SpecError, match=f'l:2:1: found "{line}", expected an image name'):
        read_image_list(str(tmp_path / "l"))


@pytest.mark.parametrize("label", ["2147483648", "-2147483649", "4294967296", "9" * 5000])
def test_a_label_beyond_32_bits_is_refused(tmp_path: Path, label: str) -> None:
    (tmp_path / "l").write_text(f"ok.png 2147483647\nb.png -2147483648\na.png {label}\n")
    with pytest.raises(SpecError, match=f"l:3:1: found label {label}, expected one of 32 bits, -2147483648 to"):
        read_image_list(str(tmp_path / "l"))


def test_a_list_without_lines_or_without_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "l").write_text("\n")
    with pytest.raises(SpecError, match="is empty"):
        read_image_list(str(tmp_path / "l"))
    with pytest.raises(SpecError, match=r'^n:4:2: list file ".*nix" cannot be read: No such file'):
        list(list_lines(str(tmp_path / "nix"), Where("n", 4, 2)))
    (tmp_path / "l").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SpecError, match="is not UTF-8 text"):
        list(list_lines(str(tmp_path / "l")))
