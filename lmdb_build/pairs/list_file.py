"""The list file of pairs: one ``first second label`` per line, after comment lines with the settings; pairs as a sheet.

A name that contains blanks, or begins with ``#``, is in double quotes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from netspec.errors import SpecError
from netspec.files.kinds import unreadable
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

ROOT_FOLDER = (
    "root folder"  # this setting is the folder that image names are relative to, itself relative to the list's folder
)


_WORD = re.compile(r'"([^"]*)"|(\S+)')


@dataclass(frozen=True)
class ListedPair:
    """One line of a list: two image names below the root folder, and 1 for the same place, 0 for other places."""

    first: str
    second: str
    label: int
    line: int


def write_pair_list(path: Path, pairs: Iterable[tuple[str, str, int]], settings: Mapping[str, str]) -> None:
    """Write a list; ``settings`` become the lines ``# name: value`` of its header.

    Raises InputError for an image name that a list cannot contain, or if the file cannot be written.
    """
    lines = ["# first second label; 1: the same place, 0: other places"]
    lines += [f"# {name}: {value}" for name, value in settings.items()]
    for first, second, label in pairs:
        lines.append(f"{_quoted(first)} {_quoted(second)} {label}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", path) from error
    write_whole(path, "\n".join(lines) + "\n", "surrogateescape")


def read_pair_list(path: Path) -> list[ListedPair]:
    """Read a list. Raises InputError (file:line:column) for a malformed line."""
    pairs = []
    for number, line in enumerate(_read_lines(path), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = [quoted or bare for quoted, bare in _WORD.findall(line)]
        if len(fields) != 3:
            raise InputError(
                f"found {line.strip()!r}, expected two images and a label: a.png b.png 1; "
                "names with blanks go into double quotes",
                path,
                number,
                1,
            )
        if fields[2] not in ("0", "1"):
            column = line.rindex(fields[2]) + 1
            raise InputError(f'a label is 1 (same place) or 0 (other places), not "{fields[2]}"', path, number, column)
        pairs.append(ListedPair(fields[0], fields[1], int(fields[2]), number))
    if not pairs:
        raise InputError("lists no pair", path)
    return pairs


def read_settings(path: Path) -> dict[str, str]:
    """Return the ``# name: value`` lines of a list's header."""
    settings = {}
    for line in _read_lines(path):
        if not line.startswith("#"):
            break
        name, colon, value = line[1:].partition(": ")
        if colon:
            settings[name.strip()] = value.strip()
    return settings


def _quoted(name: str) -> str:
    if '"' in name or "\n" in name:
        raise InputError(f"cannot list the image {name!r}: a name must not contain quotes or line breaks")
    return f'"{name}"' if name.split() != [name] or name.startswith("#") else name


def root_of(path: Path) -> Path:
    """Return the folder that a list's images are relative to: the one in its header, or else the list's own folder."""
    return path.parent / read_settings(path).get(ROOT_FOLDER, ".")


def _read_lines(path: Path) -> list[str]:
    expected = 'lines such as "a.png b.png 1"'
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")  # names of files can be any bytes
    except OSError as error:
        raise InputError(unreadable(path, error, expected), path) from error
    if "\0" in text:
        raise InputError(f"is not a text file; expected {expected}", path)
    return text.splitlines()


IMAGE_WIDTH, IMAGE_HEIGHT = 240, 180
BORDER, CAPTION, TITLE = 6, 40, 44
PAPER, INK = (255, 255, 255), (30, 30, 30)
SIDES = ((1, "the same place", (60, 150, 40)), (0, "other places", (50, 50, 200)))
LONGEST = 32  # characters of a caption
FONT = cv2.FONT_HERSHEY_SIMPLEX


