"""Image files and lists of them, read as in Caffe's ImageData layer and convert_imageset.

Caffe: src/caffe/util/io.cpp (ReadImageToCVMat), src/caffe/layers/image_data_layer.cpp
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from netspec.data.datum import decode_pixels, planar
from netspec.data.resize import resized
from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.files.limits import read_bytes
from netspec.files.opencv import cv2
from netspec.files.table import text_lines

_TOO_LARGE = 2**31  # for a Datum's label, an int32
_MOST_DIGITS = 4000  # Python refuses to read more than 4300
_INTEGER = re.compile(r"[+-]?[0-9]+")


@dataclass(frozen=True)
class ListedImage:
    """One line of an image list; ``where`` is its position in the list file."""

    name: str
    label: int
    where: Where


def read_label(digits: str, where: Where) -> int:
    """Return an integer label. Raises SpecError for one beyond the 32 bits of a Datum's."""
    label = int(digits[:_MOST_DIGITS])
    if not -_TOO_LARGE <= label < _TOO_LARGE:
        raise SpecError(f"found label {digits}, expected one of 32 bits, {-_TOO_LARGE} to {_TOO_LARGE - 1}", where)
    return label


def read_image(path: str, color: bool = True, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return an image file as uint8 (C, H, W): 3 channels (blue, green, red), or 1 if ``color`` is false.

    ``size`` is (height, width). Images are resized bilinearly without low-pass filtering, with Caffe's pixels.
    Raises ValueError with the name of the file if it is missing or is not an image.
    """
    try:
        pixels = decode_pixels(read_bytes(path), color)
    except OSError as fault:
        raise ValueError(f'image "{path}" {unreadable(path, fault)}') from None
    except ValueError as fault:
        raise ValueError(f'image "{path}" {fault}') from None
    if size:
        height, width = size
        try:
            pixels = resized(pixels, height, width)
        except (cv2.error, MemoryError):  # too large
            raise ValueError(f'image "{path}" cannot be resized to {height} x {width}') from None
    return planar(pixels)


def list_lines(path: str, where: Where | None = None) -> Iterator[tuple[str, Where]]:
    """Yield the lines of a list file with their positions, except blank lines.

    ``where`` is the position in the prototxt. Raises SpecError if the file cannot be read.
    """
    try:
        lines = text_lines(path)
    except OSError as fault:
        raise SpecError(f'list file "{path}" {unreadable(path, fault)}', where or Where(path)) from None
    except ValueError:
        raise SpecError(f'list file "{path}" is not UTF-8 text', where or Where(path)) from None
    for number, line in lines:
        yield line.strip(), Where(path, number, 1)


def read_image_list(path: str, where: Where | None = None) -> list[ListedImage]:
    """Read lines of the form ``name label``, split at the last space, so that names can contain spaces.

    Raises SpecError for a line without an integer label, and for a list without lines. (Caffe reads a label that is not
    a number as 0.)
    """
    images = []
    for line, position in list_lines(path, where):
        name, _, label = line.rpartition(" ") if " " in line else line.rpartition("\t")
        if not name or not _INTEGER.fullmatch(label):
            raise SpecError(f'found "{line}", expected an image name, a space and an integer label', position)
        images.append(ListedImage(name.rstrip(), read_label(label, position), position))
    if not images:
        raise SpecError(f'the image list "{path}" is empty', where or Where(path))
    return images
