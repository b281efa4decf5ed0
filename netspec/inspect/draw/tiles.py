"""Arrays as tiles of a picture: images as Caffe stores them, maps, filters."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from netspec.data.datum import times
from netspec.inspect.draw.style import stretched

FRAME = 0.06  # of a tile's side, between tiles


def as_picture(values: np.ndarray) -> np.ndarray:
    """Return values (C, H, W) as brightness (H, W) or (H, W, 3), 0 to 1, for a picture.

    Bytes are shown as they are, other values from the least (black) to the greatest (white). Three channels are blue,
    green, red, as OpenCV decodes them. Of two, or of more than four, the mean is shown; a vector becomes a block.
    """
    if values.shape[1:] == (1, 1):
        values = _block(values.reshape(-1))[None]
    shown = values.astype(np.float64)
    shown = shown / 255 if values.dtype == np.uint8 else stretched(shown)
    if len(shown) in (3, 4):
        return shown[2::-1].transpose(1, 2, 0)
    return shown.mean(axis=0)


def split(values: np.ndarray, images: int) -> list[np.ndarray]:
    """Return the images (C / images, H, W) that a record (C, H, W) holds, all of it if it cannot hold so many."""
    if images > 1 and len(values) % images == 0:
        return np.split(values, images)
    return [values]


def images_in(values: np.ndarray) -> int:
    """Return how many images a record (C, H, W) seems to hold: 2 for two gray ones or two in color, else 1."""
    return 2 if len(values) in (2, 6) and values.shape[1:] != (1, 1) else 1


def what_is_shown(values: np.ndarray) -> str:
    """Return a word on values (C, H, W) whose picture does not show all channels as they are; "" for others."""
    if values.shape[1:] == (1, 1) and len(values) > 4:
        return f"vectors of {len(values)} numbers as blocks"
    return f"{times(values.shape)}, the mean of the channels" if len(values) not in (1, 3, 4) else ""


def draw_tile(axis: Axes, picture: np.ndarray, left: float, bottom: float, width: float, height: float) -> None:
    """Draw a picture as large as fits into a rectangle, in its middle."""
    rows, columns = picture.shape[:2]
    scale = min(width / columns, height / rows)
    x, y = left + (width - scale * columns) / 2, bottom + (height - scale * rows) / 2
    axis.imshow(
        picture,
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(x, x + scale * columns, y, y + scale * rows),
        interpolation="nearest" if scale * 100 > 1.2 else "antialiased",
        aspect="equal",
    )


def _block(vector: np.ndarray) -> np.ndarray:
    """Return a vector as rows of a block that is about as wide as high; what is left over is the least value."""
    columns = int(np.ceil(np.sqrt(len(vector))))
    rows = -(-len(vector) // columns)
    block = np.full(rows * columns, vector.min() if len(vector) else 0, vector.dtype)
    block[: len(vector)] = vector
    return block.reshape(rows, columns)
