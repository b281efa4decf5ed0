"""A picture of sample pairs from a list, positives beside negatives, as in the paper's Figures 2 and 4."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.list_file import ListedPair, read_pair_list
from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from netspec.errors import SpecError
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

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
    with suppress(OSError):  # said when the file is written
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
