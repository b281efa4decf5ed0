"""Reads ground truth: masks of frames that show the same place (.mat, .npy, .txt, images), matches, coordinates."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import issparse

from loopclosure.errors import InputError
from loopclosure.places.frames import read_pixels
from netspec.files.arrays import opened, read_array
from netspec.files.kinds import nearest_existing
from netspec.files.opencv import cv2
from netspec.files.table import is_number, read_table

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
    table = read_table(path, TABLE_OF_PLACES)
    found = [table.column(name) for name in ("place_id", "query", "ref")]
    columns = [column for column in found if column is not None]
    if len(columns) < 3 or not table.rows:
        raise InputError(f"is not a table of places; expected {TABLE_OF_PLACES}", path, 1, 1)
    rows = []
    for row in table.rows:
        place, *images = (row.cells[column] if column < len(row.cells) else "" for column in columns)
        for image in images:
            if not os.path.isfile(table.path.parent / image):
                raise InputError(f'no such image "{image}"', path, row.line, 1)
        rows.append((place, table.path.parent / images[0], table.path.parent / images[1]))
    return rows


def _read_matrix(path: Path, keys: tuple[str, ...], what: str, last_columns: int | None = None) -> np.ndarray:
    if not path.is_file():
        raise InputError(f"no such file; expected {what}{nearest_existing(path)}", path)
    suffix = path.suffix.lower()
    if suffix == ".mat":
        return _read_mat(path, keys, what)
    if suffix == ".npy":
        with opened(path, what) as stream:
            return _numeric(read_array(stream), path)
    if suffix in (".txt", ".csv", ".dat"):
        return _read_text(path, what, last_columns)
    if suffix in LOSSLESS_SUFFIXES:
        return read_pixels(path, cv2.IMREAD_GRAYSCALE)
    known = f".mat .npy .txt .csv {' '.join(LOSSLESS_SUFFIXES)} (a JPEG has lost the exact values)"
    raise InputError(f'"{suffix}" is not a known suffix for {what}; known: {known}', path)


def _read_mat(path: Path, keys: tuple[str, ...], what: str) -> np.ndarray:
    from scipy.io import loadmat  # imported here: it imports threadpoolctl, which sets an environment variable

    try:
        found = loadmat(path)
    except NotImplementedError:
        raise InputError("is a MATLAB 7.3 file; save it again in MATLAB with -v7", path) from None
    except Exception as fault:  # for a damaged file, loadmat can raise anything
        raise InputError(f"cannot be read as .mat ({' '.join(str(fault).split())}); expected {what}", path) from None
    matrices = {name: each.toarray() if issparse(each) else each for name, each in found.items() if name[0] != "_"}
    named = [name for key in keys for name in matrices if name.lower() == key]
    if not named and len(matrices) == 1:
        named = list(matrices)
    if not named:
        there = ", ".join(matrices) or "none"
        raise InputError(f'has no variable "{keys[0]}" ({what}); it has {there}', path)
    return _numeric(np.asarray(matrices[named[0]]), path)


def _numeric(values: np.ndarray, path: Path) -> np.ndarray:
    if values.dtype.kind not in "buif":
        raise InputError(f"holds {values.dtype}; expected numbers", path)
    return values.astype(np.uint8) if values.dtype == bool else values


def _read_text(path: Path, what: str, last_columns: int | None) -> np.ndarray:
    """Read rows of numbers; only the ``last_columns`` from the right, if given: the others may be names."""
    table = read_table(path, what)
    cells = [row.cells if last_columns is None else row.cells[-last_columns:] for row in table.rows]
    for row, found in zip(table.rows, cells, strict=True):
        if not all(map(is_number, found)) or len(found) != len(cells[0]):
            raise InputError(f"expected {len(cells[0])} numbers, as in the first row", path, row.line, 1)
    if not cells:
        raise InputError(f"has no row of numbers; expected {what}", path)
    return np.array(cells, np.float64)


# Which images of a folder are used. Except with "all", images of a left and a right camera alternate (Cummins and
# Newman, FAB-MAP, IJRR 2008).
#   all     all images, of one camera
#   left    only the left images
#   right   only the right images
#   both    all images; a left one is never compared with a right one, because the cameras look to opposite sides
CAMERAS = ("all", "left", "right", "both")


def images_of_places(camera: str, images: int) -> NDArray[np.intp]:
    """Return the numbers of the images of a ``camera``, one for each place.

    Raises InputError for an unknown camera, or if the number of ``images`` is odd.
    """
    if camera not in CAMERAS:
        raise InputError(f'unknown camera "{camera}"; known: {", ".join(CAMERAS)}')
    if camera in ("left", "right"):
        if images % 2:
            raise InputError(f"{images} images cannot be pairs of a left and a right one")
        return np.arange(camera == "right", images, 2)
    return np.arange(images)


def mask_of_places(camera: str, mask: NDArray, images: int, file: Path) -> NDArray:
    """Convert a mask of images (images, images) to a mask of places (places, places).

    A mask of places is returned unchanged. Raises InputError, which names ``file``, for a mask of another size.
    """
    places = images_of_places(camera, images)
    if mask.shape == (images, images):
        return mask[np.ix_(places, places)]
    if mask.shape == (len(places), len(places)):
        return mask
    halved = "; does the folder have only one camera's images?" if len(mask) == 2 * images else ""
    raise InputError(f"is {mask.shape[0]} x {mask.shape[1]}, but there are {images} images{halved}", file)


def comparable(camera: str, places: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pairs of places from :func:`images_of_places` can be judged: (places, places)."""
    side = places % 2 if camera == "both" else np.zeros(len(places))
    return side[:, None] == side
