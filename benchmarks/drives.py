"""Makes drives with known loops, for choosing and evaluating settings: ``tools/bench settings``.

A sequence without loops gets a second pass: each frame in another season (one change of colors, tones and light for the
whole drive), from a slightly different viewpoint. Frame i of both passes shows the same place. The drives are made from
such passes and from synthetic walks: whole traverses, keyframes, parts of a route, other speeds, small images, one
drive that comes back, and drives that share nothing.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lmdb_build.light import change_light
from lmdb_build.picture import write_jpeg
from lmdb_build.views import cut_view
from lmdb_build.walk.sequence import Walk, write_walk
from loopclosure.places.datasets import DataSet, load_folder, load_sequence
from loopclosure.places.frames import Selection, image_paths, read_bgr
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M, same_place_matrix
from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import Poses
from loopclosure.places.truth import Exclusion, sequence_truth, traverse_truth
from netspec.files.opencv import cv2

NEAR, OVERLAP = 1, 4  # frames of one route: the same place, and views that overlap
KEYFRAMES = 4
VIEWPOINT = 0.3  # strength of the change of viewpoint in another season, see lmdb_build.views
SMALL = (64, 32)
NOISE = 4.0  # gray levels, camera noise between frames at one position
SEASONS, SAME = (2, 3), 0
WALKS = (41, 42)  # seeds
OTHER_LIGHT, BACK = "three laps, the last in another light", "there, and back in reverse"
# No setting was chosen on these walks. Houses and seeds differ from all that were looked at before.
RENDERED = {
    OTHER_LIGHT: Walk(270, 160, 120, laps=3, rooms=6, seed=201),
    BACK: Walk(130, 160, 120, laps=1, rooms=6, seed=202),
    "once through a large house": Walk(220, 160, 120, laps=1, rooms=20, seed=203),
    "slow, two laps": Walk(400, 160, 120, laps=2, seed=204),
    "fast, three laps": Walk(150, 160, 120, laps=3, rooms=8, seed=205),
}
GAP = 30  # frames nearer than this in one drive are not a loop
# The families of the first half, by place; all others are the second. What is chosen on one is judged on the other.
FIRST_HALF = (
    "bridge_highway",
    "city_drive",
    "karlsruhe_street",
    "street_pan",
    "walk_41",
    "fr1",
    "kitchen",
    "nordland_1",
)
SOFT_DEG = 45.0  # the soft rule: views of one place (2 m) with a smaller angle are not a mistake


@dataclass(frozen=True)
class Drive:
    """A data set, and the sequence or house it was made of: settings are never chosen and evaluated on the same one."""

    family: str
    kind: str
    data: DataSet

    @property
    def name(self) -> str:
        """Both in one word."""
        return f"{self.family}/{self.kind}"


def drives(data: Path, work: Path, only: Sequence[str] = ()) -> Iterator[Drive]:
    """Yield the drives of all or some families in the folder ``data``; images are written to ``work``.

    Those of the family "rendered" are no part of all: they are asked for by name.
    """
    if "rendered" in only:
        yield from _rendered(work)
    routes = {}
    with (data / "sequences" / "index.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            if row["has_revisits"] == "no":
                routes[row["name"]] = image_paths(data / "sequences" / row["name"])
    names = list(routes)
    for name, other in zip(names, names[1:] + names[:1], strict=True):
        if name in (only or names):
            yield from _of_route(name, routes[name], routes[other], work)
    for seed in WALKS:
        for size in ((160, 120), SMALL):
            if not only or f"walk_{seed}" in only:
                yield from _of_walk(seed, size, work)
    for name in ("xyz", "rpy") if not only or "fr1" in only else ():
        desk = {
            name: read_sequence(data / "tum_fr1" / f"rgbd_dataset_freiburg1_{name}", "tum") for name in ("xyz", "rpy")
        }
        exclusion = Exclusion(seconds=3.0)
        yield Drive("fr1", name, load_sequence(desk[name], Selection(stride=2), exclusion))
        yield Drive("fr1", f"{name}, keyframes", load_sequence(desk[name], Selection(stride=8), exclusion))
        other = desk["xyz" if name == "rpy" else "rpy"].taken(Selection(stride=2))
        yield Drive("fr1", f"{name} from elsewhere", load_sequence(desk[name], Selection(stride=2), references=other))
    corridor = data / "corridor_loop"
    if not only or "corridor" in only:
        yield Drive("corridor", "loop", load_folder(corridor / "samples", corridor / "samples_GT.bmp"))
    for half in (1, 2):
        if not only or f"nordland_{half}" in only:
            yield from _of_nordland(data / "nordland_64x32", half)
    for name, pattern in (("kitchen", "redkitchen"), ("chess", "chess_*")):
        if not only or name in only:
            yield Drive(name, "room", _room(sorted((data / "seven_scenes").glob(pattern))))


def _of_nordland(folder: Path, half: int) -> Iterator[Drive]:
    """Yield half of the railway in two seasons: as two traverses, and as one drive, summer followed by winter."""
    summer, winter = (image_paths(folder / season) for season in ("summer", "winter"))
    middle = len(summer) // 2
    part = slice(middle) if half == 1 else slice(middle, None)
    every = np.arange(len(summer[part]), dtype=float)
    yield Drive(f"nordland_{half}", "season", _traverses(winter[part], every, summer[part], every))
    yield Drive(f"nordland_{half}", "twice", _one_drive([*summer[part], *winter[part]], np.tile(every, 2)))


def _room(folders: Sequence[Path]) -> DataSet:
    """Make one drive of sequences in one frame of reference, one after the other."""
    parts = [read_sequence(folder, "tum") for folder in folders]
    paths = [path for part in parts for path in part.paths]
    return _posed(paths, np.concatenate([part.poses for part in parts if part.poses is not None]))


def _posed(paths: Sequence[Path], poses: np.ndarray) -> DataSet:
    """Make one drive of images with poses (N, 7), NaN where not known: these images are left out."""
    known = np.flatnonzero(np.all(np.isfinite(poses), axis=1))
    posed = Poses(poses[known, :3], poses[known, 3:])
    hard = same_place_matrix(posed, posed, MAX_DISTANCE_M, MAX_ANGLE_DEG)
    truth = sequence_truth(hard, Exclusion(GAP), "same place: less than 2 m and 15 degrees apart")
    images = ImageSequence.of_files([paths[i] for i in known.tolist()])
    return DataSet("", images, None, truth, GAP)


def _of_route(name: str, route: list[Path], other: list[Path], work: Path) -> Iterator[Drive]:
    second, third = (in_season(route, work / name, season) for season in SEASONS)
    foreign = in_season(other, work / other[0].parent.name, SEASONS[0])
    every = np.arange(len(route), dtype=float)
    yield Drive(name, "season 2", _traverses(second, every, route, every))
    yield Drive(name, "season 3", _traverses(third, every, route, every))
    keys = np.arange(0, len(route), KEYFRAMES)
    yield Drive(name, "keyframes", _traverses(second, every, [route[i] for i in keys], every[keys]))
    rng = np.random.default_rng(len(route))
    uneven = np.repeat(np.arange(len(route)), rng.integers(0, 3, len(route)))
    uneven = uneven[np.append(True, np.diff(uneven) > 0)]
    yield Drive(name, "uneven", _traverses([third[i] for i in uneven], every[uneven], route, every))
    half = slice(len(route) // 4, 3 * len(route) // 4)
    away = foreign[: len(route) // 2]
    yield Drive(
        name,
        "in part",
        _traverses(away + third[half], np.append(np.full(len(away), np.nan), every[half]), route, every),
    )
    small = _resized(route, work / f"{name}_small"), _resized(second, work / f"{name}_2_small")
    yield Drive(name, "season 2, small", _traverses(small[1], every, small[0], every))
    between = other[: len(route) // 2]
    once = [*route, *between, *second[half]]
    where = np.concatenate([every, np.full(len(between), np.nan), every[half]])
    yield Drive(name, "comes back", _one_drive(once, where))
    yield Drive(name, "once", _one_drive(route, every))
    second_pass = in_season(route, work / name, SAME)
    passes = [*route, *second_pass]
    yield Drive(name, "twice", _one_drive(passes, np.tile(every, 2)))
    yield Drive(name, "twice, small", _one_drive(_resized(passes, work / f"{name}_passes_small"), np.tile(every, 2)))
    yield Drive(name, "twice, season 2", _one_drive([*route, *second], np.tile(every, 2)))
    standing = _standing(len(route))
    stands = _stood([second[i] for i in standing], work / f"{name}_2_standing")
    yield Drive(name, "stands", _traverses(stands, every[standing], route, every))
    stood = _stood([route[i] for i in standing], work / f"{name}_standing")
    yield Drive(name, "stood", _traverses(second, every, stood, every[standing]))
    yield Drive(name, "shares nothing", _traverses(foreign, np.full(len(foreign), np.nan), route, every))


def _standing(frames: int) -> np.ndarray:
    """Return the places of a drive that stops at three places of the route."""
    rng = np.random.default_rng(frames)
    times = np.ones(frames, int)
    times[rng.integers(0, frames, 3)] = rng.integers(10, 40, 3)
    return np.repeat(np.arange(frames), times)


def _stood(images: list[Path], folder: Path) -> list[Path]:
    """Write copies of the images with camera noise to ``folder``, so that repeated images differ."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / f"{number:06d}.jpg" for number in range(len(images))]
    for number, (image, path) in enumerate(zip(images, made, strict=True)):
        if not path.exists():
            picture = read_bgr(image)
            noise = np.random.default_rng(number).normal(0, NOISE, picture.shape)
            write_jpeg(path, np.clip(picture + noise, 0, 255).astype(np.uint8))
    return made


