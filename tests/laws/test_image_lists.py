"""list_images, which reads folders and lists of images as docs/images.md says."""

from pathlib import Path

import pytest

from netspec.files.image_list import IMAGE_ENDINGS, SUBFOLDERS, list_images
from paths import ROOT

# Files with their texts, the source that is read, and the names and stamps expected of it.
FOUND: dict[str, tuple[dict[str, str], str, list[str], list[float] | None]] = {
    "numbers are compared as numbers": (
        {"10.png": "", "9.jpg": "", "1.png": "", "x2y10.png": "", "x2y9.png": ""},
        ".",
        ["1.png", "9.jpg", "10.png", "x2y9.png", "x2y10.png"],
        None,
    ),
    "letters are compared without regard to case": (
        {"B2.png": "", "a2.png": "", "a10.png": "", "b1.PNG": "", "A3.png": ""},
        ".",
        ["a2.png", "A3.png", "a10.png", "b1.PNG", "B2.png"],
        None,
    ),
    "the rest is order of characters": ({"a.png": "", "A.png": "", "01.png": "", "1.png": ""}, ".",
        ["01.png", "1.png", "A.png", "a.png"], None),
    "numerals that are not decimal": ({"a².png": "", "a1.png": "", "a٣.png": "", "a2.png": ""}, ".",
        ["a1.png", "a2.png", "a٣.png", "a².png"], None),
    "endings in any case, hidden files left out": (
        {"1.TIFF": "", "2.jpeg": "", "3.webp": "", ".4.png": "", "notes.txt": "", "5": ""}, ".",
        ["1.TIFF", "2.jpeg", "3.webp"], None),
    "names with blanks and #": ({"a#1.png": "", "a 2.png": "", "#3.png": ""}, ".",
        ["#3.png", "a 2.png", "a#1.png"], None),
    "rgb below the folder": ({"rgb/2.png": "", "rgb/10.png": "", "depth/1.png": ""}, ".",
        ["rgb/2.png", "rgb/10.png"], None),
    "images below the folder": ({"images/2.png": "", "Images/1.png": ""}, ".", ["images/2.png"], None),
    "Images below the folder": ({"Images/1.png": ""}, ".", ["Images/1.png"], None),
    "the folder's own before those below": ({"1.png": "", "rgb/2.png": ""}, ".", ["1.png"], None),
    "rgb.txt, in the order of time": (
        {"rgb.txt": "# color images\n# file: 'x'\n2.5 rgb/1.png\n1.25 rgb/2.png\n", "rgb/1.png": "", "rgb/2.png": "",
         "rgb/3.png": ""}, ".",
        ["rgb/2.png", "rgb/1.png"], [1.25, 2.5]),
    "rgb.txt without stamps": ({"rgb.txt": "b.png\na.png\n", "a.png": "", "b.png": ""}, ".", ["b.png", "a.png"], None),
    "a list in its own order": (
        {"l.txt": "sub/b.png\na.png\nsub/b.png\n", "a.png": "", "sub/b.png": ""}, "l.txt",
        ["sub/b.png", "a.png", "sub/b.png"], None),
    "a list with a byte-order mark, Windows' line ends and empty lines": (
        {"l.txt": "\ufeffa.png\r\n\r\n   \r\nb.png\r\n", "a.png": "", "b.png": ""}, "l.txt", ["a.png", "b.png"], None),
    "stamps": ({"l.txt": "2.5 a.png\n1 b.png\n.5\tc.png\n1e-3 d.png", "a.png": "", "b.png": "", "c.png": "",
        "d.png": ""}, "l.txt", ["a.png", "b.png", "c.png", "d.png"], [2.5, 1, 0.5, 0.001]),
    "stamps of some only": ({"l.txt": "2.5 a.png\nb.png\n", "a.png": "", "b.png": ""}, "l.txt",
        ["a.png", "b.png"], None),
    "labels": ({"l.txt": "a.png 1\nb.png\t-1\n c.png   +7 \n", "a.png": "", "b.png": "", "c.png": ""}, "l.txt",
        ["a.png", "b.png", "c.png"], None),
    "stamp and label": ({"l.txt": "7.5 a.png 1\n8.5 b c.png 0", "a.png": "", "b c.png": ""}, "l.txt",
        ["a.png", "b c.png"], [7.5, 8.5]),
    "stamps with commas, below the names of the columns": (
        {"l.txt": 'timestamp,filename\n1.5,a.png\n2.5, "b,c.png"\n3,4.png\n', "a.png": "", "b,c.png": "", "4.png": ""},
        "l.txt", ["a.png", "b,c.png", "4.png"], [1.5, 2.5, 3]),
    "columns in another order, with a unit": (
        {"l.csv": "exposure;path_rgb_0;ts_rgb_0 (ns)\n9;rgb/a.png;1500000000\n", "rgb/a.png": ""},
        "l.csv", ["rgb/a.png"], [1.5]),
    "columns of names and times, with quotes": (
        {"l.csv": 'image,timestamp\n"a.png",1.5\n', "a.png": ""}, "l.csv", ["a.png"], [1.5]),
    "comments": (
        {"l.txt": "# chosen\n  # and\n#a.png\na.png # twice\n1 a.png 0  # again\n", "a.png": "", "#a.png": ""}, "l.txt",
        ["a.png", "a.png"], None),
    "names that look like something else": (
        {"l.txt": "a#1.png\na #1.png\na #1.png # note\n1 2.png\nb 3\nx y.png\n7\n",
         "a#1.png": "", "a #1.png": "", "1 2.png": "", "b 3": "", "x y.png": "", "7": ""}, "l.txt",
        ["a#1.png", "a #1.png", "a #1.png", "1 2.png", "b 3", "x y.png", "7"], None),
    "quotation marks are characters": ({"l.txt": '"a.png"\n', '"a.png"': ""}, "l.txt", ['"a.png"'], None),
    "a list elsewhere": ({"lists/l.txt": "../a.png\n./b.png\n", "a.png": "", "lists/b.png": ""}, "lists/l.txt",
        ["../a.png", "./b.png"], None),
}  # fmt: skip
REFUSED: dict[str, tuple[dict[str, str], str, str]] = {
    "a folder without images": ({"notes.txt": ""}, "here", "here: contains no images; expected files that end in "),
    "an empty list": ({"l.txt": "# nothing\n\n"}, "l.txt", "l.txt: lists no images"),
    "an empty rgb.txt": ({"here/rgb.txt": "", "here/a.png": ""}, "here", "here/rgb.txt: lists no images"),
    "a missing image": (
        {"l.txt": "a.png\n  gone.png\n", "a.png": ""}, "l.txt", 'l.txt:2:3: no such image "gone.png" in .'),
    "a missing image with all else": (
        {"l.txt": "1.5 gone.png 1 # no\n"}, "l.txt", 'l.txt:1:5: no such image "gone.png" in .'),
    "a stamp without end": (
        {"l.txt": "1.5 a.png\n  1e999 a.png\n", "a.png": ""}, "l.txt",
        'l.txt:2:3: the time stamp "1e999" is not finite; expected seconds'),
    "quotation marks that nobody wants": (
        {"l.txt": '"a.png"\n', "a.png": ""}, "l.txt", 'l.txt:1:1: no such image ""a.png"" in .'),
    "a folder in a list": ({"l.txt": "sub\n", "sub/a.png": ""}, "l.txt", 'l.txt:1:1: no such image "sub" in .'),
    "a line that no file can be called": (
        {"l.txt": "x" * 300 + "\n"}, "l.txt", f'l.txt:1:1: no such image "{"x" * 300}" in .'),
    "a missing image of rgb.txt": (
        {"here/rgb.txt": "1 rgb/1.png\n"}, "here", 'here/rgb.txt:1:3: no such image "rgb/1.png" in here'),
    "nothing": ({}, "gone", "gone: cannot be read: No such file or directory; expected a folder of images, or a text"),
    "a single image": ({"a.PNG": ""}, "a.PNG", "a.PNG: is a single image; expected a folder of images, or a text"),
    "something else": ({"a.avi": "\udcff\udcfe"}, "a.avi", "a.avi: is not a text file; expected a folder of images"),
}  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(files: dict[str, str]) -> None:
    for name, text in files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(text.encode(errors="surrogateescape"))


@pytest.mark.parametrize("case", FOUND)
def test_list_images_returns_names_stamps_and_paths(here: Path, case: str) -> None:
    files, source, names, stamps = FOUND[case]
    write(files)
    for given in (source, Path(source), here / source):
        found = list_images(given)
        assert list(found.names) == names
        assert (None if found.stamps is None else found.stamps.tolist()) == stamps
        root = here / source if (here / source).is_dir() else (here / source).parent
        assert [path.resolve() for path in found.paths] == [(root / name).resolve() for name in names]


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.usefixtures("here")
def test_invalid_sources_are_refused(case: str) -> None:
    files, source, message = REFUSED[case]
    write(files)
    with pytest.raises(ValueError, match=r"\A[^\n]+\Z") as fault:
        list_images(source)
    assert str(fault.value).startswith(message)


def test_docs_images_md_lists_endings_and_subfolders() -> None:
    text = (ROOT / "docs" / "images.md").read_text()
    assert all(f"`{word}`" in text for word in (*IMAGE_ENDINGS, *SUBFOLDERS))
