"""Makes two views of each place, in batches of different places, to train nets with an N-pair loss.

The N-pair loss compares every first image of a batch with every second one (Sohn, Improved Deep Metric Learning with
Multi-class N-pair Loss, NIPS 2016). A batch of N pairs therefore has N (N - 1) negatives, where contrastive pairs have
one negative for each positive. Places of one run look similar, so they are hard negatives. A batch therefore has
several places of few runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdb_build.light import change_light
from lmdb_build.pairs.list_file import write_pair_list
from lmdb_build.pairs.runs import Indices, Runs
from lmdb_build.picture import CORNERS, seen_through, write_jpeg
from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from loopclosure.progress import Progress, silent
from netspec.files.opencv import cv2

PER_RUN = 8  # the most places of one run in a batch
LEAST_GAP_S = 4.0  # places of one run in a batch are more than this many seconds apart
OTHER_IMAGE = 0.4  # share of the pairs whose second view is cut from another image than the first
OTHER_IMAGE_S = 1.0  # the other image was taken within this many seconds
# Random changes of each view.
ZOOM = 2.0  # the visible part has 1 to 1/2 of the image's height
SHIFT = 0.2  # each view is shifted from the center of its pair by up to this share of its margin
STRETCH = 0.15  # the aspect ratio changes by a factor of up to e^0.15
TURN_DEG = 4.0  # standard deviation of the rotation
CORNER = 0.08  # perspective: each corner is moved by up to this share of the part's size
MOST_VIEWPOINT = 3  # the visible part is then down to 1/8 of the height; with more, views may not overlap
SMOOTHING = 0.4  # standard deviation of the smoothing before reducing a part, in pixels of the view


@dataclass(frozen=True)
class Batches:
    """The number of batches and how their places are chosen.

    count   number of batches
    size    pairs per batch
    window  length of the part of a run that a batch's places come from, in units of the stamps; at a random position
    seed    seed of the choice of places and of the views
    """

    count: int
    size: int = 48
    window: float = float("inf")
    seed: int = 1

    def check(self) -> None:
        """Raise InputError for values out of range."""
        for name in ("count", "size"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name} must be at least 1, not {getattr(self, name)}")
        if not self.window > 0:
            raise InputError(f"--window must be more than 0, not {self.window:g}")
        if self.seed < 0:
            raise InputError(f"a seed must be 0 or more, not {self.seed}")


@dataclass(frozen=True)
class Changes:
    """How the two views of a place differ.

    viewpoint  factor for the strength of zoom, rotation and perspective
    calm       share of the views that keep their colors and are not covered (:func:`lmdb_build.light.change_light`)
    size       (width, height) of a view
    """

    viewpoint: float = 1.0
    calm: float = 0.0
    size: tuple[int, int] = (128, 96)

    def check(self) -> None:
        """Raise InputError for values out of range."""
        if not 0 <= self.viewpoint <= MOST_VIEWPOINT:
            raise InputError(f"--viewpoint must be 0 to {MOST_VIEWPOINT}, not {self.viewpoint:g}")
        if not 0 <= self.calm <= 1:
            raise InputError(f"--calm must be 0 to 1, not {self.calm:g}")


def choose_views(runs: Runs, batches: Batches, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Return first and second images of all pairs (count * size,), batch after batch.

    A batch draws its images from runs in random order; the probability of a run to come first is proportional to its
    length. Raises InputError if the runs do not have enough places for a batch.
    """
    batches.check()
    of_track = [np.flatnonzero(runs.tracks == track) for track in np.unique(runs.tracks)]
    shares = np.array([len(images) for images in of_track]) / len(runs.tracks)
    first: list[int] = []
    for _ in range(batches.count):
        batch: list[int] = []
        for track in rng.choice(len(of_track), len(of_track), replace=False, p=shares):
            part = rng.permutation(_part(runs.stamps, of_track[track], batches.window, rng))
            batch += _different_places(runs.stamps, part)
            if len(batch) >= batches.size:
                break
        else:
            raise InputError(
                f"a batch of {batches.size} different places cannot be made: the {len(of_track)} runs gave "
                f"{len(batch)}, at most {PER_RUN} of each, more than {LEAST_GAP_S:g} s apart; lower --size"
            )
        first += batch[: batches.size]
    return np.array(first), np.array([_partner(runs, image, rng) for image in first])


def _part(stamps: NDArray[np.float64], images: Indices, window: float, rng: np.random.Generator) -> Indices:
    """Return the images of a run in a window at a random position."""
    if not np.isfinite(window):
        return images
    of_run = stamps[images]
    start = rng.uniform(of_run.min() - window / 2, max(of_run.max() - window / 2, of_run.min()))
    return images[(of_run >= start) & (of_run <= start + window)]


