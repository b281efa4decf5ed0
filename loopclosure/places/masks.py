"""Reads ground truth: masks of frames that show the same place (.mat, .npy, .txt, images), matches, coordinates."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError
from loopclosure.places.frames import read_pixels
from loopclosure.places.mat_file import read_mat
from netspec.errors import SpecError
from netspec.files.arrays import opened, read_array
from netspec.files.kinds import nearest_existing, unreadable
from netspec.files.opencv import cv2

# Names of the matrix: "truth" in the FAB-MAP sets, "GT" in files derived from them.
TRUTH_KEYS = ("truth", "gt", "groundtruth", "ground_truth")
COORDINATE_KEYS = ("gps", "coordinates", "xy")
TABLE_OF_PLACES = "a table with columns place_id,query,ref"
LOSSLESS_SUFFIXES = (".bmp", ".png", ".pgm", ".tif", ".tiff")


def read_truth_matrix(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a mask of loops: (hard, soft), both (Q, R) bool.

    0 is another place, 1 (or 255) the same place. Values between are soft (gray in RTAB-Map's masks): such a match is
    not a mistake, but it need not be found. The suffix gives the format: MATLAB (.mat, variable ``truth`` or ``GT``, or
    its only matrix), NumPy (.npy), numbers separated by blanks or commas (.txt, .csv), or a lossless image.
    """
    path = Path(path)
    values = _read_matrix(path, TRUTH_KEYS, "a mask of loops")
    if values.ndim != 2:
        raise InputError(f"has shape {values.shape}; expected a matrix, queries x references", path)
    if not np.all(np.isfinite(values)) or values.min(initial=0) < 0:
        raise InputError("has a negative or non-finite entry; expected 0 = another place, 1 = the same place", path)
    largest = values.max(initial=0)
    if largest not in (1, 255):
        raise InputError(
            f"its largest entry is {largest:g}; expected 1 or 255 for the same place, 0 for another place", path
        )
    return values == largest, values > 0


def read_matches(path: str | Path, queries: int, references: int) -> tuple[np.ndarray, np.ndarray]:
    """Read which references (R) show each query (Q): (hard, soft), both (Q, R) bool.

    The file is a mask as for :func:`read_truth_matrix`, or a .json file with lists. The lists are rows of a query's
    number and the numbers of its references (VPR-Bench has the same in a pickle), or only the references of each query
    in order. Numbers count from 0. Raises InputError for other files, and for numbers out of range.
    """
    path = Path(path)
    lists = _read_lists(path) if path.suffix.lower() == ".json" else None
    if lists is None:
        hard, soft = read_truth_matrix(path)
        if hard.shape != (queries, references):
            turned = hard.shape == (references, queries)
            raise InputError(
                f"is {hard.shape[0]} x {hard.shape[1]}, but there are {queries} queries and {references} references"
                f"{'; transpose it' if turned else ''}",
                path,
            )
        return hard, soft
    numbered = lists and all(len(row) == 2 and isinstance(row[0], int) and not isinstance(row[1], int) for row in lists)
    rows = [(row[0], row[1]) for row in lists] if numbered else list(enumerate(lists))
    hard = np.zeros((queries, references), bool)
    for query, found in rows:
        for reference in [found] if isinstance(found, int) else found:
            if not isinstance(reference, int):
                raise InputError(f"query {query} has {reference!r:.40} for a reference; expected its number", path)
            if not (0 <= query < queries and 0 <= reference < references):
                raise InputError(
                    f"names query {query} and reference {reference}; there are {queries} queries and {references} "
                    "references, counted from 0",
                    path,
                )
            hard[query, reference] = True
    return hard, hard


def _read_lists(path: Path) -> list[Any]:
    try:
        lists = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError("cannot be read; expected lists of the numbers of images, in JSON", path) from error
    if not (isinstance(lists, list) and all(isinstance(row, list) for row in lists)):
        raise InputError("expected a list of lists of the numbers of images", path)
    return lists


def read_coordinates(path: str | Path) -> np.ndarray:
    """Read the coordinates x, y (N, 2) of images from a .mat (variable ``GPS``), .npy or text file.

    A row of a text file has x and y, or the image's name, x and y.
    """
    path = Path(path)
    values = _read_matrix(path, COORDINATE_KEYS, "coordinates", last_columns=2)
    if values.ndim != 2 or values.shape[1] not in (2, 3):
        raise InputError(f"has shape {values.shape}; expected x and y, or number, x and y, in each row", path)
    if not np.all(np.isfinite(values)):
        raise InputError("has a non-finite entry; expected meters", path)
    return values[:, -2:]


def read_place_pairs(path: str | Path) -> list[tuple[str, Path, Path]]:
    """Read a table of places seen twice, pairs.csv with columns place_id, query, ref: rows of place and two images.

    The images are relative to the table's folder. Raises InputError (file:line) for a missing image.
    """
    path = Path(path)
    rows = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream)
            missing = {"place_id", "query", "ref"} - set(reader.fieldnames or ())
            if missing:
                raise InputError(f"has no column {', '.join(sorted(missing))}; expected place_id,query,ref", path, 1, 1)
            for row in reader:
                images = []
                for column in ("query", "ref"):
                    image = path.parent / (row[column] or "")
                    if not os.path.isfile(image):
                        raise InputError(f'no such {column} image "{row[column]}"', path, reader.line_num, 1)
                    images.append(image)
                rows.append((row["place_id"], images[0], images[1]))
    except OSError as error:
        raise InputError(unreadable(path, error, TABLE_OF_PLACES), path) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"is not a table; expected {TABLE_OF_PLACES}", path) from error
    if not rows:
        raise InputError("has no row", path)
    return rows


