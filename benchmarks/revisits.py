"""Measures what loopclosure finds on real drives that come back, and on drives that do not: ``tools/bench revisits``.

Each drive is decided as ``detect`` decides it, frame by frame as ``LoopDetector`` does, and in thirds: each third of a
drive is asked of the other two, as ``map query`` does. Beside them stands what many robots do: the most similar image
by a bag of ORB words, if a fundamental matrix agrees. Nothing is warped, relit or rendered.
"""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks import results
from benchmarks.cache import Cache
from benchmarks.pages import RESULTS
from benchmarks.tables import tower_images
from loopclosure.decision.constants import PRECISION
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures, Pairs
from loopclosure.methods.base import Images, earlier
from loopclosure.methods.drive import Drive, Request, speeds_between
from loopclosure.methods.named import make_method
from loopclosure.places.datasets import load_folder
from loopclosure.places.frames import image_paths, read_gray
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M, same_place_matrix
from loopclosure.places.sequences import read_sequence
from loopclosure.progress import silent

GAP = 30  # frames nearer than this in one drive are not a loop
NEAR, OVERLAP = 1, 4  # frames of one route: the same place, and views that overlap
SOFT_DEG = 45.0  # views of one place (2 m) with a smaller angle are not a mistake
# Drives with these names were chosen on: the last three only by rules that were added after a fault was seen on them.
FIRST = ("kitchen", "fr1_rpy", "nordland_1", "tower, floors 3 to 12", "office_handheld_loop")
FIRST += ("corridor", "nordland_2", "road: bridge_highway")
# Handheld, and laps of small robots; where they come back is not known, so only what is accepted is counted.
UNJUDGED = ("office_handheld_loop", "rc_exhibition_hall", "rc_hall_stone_floor", "rc_office_corridor")
OVERLAPS = 0.25, 0.05  # of the footprint of a drone's image that another sees: the same place, and no mistake
RECENT, INLIERS, RATIO = 20, 20, 0.8  # of the ORB words: frames that are no references; of the matrix; of the matches
DESK_GAP = 90  # frames, 3 s: a hand-held camera turns to and fro
HALVES = {"nordland_1": slice(596), "nordland_2": slice(596, None)}
FLOORS = {"3 to 12": range(3, 13), "13 to 23": range(13, 24)}
FILE, SUMMARY = RESULTS / "revisits.json", RESULTS / "revisits-summary.json"