def _different_places(stamps: NDArray[np.float64], images: Indices) -> list[int]:
    """Return up to PER_RUN images, chosen in order, that are more than LEAST_GAP_S from each other."""
    taken: list[int] = []
    for image in images.tolist():
        if len(taken) < PER_RUN and np.all(np.abs(stamps[taken] - stamps[image]) > LEAST_GAP_S):
            taken.append(image)
    return taken


def _partner(runs: Runs, image: int, rng: np.random.Generator) -> int:
    """Return the image of the second view: mostly the same image, sometimes one taken at nearly the same time."""
    if rng.random() < OTHER_IMAGE:
        near = (runs.tracks == runs.tracks[image]) & (np.abs(runs.stamps - runs.stamps[image]) <= OTHER_IMAGE_S)
        others = np.flatnonzero(near & (np.arange(len(near)) != image))
        if len(others):
            return int(rng.choice(others))
    return image


def cut_view(
    image: NDArray,
    size: tuple[int, int],
    position: NDArray[np.float64],
    rng: np.random.Generator,
    viewpoint: float = 1.0,
) -> NDArray[np.uint8]:
    """Return a view of the image (H, W, 3) uint8 as a nearby camera might see it: (height, width, 3).

    ``position`` (2,) is where the visible part is in the image: x from 0 (left) to 1 (right), y from 0 (top) to 1
    (bottom). Views with the same position overlap at any zoom. See :class:`Changes` for ``viewpoint``.
    """
    width, height = size
    part_h = image.shape[0] * np.exp(rng.uniform(-np.log(ZOOM) * viewpoint, 0))
    part_w = min(image.shape[1], part_h * width / height * np.exp(rng.uniform(-STRETCH, STRETCH)))
    part = np.array([part_w, part_h])
    quad = (CORNERS - 0.5 + rng.uniform(-CORNER, CORNER, (4, 2)) * viewpoint) * part
    angle = np.deg2rad(rng.normal(0, TURN_DEG * viewpoint))
    cos, sin = np.cos(angle), np.sin(angle)
    quad = quad @ np.array([[cos, -sin], [sin, cos]]) + part / 2
    quad += np.clip(position + rng.uniform(-SHIFT, SHIFT, 2), 0, 1) * (np.array(image.shape[1::-1]) - part)
    reduction = part_h / height
    if reduction > 1.5:
        image = cv2.GaussianBlur(image, (0, 0), SMOOTHING * reduction)
    return seen_through(image, quad, CORNERS * size, size)


def write_views(
    runs: Runs,
    batches: Batches,
    changes: Changes,
    root: Path,
    folder: Path,
    progress: Progress = silent,
) -> Path:
    """Write two views for each pair to ``folder``, and the list ``folder``.txt. Return the path of the list.

    If one view of a pair is mirrored, so is the other. Raises InputError if batches cannot be made, or an image cannot
    be read or written.
    """
    changes.check()
    first, second = choose_views(runs, batches, np.random.default_rng([batches.seed, 0]))
    folder.mkdir(parents=True, exist_ok=True)
    listed = []
    for number, pair in enumerate(progress(zip(first, second, strict=True), "views", len(first))):
        rng = np.random.default_rng([batches.seed, 1, number])
        mirrored, position = rng.random() < 0.5, rng.uniform(0, 1, 2)
        names = [f"{folder.name}/{number:06d}_{side}.jpg" for side in "ab"]
        for image, name in zip(pair, names, strict=True):
            picture = read_bgr(root / runs.names[image])
            if mirrored:
                picture = np.ascontiguousarray(picture[:, ::-1])
            view = cut_view(picture, changes.size, position, rng, changes.viewpoint)
            other = partial(read_bgr, root / runs.names[rng.integers(len(runs.names))])  # few views need it
            write_jpeg(folder.parent / name, change_light(view, other, rng, changes.calm))
        listed.append((*names, 1))
    out = folder.with_name(f"{folder.name}.txt")
    settings = {
        "source": f"{len(runs.names)} images of {len(np.unique(runs.tracks))} runs",
        "batches": f"{batches.count} of {batches.size} places, up to {PER_RUN} of one run, "
        f"more than {LEAST_GAP_S:g} apart, in a part of {batches.window:g}",
        "point of view": f"{changes.viewpoint:g} times as different",
        "calm": f"{changes.calm:g} of the views",
        "seed": str(batches.seed),
    }
    write_pair_list(out, listed, settings)
    return out