def _read_matrix(path: Path, keys: tuple[str, ...], what: str, last_columns: int | None = None) -> np.ndarray:
    if not path.is_file():
        raise InputError(f"no such file; expected {what}{nearest_existing(path)}", path)
    suffix = path.suffix.lower()
    if suffix == ".mat":
        return _read_mat(path, keys, what)
    if suffix == ".npy":
        with opened(path, what) as stream:
            return _numeric(read_array(stream, path.stat().st_size), path)
    if suffix in (".txt", ".csv", ".dat"):
        return _read_text(path, what, last_columns)
    if suffix in LOSSLESS_SUFFIXES:
        try:
            return read_pixels(path, cv2.IMREAD_GRAYSCALE)
        except SpecError as fault:
            raise InputError(f"{fault.message}; expected {what}", path) from None
    raise InputError(
        f'"{suffix}" is not a known suffix for {what}; known: .mat .npy .txt .csv {" ".join(LOSSLESS_SUFFIXES)}'
        + (" (a JPEG has lost the exact values)" if suffix in (".jpg", ".jpeg") else ""),
        path,
    )


def _read_mat(path: Path, keys: tuple[str, ...], what: str) -> np.ndarray:
    matrices = read_mat(path)
    named = [name for key in keys for name in matrices if name.lower() == key]
    if not named and len(matrices) == 1:
        named = list(matrices)
    if not named:
        found = ", ".join(f"{n} {m.shape[0]}x{m.shape[1]}" for n, m in matrices.items()) or "no matrix"
        raise InputError(f'has no variable "{keys[0]}" ({what}); found {found}', path)
    return _numeric(matrices[named[0]], path)


def _numeric(values: np.ndarray, path: Path) -> np.ndarray:
    if values.dtype.kind not in "buif":
        raise InputError(f"holds {values.dtype}; expected numbers", path)
    return values.astype(np.uint8) if values.dtype == bool else values


def _read_text(path: Path, what: str, last_columns: int | None) -> np.ndarray:
    """Read rows of numbers; only the ``last_columns`` from the right, if given: the others may be names."""
    rows: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text; expected {what}", path) from error
    for number, line in enumerate(lines, start=1):
        fields = line.partition("#")[0].replace(",", " ").split()
        if not fields:
            continue
        taken = fields if last_columns is None else fields[-last_columns:]
        try:
            row = [float(field) for field in taken]
        except ValueError:
            raise InputError(f'expected numbers, found "{line.strip()[:60]}"', path, number, 1) from None
        if rows and len(row) != len(rows[0]):
            raise InputError(f"has {len(row)} numbers, the rows above have {len(rows[0])}", path, number, 1)
        rows.append(row)
    if not rows:
        raise InputError(f"is empty; expected {what}", path)
    return np.array(rows)


# Which images of a folder are used. Except with "all", images of a left and a right camera alternate (Cummins and
# Newman, FAB-MAP, IJRR 2008).
#   all     all images, of one camera
#   left    only the left images
#   right   only the right images
#   both    all images; a left one is never compared with a right one, because the cameras look to opposite sides
#   joined  left and right joined as one image; two show the same place if any of their views does
CAMERAS = ("all", "left", "right", "both", "joined")


def images_of_places(camera: str, images: int) -> NDArray[np.intp]:
    """Return the image numbers of each place: (places, 1), or for "joined" (places, 2), left and right.

    Raises InputError for an unknown camera, or if the number of ``images`` is odd.
    """
    if camera not in CAMERAS:
        raise InputError(f'unknown camera "{camera}"; known: {", ".join(CAMERAS)}')
    if camera in ("all", "both"):
        return np.arange(images)[:, None]
    if images % 2:
        raise InputError(f"{images} images cannot be pairs of a left and a right one")
    left = np.arange(0, images, 2)
    return {"left": left[:, None], "right": left[:, None] + 1, "joined": np.stack([left, left + 1], axis=1)}[camera]


def mask_of_places(camera: str, mask: NDArray, images: int, file: Path) -> NDArray:
    """Convert a mask of images (images, images) to a mask of places (places, places).

    A mask of places is returned unchanged. Raises InputError, which names ``file``, for a mask of another size.
    """
    places = images_of_places(camera, images)
    if mask.shape == (images, images):
        views = [
            mask[np.ix_(places[:, i], places[:, j])] for i in range(places.shape[1]) for j in range(places.shape[1])
        ]
        return np.any(views, axis=0)
    if camera in ("left", "right", "joined") and mask.shape == (len(places), len(places)):
        return mask
    halved = "; does the folder have only one camera's images?" if len(mask) == 2 * images else ""
    raise InputError(f"is {mask.shape[0]} x {mask.shape[1]}, but there are {images} images{halved}", file)


def comparable(camera: str, places: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pairs of places from :func:`images_of_places` can be judged: (places, places)."""
    side = places[:, 0] % 2 if camera == "both" else np.zeros(len(places))
    return side[:, None] == side
