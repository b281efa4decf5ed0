"""Two views of each place, in batches of different places: for nets that learn to tell a batch's places apart.

Contrastive pairs show a net one negative for each positive. If the loss compares every first image of a batch with
every second one (Sohn, Improved Deep Metric Learning with Multi-class N-pair Loss, NIPS 2016), a batch of N pairs has
N (N - 1) negatives, and the choice of its places matters: places of one run look alike, so a batch takes several
places of few runs.
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

# What changes between two views, drawn for each view.
ZOOM = 2.0  # the part that is seen has 1 to 1/2 of the image's height
SHIFT = 0.2  # a pair's views have a common center; each is shifted by up to this share of its margin
STRETCH = 0.15  # the proportions of the part change by a factor of up to e^0.15
TURN_DEG = 4.0  # standard deviation
CORNER = 0.08  # each corner is moved by up to this share of the part's size: perspective
MOST_VIEWPOINT = 3  # a part of an eighth of the height; beyond, two views may have little in common
SMOOTHING = 0.4  # standard deviation of the filter before a part is made smaller, in pixels of the view


@dataclass(frozen=True)
class Batches:
    """How views are arranged.

    count      how many batches
    size       pairs in a batch, all of different places
    per_track  of them at most so many from one run
    apart      places of one run are further apart than this (in units of the stamps)
    window     and come from a part of the run of this length, at a random position
    max_gap    a pair's second image may be another one, at most so far from the first
    other      in this share of the pairs it is, where there is one
    negatives  in this share of the pairs the second image shows another place of the batch, as ContrastiveLoss wants it
    """

    count: int
    size: int = 48
    per_track: int = 8
    apart: float = 4.0
    max_gap: float = 1.0
    other: float = 0.4
    negatives: float = 0.0
    window: float = float("inf")

    def check(self) -> None:
        """Raise InputError for numbers that cannot make a batch."""
        for name in ("count", "size", "per_track"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name.replace('_', '-')} must be at least 1, not {getattr(self, name)}")
        for name in ("other", "negatives"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"--{name} must be 0 to 1, not {getattr(self, name):g}")
        if round(self.size * self.negatives) == 1:
            raise InputError(f"--negatives {self.negatives:g} of --size {self.size} is one pair; expected none or two")
        if not self.window > 0:
            raise InputError(f"--window must be more than 0, not {self.window:g}")
        if self.apart < self.max_gap:
            raise InputError(
                f"--apart {self.apart:g} is less than --max-gap {self.max_gap:g}: a batch could have one place twice"
            )


@dataclass(frozen=True)
class Changes:
    """How the two views of a place differ.

    viewpoint  how strongly the point of view does: zoom, turn and perspective are this many times as strong
    calm       this share of the views keeps its colors, and what it shows (:func:`lmdb_build.light.change_light`)
    """

    viewpoint: float = 1.0
    calm: float = 0.0

    def check(self) -> None:
        """Raise InputError for numbers that mean nothing."""
        if not 0 <= self.viewpoint <= MOST_VIEWPOINT:
            raise InputError(f"--viewpoint must be 0 to {MOST_VIEWPOINT}, not {self.viewpoint:g}")
        if not 0 <= self.calm <= 1:
            raise InputError(f"--calm must be 0 to 1, not {self.calm:g}")


def choose_views(runs: Runs, batches: Batches, rng: np.random.Generator) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Return first and second images of all pairs (count * size,), batch after batch, and whether both are one place.

    A batch draws its images from runs in random order; a run is as likely to come first as it is long.
    Raises InputError where all runs together have not enough places for a batch.
    """
    batches.check()
    of_track = [np.flatnonzero(runs.tracks == track) for track in np.unique(runs.tracks)]
    shares = np.array([len(images) for images in of_track]) / len(runs.tracks)
    first: list[int] = []
    same = np.ones((batches.count, batches.size), bool)
    for _ in range(batches.count):
        batch: list[int] = []
        for track in rng.choice(len(of_track), len(of_track), replace=False, p=shares):
            batch += _different_places(
                runs.stamps, rng.permutation(_part(runs.stamps, of_track[track], batches, rng)), batches
            )
            if len(batch) >= batches.size:
                break
        else:
            raise InputError(
                f"a batch of {batches.size} different places cannot be made: the {len(of_track)} runs gave "
                f"{len(batch)}; lower --size or --apart, or raise --per-track"
            )
        first += batch[: batches.size]
    second = np.array([_partner(runs, image, batches, rng) for image in first])
    for seconds, sames in zip(second.reshape(same.shape), same, strict=True):
        exchanged = rng.permutation(batches.size)[: round(batches.size * batches.negatives)]
        seconds[exchanged] = seconds[np.roll(exchanged, 1)]
        sames[exchanged] = False
    return np.array(first), second, same.ravel()


