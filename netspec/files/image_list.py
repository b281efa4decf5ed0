"""Finds the images of a folder or a list, with their order and time stamps, as described in docs/images.md."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from netspec.errors import SpecError, Where
from netspec.files.table import TIME, UNITS, Table, is_number, read_table

IMAGE_ENDINGS = (
    *(".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"),
    *(".jpe", ".jfif", ".jp2", ".pnm", ".avif"),
)
OTHER_PHOTOS = (".heic", ".heif", ".gif", ".dng", ".raw", ".cr2", ".nef", ".arw")  # that OpenCV does not read
SUBFOLDERS = ("rgb", "images", "Images", "data")
_DEPTH = re.compile(r"(?<![a-z])depth(?![a-z])", re.IGNORECASE)  # in the name of a depth image beside a color image
_EXPECTED = "a folder of images, or a text file that lists them"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_LINE = re.compile(rf"(?:(?P<stamp>{_NUMBER})(?:\s+|\s*,\s*))?(?P<name>.+?)(?:\s+[+-]?\d+)?")
# The names of a column of images, the likelier ones first.
_NAMES = (r".*(?:file|path).*", r"(?:image|img|rgb|name).*")
_COMMENT = re.compile(r"\s+#")


@dataclass(frozen=True)
class ImageList:
    """Image files in order: ``paths``, ``names``, and ``stamps`` (N,) in seconds if all images have one.

    ``ImageSequence`` in ``loopclosure.places`` adds poses, a camera and videos. ``doubts`` are sentences about what was
    not read, and about what looks wrong.
    """

    paths: tuple[Path, ...]
    names: tuple[str, ...]
    stamps: np.ndarray | None = None
    doubts: tuple[str, ...] = field(default=(), kw_only=True)

    def __len__(self) -> int:
        return len(self.names)


def list_images(source: str | Path) -> ImageList:
    """Return the images of a folder or of a list. Raises SpecError if it has no images."""
    source = Path(source)
    if not source.is_dir():
        return _read_list(source)
    if (source / "rgb.txt").is_file():
        return _in_time(_read_list(source / "rgb.txt"))
    left_out: list[str] = []
    for folder in (source, *(source / name for name in SUBFOLDERS)):
        images, more = _images_in(folder)
        left_out += more
        if images:
            names = tuple(path.relative_to(source).as_posix() for path in images)
            return ImageList(tuple(images), names, doubts=tuple(left_out))
    below = [path for name in ("*", "*/*") for path in sorted(source.glob(name))]
    inner = [path for path in below if _images_in(path)[0]]
    there = f"; {', '.join(path.as_posix() for path in inner[:3])} has some: name one folder" if inner else ""
    said = "".join(f"; {sentence}" for sentence in left_out)
    expected = f"expected files that end in {', '.join(IMAGE_ENDINGS)}"
    raise SpecError(f"contains no images; {expected}{there}{said}", Where(str(source)))


def natural_order(name: str) -> tuple[list[str | int], str]:
    """Return a sort key that orders 2.png before 10.png, and a before B."""
    return [int(part) if k % 2 else part.lower() for k, part in enumerate(re.split(r"(\d+)", name))], name


def _images_in(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the images of a folder in order, and sentences that count the photos which are not read."""
    files = [path for path in folder.iterdir() if not path.name.startswith(".")] if folder.is_dir() else []
    found = [path for path in files if path.suffix.lower() in IMAGE_ENDINGS and path.is_file()]
    color = [path for path in found if not _DEPTH.search(path.name)]
    counts = Counter(path.suffix for path in files if path.suffix.lower() in OTHER_PHOTOS)
    left_out = [f"{count} files {suffix} are not read; convert them" for suffix, count in sorted(counts.items())]
    if color and len(color) < len(found):
        left_out.append(f"{len(found) - len(color)} depth images are not frames")
    return sorted(color or found, key=lambda path: natural_order(path.name)), left_out


def _in_time(images: ImageList) -> ImageList:
    if images.stamps is None:
        return images
    order = np.argsort(images.stamps, kind="stable")
    return ImageList(tuple(images.paths[i] for i in order), tuple(images.names[i] for i in order), images.stamps[order])


def _read_list(path: Path) -> ImageList:
    if path.suffix.lower() in IMAGE_ENDINGS:
        raise SpecError(f"is a single image; expected {_EXPECTED}", Where(str(path)))
    table = read_table(path, _EXPECTED)
    column = next((found for name in _NAMES if (found := table.column(name)) is not None), None)
    if table.named and column is not None:
        return _by_columns(table, column)
    names, stamps = [], []
    for number, line in table.lines:
        text = line.strip()
        readings = list(_readings(text))
        for name, stamp in readings:
            if os.path.isfile(path.parent / name):  # unlike Path.is_file, it accepts names that no file can have
                if stamp is not None and not np.isfinite(stamp):
                    found = f'the time stamp "{text.split()[0]}" is not finite; expected seconds'
                    raise SpecError(found, Where(str(path), number, line.index(text) + 1))
                names.append(name)
                stamps.append(stamp)
                break
        else:
            name = readings[-1][0]
            raise SpecError(f'no such image "{name}" in {path.parent}', Where(str(path), number, line.index(name) + 1))
    if not names:
        raise SpecError("lists no images", Where(str(path)))
    known = np.array(stamps, np.float64) if None not in stamps else None
    return ImageList(tuple(path.parent / name for name in names), tuple(names), known)


def _by_columns(table: Table, column: int) -> ImageList:
    """Return the images of a list whose first line names the columns."""
    time = table.column(TIME)
    unit = 1.0 if time is None else UNITS[table.unit(time) or "s"]
    names, stamps = [], []
    for row in table.rows:
        where = Where(str(table.path), row.line, 1)
        if len(row.cells) != len(table.names):
            raise SpecError(f"has {len(row.cells)} columns, the first line names {len(table.names)}", where)
        if not os.path.isfile(table.path.parent / row.cells[column]):
            raise SpecError(f'no such image "{row.cells[column]}" in {table.path.parent}', where)
        if time is not None and not (is_number(row.cells[time]) and np.isfinite(float(row.cells[time]))):
            raise SpecError(f'the time stamp "{row.cells[time]}" is not a number', where)
        names.append(row.cells[column])
        stamps.append(0.0 if time is None else unit * float(row.cells[time]))
    if not names:
        raise SpecError("lists no images", Where(str(table.path)))
    known = None if time is None else np.array(stamps)
    return ImageList(tuple(table.path.parent / name for name in names), tuple(names), known)


def _readings(text: str) -> Iterator[tuple[str, float | None]]:
    """Yield the possible meanings of a line, (name, stamp), in the order in which they are tried."""
    ends = [match.start() for match in _COMMENT.finditer(text)]
    for line in (text, *(text[:end] for end in reversed(ends))):
        match = _LINE.fullmatch(line)
        assert match is not None, "every line has a name"
        stamp = None if match["stamp"] is None else float(match["stamp"])
        yield line, None
        if stamp is not None:
            yield line[match.start("name") :], stamp
        yield line[: match.end("name")], None
        yield match["name"], stamp
