"""Views of an image: all of it, and its middle at larger scale, as seen by a camera further ahead."""

from __future__ import annotations

from typing import TYPE_CHECKING

from netspec.errors import SpecError

if TYPE_CHECKING:  # the command line reads zooms without numpy
    import numpy as np


def read_zooms(zooms: str | float) -> tuple[float, ...]:
    """Return the zooms of ``"1,0.7"``: each is the share of the image's height and width that the view shows.

    Raises SpecError unless each is more than 0 and at most 1.
    """
    try:
        found = tuple(float(text) for text in str(zooms).split(","))
    except ValueError:
        raise SpecError(f'found zooms "{zooms}", expected numbers separated by commas, e.g. "1,0.7"') from None
    for zoom in found:
        if not 0 < zoom <= 1:
            raise SpecError(f"found zoom {zoom:g}, expected more than 0 and at most 1 (the whole image)")
    return found


def middle(image: np.ndarray, zoom: float) -> np.ndarray:
    """Return the middle part of an image, ``zoom`` of its height and width; 1 is the whole image."""
    height, width = image.shape[:2]
    top, left = round(height * (1 - zoom) / 2), round(width * (1 - zoom) / 2)
    return image[top : max(height - top, top + 1), left : max(width - left, left + 1)]
