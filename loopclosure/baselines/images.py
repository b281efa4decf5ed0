"""The pictures that the baselines look at, and how long they take over them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from loopclosure.errors import InputError
from loopclosure.frames import read_image


def grey(image: np.ndarray) -> np.ndarray:
    """Return an (H, W, 3) BGR or (H, W) grey image, uint8, as (H, W) grey values."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def read_grey(path: Path) -> np.ndarray:
    """Return the picture as (H, W) uint8 grey values; InputError where there is none."""
    return grey(read_image(path))


def refuse_overlap(train_images: list[Path], test_images: list[Path], model: str | Path = "") -> None:
    """Raise InputError when an image is trained on and tested: a vocabulary that knows the test flatters itself."""
    trained = {Path(path).resolve() for path in train_images}
    shared = [path for path in test_images if Path(path).resolve() in trained]
    if shared:
        raise InputError(
            f"{len(shared)} of {len(test_images)} test images are training images too, the first is {shared[0]}; "
            "train on images of other places",
            model,
        )


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to ``seconds[stage]``."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
