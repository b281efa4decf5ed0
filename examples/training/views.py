"""Makes two views of each place, in batches of different places, to train nets with an N-pair loss.

python3 views.py SOURCE... --out FOLDER: a SOURCE is a folder with the images of a drive, or CSV,TRACK,TIME: a table
with a column "image", and the columns that name an image's drive and its second there. FOLDER.txt lists the pairs.

The N-pair loss compares every first image of a batch with every second one (Sohn, Improved Deep Metric Learning with
Multi-class N-pair Loss, NIPS 2016). A batch of N pairs therefore has N (N - 1) negatives, where contrastive pairs have
one negative for each positive. Places of one drive look similar, so they are hard negatives. A batch therefore has
several places of few drives.
"""

import argparse
import csv
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from light import change_light

from lmdb_build import write_pair_list
from loopclosure import read_sequence

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
SMOOTHING = 0.4  # standard deviation of the smoothing before reducing a part, in pixels of the view


CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)  # of a picture of size 1: x, y, clockwise


@dataclass
class Runs:
    """M images of several drives: their files, the number of each one's drive (M,), and its second there (M,)."""

    images: list[Path]
    tracks: np.ndarray
    stamps: np.ndarray


def read_runs(sources: list[str], step: float) -> Runs:
    """Read all sources; the images of a folder are ``step`` seconds apart."""
    runs = []  # (name of the drive, second, image)
    for source in sources:
        table, *columns = source.split(",")
        if columns:
            with open(table, encoding="utf-8") as file:
                track, time = columns
                rows = [
                    (row[track], float(row[time]), Path(table).parent / row["image"]) for row in csv.DictReader(file)
                ]
            runs += [(f"{table} {name}", second, image) for name, second, image in rows]
        else:
            runs += [(source, number * step, image) for number, image in enumerate(read_sequence(source).paths)]
    names, stamps, images = zip(*runs, strict=True)
    return Runs([image.resolve() for image in images], np.unique(names, return_inverse=True)[1], np.array(stamps))


def choose_views(runs: Runs, count: int, size: int, window: float, rng: np.random.Generator) -> np.ndarray:
    """Return the numbers of the first and second image of all pairs (count * size, 2), batch after batch.

    A batch of ``size`` pairs draws its images from drives in random order; the probability of a drive to come first is
    proportional to its length. The images are from ``window`` seconds of each drive, at a random position.
    """
    of_track = [np.flatnonzero(runs.tracks == track) for track in np.unique(runs.tracks)]
    shares = np.array([len(images) for images in of_track]) / len(runs.tracks)
    first: list[int] = []
    for _ in range(count):
        batch: list[int] = []
        for track in rng.choice(len(of_track), len(of_track), replace=False, p=shares):
            part = rng.permutation(_part(runs.stamps, of_track[track], window, rng))
            batch += _different_places(runs.stamps, part)
            if len(batch) >= size:
                break
        else:
            raise SystemExit(f"{len(of_track)} drives gave {len(batch)} places for a batch of {size}; lower --size")
        first += batch[:size]
    return np.array([(image, _partner(runs, image, rng)) for image in first])


def _part(stamps: np.ndarray, images: np.ndarray, window: float, rng: np.random.Generator) -> np.ndarray:
    """Return the images of a run in a window at a random position."""
    if not np.isfinite(window):
        return images
    of_run = stamps[images]
    start = rng.uniform(of_run.min() - window / 2, max(of_run.max() - window / 2, of_run.min()))
    return images[(of_run >= start) & (of_run <= start + window)]


def _different_places(stamps: np.ndarray, images: np.ndarray) -> list[int]:
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
    image: np.ndarray,
    size: tuple[int, int],
    position: np.ndarray,
    rng: np.random.Generator,
    viewpoint: float = 1.0,
) -> np.ndarray:
    """Return a view of the image (H, W, 3) uint8 as a nearby camera might see it: (height, width, 3).

    ``position`` (2,) is where the visible part is in the image: x from 0 (left) to 1 (right), y from 0 (top) to 1
    (bottom). Views with the same position overlap at any zoom. ``viewpoint`` multiplies zoom, rotation and perspective.
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
    homography = cv2.getPerspectiveTransform(quad.astype(np.float32), (CORNERS * size).astype(np.float32))
    return cv2.warpPerspective(image, homography, size, borderMode=cv2.BORDER_REFLECT)


def main() -> None:
    """Write two views for each pair to a folder, and the list of the pairs beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="folder for the views")
    parser.add_argument("--step", type=float, default=1.0, help="seconds between images of a folder (%(default)g)")
    parser.add_argument("--batches", type=int, default=400, help="number of batches (%(default)s)")
    parser.add_argument("--size", type=int, default=48, help="pairs in a batch, each of another place (%(default)s)")
    parser.add_argument("--window", type=float, default=np.inf, help="seconds of a drive that a batch is from (all)")
    parser.add_argument("--viewpoint", type=float, default=1.0, help="strength of zoom and rotation (%(default)g)")
    parser.add_argument("--calm", type=float, default=0.0, help="share of the views in the same light (%(default)g)")
    parser.add_argument("--view-size", default="128x96", help="size of a view (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="random seed (%(default)s)")
    a = parser.parse_args()
    runs, (width, height) = read_runs(a.source, a.step), map(int, a.view_size.split("x"))
    pairs = choose_views(runs, a.batches, a.size, a.window, np.random.default_rng([a.seed, 0]))
    a.out.mkdir(parents=True, exist_ok=True)
    listed = []
    for number, pair in enumerate(pairs):
        rng = np.random.default_rng([a.seed, 1, number])
        mirrored, position = rng.random() < 0.5, rng.uniform(0, 1, 2)
        names = [f"{a.out.name}/{number:06d}_{side}.jpg" for side in "ab"]
        for image, name in zip(pair, names, strict=True):
            picture = cv2.imread(str(runs.images[image]))
            if mirrored:
                picture = np.ascontiguousarray(picture[:, ::-1])
            view = cut_view(picture, (width, height), position, rng, a.viewpoint)
            other = partial(cv2.imread, str(runs.images[rng.integers(len(runs.images))]))  # few views need it
            cv2.imwrite(str(a.out.parent / name), change_light(view, other, rng, a.calm))  # quality 95
        listed.append((*names, 1))
    write_pair_list(a.out.with_name(f"{a.out.name}.txt"), listed, {"made by": f"views.py, seed {a.seed}"})
    print(f"{len(listed)} pairs of {len(runs.images)} images")


if __name__ == "__main__":
    main()