def _of_walk(seed: int, size: tuple[int, int], work: Path) -> Iterator[Drive]:
    name, end = f"walk_{seed}", "" if size != SMALL else ", small"
    first = read_sequence(walked(work, Walk(300, *size, laps=2, seed=seed)), "tum")
    yield Drive(name, f"laps{end}", load_sequence(first, exclusion=Exclusion(seconds=10.0)))
    for season in SEASONS:
        images = in_season(list(first.paths), work / f"{name}_{size[0]}", season)
        yield Drive(name, f"season {season}{end}", load_sequence(replace(first, paths=tuple(images)), references=first))


def walked(work: Path, walk: Walk) -> Path:
    """Return the folder of a synthetic walk in ``work``."""
    folder = work / f"walk_{walk.seed}_{walk.width}"
    if not (folder / "rgb.txt").exists():
        for _ in write_walk(folder, walk):
            pass
    return folder


def _rendered(work: Path) -> Iterator[Drive]:
    """Yield five walks through houses that no setting was chosen on."""
    for kind, walk in RENDERED.items():
        folder = walked(work, walk)
        sequence = read_sequence(folder, "tum")
        paths, poses = list(sequence.paths), sequence.poses
        assert poses is not None
        if kind == OTHER_LIGHT:
            last = walk.frames // walk.laps * (walk.laps - 1)
            paths[last:] = in_season(paths[last:], folder, SEASONS[1])
        elif kind == BACK:
            back = in_season(paths, folder, SAME)
            paths, poses = paths + back[::-1], np.concatenate([poses, poses[::-1]])
        yield Drive("rendered", kind, _posed(paths, poses))