def contact_sheet(list_file: Path, root: Path, rows: int = 6, seed: int = 1) -> NDArray:
    """Draw ``rows`` positive pairs on the left and as many negative ones on the right: (H, W, 3) uint8, BGR.

    The pairs are drawn from the list at random. Raises InputError for a list or an image that cannot be read.
    """
    pairs = read_pair_list(list_file)
    rng = np.random.default_rng(seed)
    columns = []
    for label, title, color in SIDES:
        of_label = [pair for pair in pairs if pair.label == label]
        sample = [of_label[index] for index in sorted(rng.permutation(len(of_label))[:rows])]
        tiles = [_title(f"{title} (label {label}, {len(of_label)} pairs)", color)]
        tiles += [_pair(pair, list_file, root, color) for pair in sample]
        columns.append(np.vstack(tiles))
    height = max(len(column) for column in columns)
    gap = np.full((height, 4 * BORDER, 3), PAPER, np.uint8)
    left, right = (
        cv2.copyMakeBorder(column, 0, height - len(column), 0, 0, cv2.BORDER_CONSTANT, value=PAPER)
        for column in columns
    )
    return np.hstack([left, gap, right])


def write_contact_sheet(list_file: Path, root: Path, out: Path, rows: int = 6, seed: int = 1) -> None:
    """Write :func:`contact_sheet` as a picture; the suffix says its format."""
    if rows < 1:
        raise InputError(f"a contact sheet must have at least 1 row, not {rows}")
    sheet = contact_sheet(list_file, root, rows, seed)
    try:
        done, picture = cv2.imencode(out.suffix, sheet)
    except cv2.error:
        done = False
    if not done:
        raise InputError("cannot be written as a picture; a suffix such as .png says its format", out)
    with suppress(OSError):  # write_whole reports it
        out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, picture.tobytes())


def _title(text: str, color: tuple[int, int, int]) -> NDArray:
    tile = np.full((TITLE, _width(), 3), PAPER, np.uint8)
    cv2.putText(tile, text, (BORDER, TITLE - 14), FONT, 0.65, color, 2, cv2.LINE_AA)
    return tile


def _pair(pair: ListedPair, list_file: Path, root: Path, color: tuple[int, int, int]) -> NDArray:
    tile = np.full((IMAGE_HEIGHT + 2 * BORDER + CAPTION, _width(), 3), PAPER, np.uint8)
    cv2.rectangle(tile, (0, 0), (_width() - 1, IMAGE_HEIGHT + 2 * BORDER - 1), color, -1)
    for number, name in enumerate((pair.first, pair.second)):
        try:
            picture = read_bgr(root / name)
        except SpecError as error:
            raise InputError(f"{root / name} {error.message}", list_file, pair.line, 1) from error
        left = BORDER + number * (IMAGE_WIDTH + BORDER)
        tile[BORDER : BORDER + IMAGE_HEIGHT, left : left + IMAGE_WIDTH] = _fitted(picture)
        for line, text in enumerate(_caption(name)):
            foot = (left, IMAGE_HEIGHT + 2 * BORDER + 14 + 15 * line)
            cv2.putText(tile, text, foot, FONT, 0.42, INK, 1, cv2.LINE_AA)
    return tile


def _width() -> int:
    return 2 * IMAGE_WIDTH + 3 * BORDER


def _fitted(picture: NDArray) -> NDArray:
    """Scale a picture into its frame, without distortion."""
    scale = min(IMAGE_WIDTH / picture.shape[1], IMAGE_HEIGHT / picture.shape[0])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    frame = np.full((IMAGE_HEIGHT, IMAGE_WIDTH, 3), 40, np.uint8)
    top, left = (IMAGE_HEIGHT - size[1]) // 2, (IMAGE_WIDTH - size[0]) // 2
    frame[top : top + size[1], left : left + size[0]] = scaled
    return frame


def _caption(name: str) -> list[str]:
    """Return two lines: the end of the folder's name, the end of the file's name."""
    folder, _, file = name.rpartition("/")
    return [text if len(text) <= LONGEST else ".." + text[2 - LONGEST :] for text in (folder, file)]
