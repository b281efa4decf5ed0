"""Which images a folder or a list names, in which order, and when they were taken."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from netspec.errors import SpecError, Where

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class ImageList:
    """Image files in order: ``paths``, the ``names`` they are known by, ``stamps`` [s] where the list has them."""

    paths: tuple[Path, ...]
    names: tuple[str, ...]
    stamps: np.ndarray | None


def read_image_list(path: Path) -> ImageList:
    """Return the images of a folder or of a list file.

    A folder with an ``rgb.txt`` (TUM RGB-D) gives that file's order and stamps; any other, its images in natural order
    (2 before 10). A list file has one image a line, relative to its own folder, or ``stamp image``, or ``image label``
    as Caffe's lists; the label is not used.
    """
    if path.is_dir():
        if (path / "rgb.txt").is_file():
            return read_image_list(path / "rgb.txt")
        found = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS), key=lambda p: _natural(p.name))
        if not found:
            raise SpecError("no image files in this folder", Where(str(path)))
        return ImageList(tuple(found), tuple(p.name for p in found), None)
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as fault:
        raise SpecError(f"cannot read the image list: {fault}", Where(str(path))) from None
    names, stamps = [], []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        first, _, rest = text.partition(" ")
        stamp = _as_stamp(first) if rest else None
        name = rest.strip() if stamp is not None else text
        before, _, label = name.rpartition(" ")
        if label.isdigit() and (path.parent / before).is_file():
            name = before
        if not (path.parent / name).is_file():
            raise SpecError(
                f"image {name!r} is missing in {path.parent}", Where(str(path), number, line.find(name) + 1)
            )
        names.append(name)
        stamps.append(stamp)
    if not names:
        raise SpecError("no image in this list", Where(str(path)))
    known = np.array(stamps, np.float64) if all(s is not None for s in stamps) else None
    return ImageList(tuple(path.parent / name for name in names), tuple(names), known)


def _as_stamp(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _natural(name: str) -> list[tuple[int, int, str]]:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