def _traverses(queries: list[Path], there: np.ndarray, references: list[Path], here: np.ndarray) -> DataSet:
    """Make a data set of two traverses; ``there`` (Q,) and ``here`` (R,) are frame numbers on the route, or NaN."""
    differences = np.abs(np.subtract.outer(there, here))
    step = np.median(np.diff(here))
    truth = traverse_truth(differences <= max(NEAR, step / 2), "same place: frames of the same number")
    both = ImageSequence.of_files(queries), ImageSequence.of_files(references)
    return DataSet("", *both, truth)


def _one_drive(images: list[Path], where: np.ndarray) -> DataSet:
    differences = np.abs(np.subtract.outer(where, where))
    truth = sequence_truth(differences <= NEAR, Exclusion(GAP), "same place: frames of the same number")
    return DataSet("", ImageSequence.of_files(images), None, truth, GAP)


def in_season(images: list[Path], folder: Path, season: int) -> list[Path]:
    """Write the drive from a shifted viewpoint to ``folder``, in another season unless it is ``SAME``."""
    folder = folder.with_name(f"{folder.name}_{season}")
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / f"{image.stem}.jpg" for image in images]
    front = read_bgr(images[0])
    for number, (image, path) in enumerate(zip(images, made, strict=True)):
        if not path.exists():
            picture = read_bgr(image)
            size = (picture.shape[1], picture.shape[0])
            middle = np.array([0.5, 0.5])
            view = cut_view(picture, size, middle, np.random.default_rng([season, number]), VIEWPOINT)
            lit = view if season == SAME else change_light(view, lambda: front, np.random.default_rng(season))
            write_jpeg(path, lit)
    return made


def _resized(images: list[Path], folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / f"{number:06d}.jpg" for number in range(len(images))]
    for image, path in zip(images, made, strict=True):
        if not path.exists():
            write_jpeg(path, cv2.resize(read_bgr(image), SMALL, interpolation=cv2.INTER_AREA))
    return made
