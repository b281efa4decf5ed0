"""Folders in which the images of a left and a right camera alternate, as in FAB-MAP's New College and City Centre.

The first image is the left one of the first place, the second the right one of it, and so on. What is taken of them:

    all      every image: the folder of a single camera
    left     the left images
    right    the right images
    both     every image; a left one is never compared with a right one: the mask calls some such pairs the same place,
             though the two cameras look to opposite sides
    joined   left and right side by side as one image, the same place if any of their views is

Cummins and Newman, FAB-MAP, IJRR 2008.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError

CAMERAS = ("all", "left", "right", "both", "joined")


def images_of_places(camera: str, images: int) -> NDArray[np.intp]:
    """Return the image numbers of each place: (places, 1), or of "joined" (places, 2), left and right.

    Raises InputError for an unknown camera, or where ``images`` are not pairs of a left and a right one.
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
    """Return a mask of images (images, images) as one of places (places, places).

    A mask that already is one of places of two images passes as it is. Raises InputError, which names ``file``, for a
    mask of another size.
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
    """Return which pairs of places, as :func:`images_of_places` gives them, are judged at all: (places, places)."""
    side = places[:, 0] % 2 if camera == "both" else np.zeros(len(places))
    return side[:, None] == side