def _part(stamps: NDArray[np.float64], images: Indices, batches: Batches, rng: np.random.Generator) -> Indices:
    """Return the images of a run that are in a window at a random position."""
    if not np.isfinite(batches.window):
        return images
    of_run = stamps[images]
    start = rng.uniform(of_run.min() - batches.window / 2, max(of_run.max() - batches.window / 2, of_run.min()))
    return images[(of_run >= start) & (of_run <= start + batches.window)]


def _different_places(stamps: NDArray[np.float64], images: Indices, batches: Batches) -> list[int]:
    """Return the first ``per_track`` images that are far enough from the earlier ones."""
    taken: list[int] = []
    for image in images.tolist():
        if np.all(np.abs(stamps[taken] - stamps[image]) > batches.apart):
            taken.append(image)
            if len(taken) == batches.per_track:
                break
    return taken


def _partner(runs: Runs, image: int, batches: Batches, rng: np.random.Generator) -> int:
    if rng.random() < batches.other:
        near = (runs.tracks == runs.tracks[image]) & (np.abs(runs.stamps - runs.stamps[image]) <= batches.max_gap)
        others = np.flatnonzero(near & (np.arange(len(near)) != image))
        if len(others):
            return int(rng.choice(others))
    return image


def cut_view(
    image: NDArray, size: tuple[int, int], about: NDArray[np.float64], rng: np.random.Generator, viewpoint: float = 1.0
) -> NDArray[np.uint8]:
    """Return a view of the image (H, W, 3) uint8 as a nearby camera might see it: (height, width, 3).

    ``about`` (2,) is the position of the visible part: 0 at the left (the top), 1 at the right (the bottom). Views
    about one point overlap at any zoom. ``viewpoint`` is that of :class:`Changes`.
    """
    width, height = size
    part_h = image.shape[0] * np.exp(rng.uniform(-np.log(ZOOM) * viewpoint, 0))
    part_w = min(image.shape[1], part_h * width / height * np.exp(rng.uniform(-STRETCH, STRETCH)))
    part = np.array([part_w, part_h])
    quad = (CORNERS - 0.5 + rng.uniform(-CORNER, CORNER, (4, 2)) * viewpoint) * part
    cos, sin = np.cos(np.deg2rad(angle := rng.normal(0, TURN_DEG * viewpoint))), np.sin(np.deg2rad(angle))
    quad = quad @ np.array([[cos, -sin], [sin, cos]]) + part / 2
    quad += np.clip(about + rng.uniform(-SHIFT, SHIFT, 2), 0, 1) * (np.array(image.shape[1::-1]) - part)
    if (shrinks := part_h / height) > 1.5:
        image = cv2.GaussianBlur(image, (0, 0), SMOOTHING * shrinks)
    return seen_through(image, quad, CORNERS * size, size)


def write_views(
    runs: Runs,
    batches: Batches,
    changes: Changes,
    size: tuple[int, int],
    root: Path,
    folder: Path,
    seed: int,
    progress: Progress = silent,
) -> Path:
    """Write two views of ``size`` (width, height) for each pair below ``folder``, and the list ``folder``.txt.

    Both views of a pair are mirrored, or neither is. Raises InputError if batches cannot be made, or an image cannot
    be read or written.
    """
    if seed < 0:
        raise InputError(f"a seed must be 0 or more, not {seed}")
    changes.check()
    first, second, same = choose_views(runs, batches, np.random.default_rng([seed, 0]))
    folder.mkdir(parents=True, exist_ok=True)
    listed = []
    for number, pair in enumerate(progress(zip(first, second, strict=True), "views", len(first))):
        rng = np.random.default_rng([seed, 1, number])
        mirrored, about = rng.random() < 0.5, rng.uniform(0, 1, 2)
        names = [f"{folder.name}/{number:06d}_{side}.jpg" for side in "ab"]
        for image, name in zip(pair, names, strict=True):
            picture = read_bgr(root / runs.names[image])
            view = cut_view(
                np.ascontiguousarray(picture[:, ::-1]) if mirrored else picture, size, about, rng, changes.viewpoint
            )
            other = partial(read_bgr, root / runs.names[rng.integers(len(runs.names))])  # few views need it
            write_jpeg(folder.parent / name, change_light(view, other, rng, changes.calm))
        listed.append((*names, int(same[number])))
    out = folder.with_name(f"{folder.name}.txt")
    settings = {
        "source": f"{len(runs.names)} images of {len(np.unique(runs.tracks))} runs",
        "batches": f"{batches.count} of {batches.size} places, up to {batches.per_track} of one run, "
        f"more than {batches.apart:g} apart, in a part of {batches.window:g}",
        "second image": f"a different one in {batches.other:g} of the pairs, up to {batches.max_gap:g} away",
        "point of view": f"{changes.viewpoint:g} times as different",
        "calm": f"{changes.calm:g} of the views",
        "negatives": f"{batches.negatives:g} of the pairs",
        "seed": str(seed),
    }
    write_pair_list(out, listed, settings)
    return out