@dataclass(frozen=True)
class Real:
    """A drive, and which of its frames (N, N) show the same place.

    rule    what must be found: less than 2 m and 15 degrees apart, or as the data set says
    wide    what is no mistake: less than 45 degrees apart
    judged  pairs that count
    known   whether it is known where the drive comes back
    train   images of other places, for words
    """

    name: str
    images: list[Path]
    rule: np.ndarray
    wide: np.ndarray
    judged: np.ndarray
    gap: int = GAP
    known: bool = True
    train: Sequence[Path] = ()

    def third(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the frames of a third, 0 to 2, and the others."""
        frames = np.arange(len(self.images))
        inside = frames * 3 // len(frames) == number
        return frames[inside], frames[~inside]


def drives(data: Path, only: Sequence[str] = ()) -> Iterator[Real]:
    """Yield the drives in the folder ``data``: all, or those with a name that begins as one of ``only``."""
    for name, load in _drives(data).items():
        if not only or name.startswith(tuple(only)):
            yield replace(load(), name=name, train=_training(data, name.startswith("tower")))


@functools.cache
def _training(data: Path, for_tower: bool) -> list[Path]:
    """Return images of another place: of chess for drives in the tower, of the tower for all others."""
    if not for_tower:
        return tower_images(data / "ie_tower")[::4]
    rooms = sorted((data / "seven_scenes").glob("chess_*"))
    return [path for room in rooms for path in read_sequence(room, "tum").paths][::2]


def _drives(data: Path) -> dict[str, Callable[[], Real]]:
    rooms, desks = data / "seven_scenes", data / "tum_fr1"
    made: dict[str, Callable[[], Real]] = {
        "kitchen": lambda: _posed([rooms / "redkitchen"]),
        "fr1_rpy": lambda: _posed([desks / "rgbd_dataset_freiburg1_rpy"], DESK_GAP),
        "nordland_1": lambda: _seasons(data / "nordland_64x32", HALVES["nordland_1"]),
        "chess": lambda: _posed(sorted(rooms.glob("chess_*"))),
        "fr1_xyz": lambda: _posed([desks / "rgbd_dataset_freiburg1_xyz"], DESK_GAP),
        "nordland_2": lambda: _seasons(data / "nordland_64x32", HALVES["nordland_2"]),
        "corridor": lambda: _corridor(data / "corridor_loop"),
        "drone_village": lambda: _drone(data / "drone_village"),
    }
    for floors, numbers in FLOORS.items():
        for rank, which in enumerate(("", ", second walks")):
            made[f"tower, floors {floors}{which}"] = lambda n=numbers, k=rank: _tower(data / "ie_tower", n, k)
    made["tower, 21 floors"] = lambda: _walks(data / "ie_tower")
    for name in UNJUDGED:
        folder = data / "sequences" / name
        made[name] = lambda folder=folder: replace(_without(image_paths(folder)), known=False)
    with (data / "sequences" / "index.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            if row["has_revisits"] == "no":
                folder = data / "sequences" / row["name"]
                made[f"road: {row['name']}"] = lambda folder=folder: _without(image_paths(folder))
    return made


def _pairs_before(count: int, gap: int) -> np.ndarray:
    return earlier(count, gap) | earlier(count, gap).T


def _posed(folders: Sequence[Path], gap: int = GAP) -> Real:
    """Make one drive of sequences in one frame of reference; frames without a pose are left out."""
    parts = [read_sequence(folder, "tum") for folder in folders]
    paths = [path for part in parts for path in part.paths]
    poses = np.concatenate([part.poses for part in parts if part.poses is not None])
    known = np.flatnonzero(np.all(np.isfinite(poses), axis=1))
    posed = poses[known]
    rule, wide = (same_place_matrix(posed, posed, MAX_DISTANCE_M, angle) for angle in (MAX_ANGLE_DEG, SOFT_DEG))
    return Real("", [paths[i] for i in known.tolist()], rule, wide, _pairs_before(len(known), gap), gap)


def _seasons(folder: Path, half: slice) -> Real:
    """Make one drive of half of the railway in summer, then in winter."""
    images = [path for season in ("summer", "winter") for path in image_paths(folder / season)[half]]
    where = np.tile(np.arange(len(images) // 2), 2)
    apart = np.abs(np.subtract.outer(where, where))
    return Real("", images, apart <= NEAR, apart <= OVERLAP, _pairs_before(len(images), GAP))


def _corridor(folder: Path) -> Real:
    truth = load_folder(folder / "samples", folder / "samples_GT.bmp")
    same = truth.truth.hard | truth.truth.hard.T
    return Real("", list(truth.queries.paths), same, same, _pairs_before(len(same), 0), gap=0)


def _drone(folder: Path) -> Real:
    with np.load(folder / "overlap.npz") as kept:
        overlap = np.maximum(kept["overlap"], kept["overlap"].T)
    images = list(read_sequence(folder, "tum").paths)
    rule, wide = (overlap >= least for least in OVERLAPS)
    return Real("", images, rule, wide, _pairs_before(len(images), 15), gap=15)


def _tower(folder: Path, floors: Sequence[int], rank: int) -> Real:
    """Make one drive of one walk on each floor, its longest or second longest: other floors are other places."""
    clips: dict[str, dict[str, list[Path]]] = {f"floor{floor}": {} for floor in floors}
    with (folder / "index.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            if row["floor"] in clips:
                clips[row["floor"]].setdefault(row["clip"], []).append(folder / row["image"])
    walks = [sorted(of.values(), key=len, reverse=True)[min(rank, len(of) - 1)] for of in clips.values()]
    walk = np.repeat(np.arange(len(walks)), [len(one) for one in walks])
    never = np.zeros((len(walk), len(walk)), bool)
    return Real("", [path for one in walks for path in one], never, never, walk[:, None] != walk, gap=0)


def _walks(folder: Path) -> Real:
    """Make one drive of a walk through a hallway of each floor of the tower."""
    listed = (folder / "one_walk_each.txt").read_text(encoding="utf-8").split()
    return _without([folder / name for name in listed])


def _without(images: list[Path]) -> Real:
    """Make a drive that never comes back."""
    never = np.zeros((len(images), len(images)), bool)
    return Real("", images, never, never, _pairs_before(len(images), 0), gap=0)


@dataclass(frozen=True)
class Known(GeometricCheck):
    """A check whose images are named by their paths; their pairs are computed once."""

    pairs: Pairs = field(default_factory=lambda: Pairs(lambda path: path))
    names: dict[int, Any] = field(default_factory=dict, hash=False)

    def describe(self, image: Any) -> LocalFeatures:
        """Return something that stands for the points of the image with this path."""
        stands = LocalFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
        self.names[id(stands)] = image  # the detector keeps it
        return stands

    def agreement(self, a: LocalFeatures, b: LocalFeatures) -> Agreement:
        """Return how many points of two images agree."""
        return self.pairs.agreement(GeometricCheck(), self.names[id(a)], self.names[id(b)])


def as_detect(real: Real, rows: np.ndarray, cache: Cache) -> np.ndarray:
    """Return the match of each frame (N,), -1 without an accepted one, as ``detect`` without options decides."""
    scores, stamps = similarity_matrix(rows), np.full(len(rows), np.nan)

    def block(queries: range) -> tuple[np.ndarray, np.ndarray]:
        part = scores[queries.start : queries.stop]
        return part, part

    drive = Drive(len(rows), block, 0, lambda query: Request().possible(query, stamps))
    return _decided(drive, cache, real.images, real.images)


def as_query(real: Real, rows: np.ndarray, cache: Cache) -> np.ndarray:
    """Return the match of each frame (N,) among the two other thirds, -1 without one, as ``map query`` decides."""
    match = np.full(len(rows), -1)
    for number in range(3):
        inside, others = real.third(number)

        def block(queries: range, of: tuple[np.ndarray, np.ndarray] = (inside, others)) -> Any:
            part = rows[of[0]][queries.start : queries.stop]
            return similarity_matrix(part, rows[of[1]]), similarity_matrix(part, rows[of[0]])

        drive = Drive(len(inside), block, None, speeds=speeds_between(len(inside), len(others)))
        queries, references = ([real.images[i] for i in frames] for frames in (inside, others))
        found = _decided(drive, cache, queries, references)
        match[inside] = np.where(found >= 0, others[found], -1)
    return match


def _decided(drive: Drive, cache: Cache, queries: Sequence[Path], references: Sequence[Path]) -> np.ndarray:
    check, pairs = GeometricCheck(), cache.pairs
    _, decision = drive.decided(
        PRECISION,
        check,
        lambda query, reference: pairs.agreement(check, queries[query], references[reference]),
        lambda query, other: pairs.agreement(check, queries[query], queries[other]),
    )
    return np.where(decision.loops, decision.match, -1)


def online(real: Real, rows: np.ndarray, cache: Cache) -> np.ndarray:
    """Return the match of each frame (N,), -1 without one, as ``LoopDetector`` with a geometric check decides."""
    detector = LoopDetector(None, check=Known(pairs=cache.pairs))
    images: list[Any] = [*real.images]  # the check knows images by their paths
    for row, image in zip(rows, images, strict=True):
        detector.add_descriptor(row, image=image)
    match = np.full(len(rows), -1)
    for loop in detector.loops:
        match[loop.query] = loop.match
    return match


def by_orb(real: Real, rows: np.ndarray, cache: Cache) -> np.ndarray:
    """Return the match of each frame (N,), -1 without one: the most similar by ORB words, if enough points agree."""
    words = {"bow.kind": "orb", "bow.model": str(cache.path.with_name(f"orb_{len(real.train)}.npz"))}
    images = Images.of_files(real.images, train=real.train)
    scores = make_method("bow", settings=words).score(images, silent).scores
    scores = np.where(earlier(len(scores), max(real.gap, RECENT)), scores, -np.inf)
    orb, matcher = cv2.ORB.create(1000), cv2.BFMatcher(cv2.NORM_HAMMING)
    points = [orb.detectAndCompute(read_gray(path), None) for path in real.images]  # type: ignore[call-overload]
    match = np.full(len(scores), -1)
    for query, best in enumerate(scores.argmax(axis=1).tolist()):
        if np.isfinite(scores[query, best]) and _agreeing(matcher, points[query], points[best]) >= INLIERS:
            match[query] = best
    return match


def _agreeing(matcher: Any, a: Any, b: Any) -> int:
    """Return how many ORB points of two images agree with one fundamental matrix."""
    if a[1] is None or b[1] is None:
        return 0
    pairs = [pair for pair in matcher.knnMatch(a[1], b[1], k=2) if len(pair) == 2]
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    if len(good) < INLIERS:
        return 0
    ends = (np.array([a[0][m.queryIdx].pt for m in good]), np.array([b[0][m.trainIdx].pt for m in good]))
    _, agree = cv2.findFundamentalMat(*ends, cv2.FM_RANSAC, 3.0, 0.99)
    return 0 if agree is None else int(agree.sum())


HOW = {"detect": as_detect, "map query": as_query, "online": online, "ORB words": by_orb}


def judged(real: Real, match: np.ndarray, how: str) -> dict[str, Any]:
    """Return a row of figures: of the accepted matches that count, how many are right by both rules."""
    count = real.judged & np.tri(len(match), k=-1, dtype=bool) if how != "map query" else real.judged.copy()
    if how == "map query":
        parts = np.arange(len(match)) * 3 // len(match)
        count &= parts[:, None] != parts
    queries = np.flatnonzero(match >= 0)
    queries = queries[count[queries, match[queries]]]
    chosen = real.name.startswith(FIRST)
    row: dict[str, Any] = {"how": how, "drive": real.name, "chosen on": "yes" if chosen else ""}
    row |= {"frames": len(match), "accepted": len(queries)}
    for angle, same in (("15", real.rule), ("45", real.wide)):
        loops = np.any(same & count, axis=1)
        right = int(np.count_nonzero(same[queries, match[queries]]))
        found = right if real.known else None
        row |= {f"with a loop {angle}": int(np.count_nonzero(loops)), f"right {angle}": found}
        row |= {f"recall {angle}": round(right / int(loops.sum()), 3) if loops.any() else None}
    return row


def measure(data: Path, work: Path, only: Sequence[str], say: Callable[[str], None], words: Sequence[str]) -> None:
    """Measure the drives, all or some, and update the figures; ``words`` are the arguments of the command."""
    stored = json.loads(FILE.read_text(encoding="utf-8"))["rows"] if FILE.is_file() else []
    rows = {(row["how"], row["drive"]): row for row in stored}
    for real in drives(data, only):
        cache = Cache(work / "kept" / f"{real.name.replace(': ', '_')}.pickle")
        descriptors = cache.descriptors(real.images)
        for how, decide in HOW.items():
            if how == "map query" and not real.rule.any():
                continue
            row = judged(real, decide(real, descriptors, cache), how)
            say(", ".join(f"{name}: {value}" for name, value in row.items() if value not in ("", None)))
            rows[how, real.name] = row
        cache.save()
        names = list(_drives(data))
        ordered = sorted(rows.values(), key=lambda row: (list(HOW).index(row["how"]), names.index(row["drive"])))
        results.write(FILE, ordered, words)
        results.write(SUMMARY, [summary(ordered, how) for how in HOW], words)


def summary(rows: Sequence[dict[str, Any]], how: str) -> dict[str, Any]:
    """Return on how many drives the matches are precise, and their mean recall, without drives that were chosen on.

    Drives with loops and drives without are counted apart: on the latter nothing may be accepted.
    """
    judges = [row for row in rows if row["how"] == how and not row["chosen on"] and row["right 45"] is not None]
    found: dict[str, Any] = {"how": how}
    for name, some in (
        ("precise drives with loops", [row for row in judges if row["with a loop 45"]]),
        ("drives without loops in which none is accepted", [row for row in judges if not row["with a loop 45"]]),
    ):
        precise = [row["accepted"] - row["right 45"] <= (1 - PRECISION) * row["accepted"] for row in some]
        found[name] = f"{sum(precise)} of {len(precise)}"
    recalls = [row["recall 45"] for row in judges if row["recall 45"] is not None]
    return found | {"mean recall 45": round(float(np.mean(recalls)), 2) if recalls else None}
