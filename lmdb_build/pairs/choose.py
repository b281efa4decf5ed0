"""Chooses balanced pairs of images at random: assigns images to splits, and draws pairs within each split.

The source decides what makes a pair positive or negative (:mod:`lmdb_build.pairs.by_list`). All random draws follow
from the seed, and each split has its own random numbers, so that more pairs in one split do not change the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopclosure.errors import InputError

POSITIVE, NEGATIVE, LEFT_OUT = 1, 0, -1
SPLITS = ("train", "val", "test")
LABEL_WORDS = {POSITIVE: "positive", NEGATIVE: "negative"}

Indices = NDArray[np.intp]

# Up to this many possible pairs, all pairs are labeled. With more, pairs are drawn at random until there are enough.
ALL_PAIRS = 4_000_000
DRAWN_AT_ONCE = 1 << 18


class PairSource:
    """M images and the labels of their pairs; image i is the file ``names[i]`` below the root folder.

    tracks       (M,) the run of the camera that an image is from; along a run, ``stamps`` ascend
    stamps       (M,) the time of an image, or its position in the run
    groups       (M,) the group of an image (a sequence, a place, a floor), which a split by group does not divide
    group_names  names of the groups
    group_word   the word for a group in messages
    settings     settings of the source for the list's header
    """

    names: list[str]
    tracks: Indices
    stamps: NDArray[np.float64]
    groups: Indices
    group_names: list[str]
    group_word = "run"
    settings: dict[str, str]

    def judge(self, first: Indices, second: Indices) -> NDArray[np.int8]:
        """Label pairs (N,) POSITIVE, NEGATIVE or LEFT_OUT."""
        raise NotImplementedError

    def positives(self) -> Indices | None:
        """All positive pairs (K, 2), if the source has a list of them; None if they have to be searched."""
        return None

    def measures(self, first: Indices, second: Indices) -> dict[str, NDArray[np.float64]]:
        """Quantities of pairs (N,) by name and unit, NaN if undefined for a pair: for the report."""
        return {}

    def warnings(self, first: Indices, second: Indices, labels: NDArray) -> list[str]:
        """Return warnings about the labels of these chosen pairs."""
        return []


@dataclass(frozen=True)
class Pairs:
    """Chosen pairs, in the order of the list: image indices (N,) and labels (N,), 1 for the same place."""

    first: Indices
    second: Indices
    labels: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.labels)


def split_by_time(source: PairSource, shares: Mapping[str, float], gap: float = 0.0) -> dict[str, Indices]:
    """Cut each run into one part per split, with its share of the images; return the images of each split.

    ``gap`` is the minimum difference of stamps between two splits. Images right after a cut are left out, because
    neighbors in time show the same scene.
    """
    total = sum(shares.values())
    taken: dict[str, list[Indices]] = {split: [] for split in shares}
    for track in np.unique(source.tracks):
        images = np.flatnonzero(source.tracks == track)
        images = images[np.argsort(source.stamps[images], kind="stable")]
        stamps = source.stamps[images]
        begin, done = -np.inf, 0.0
        for split, share in shares.items():
            done += share
            rank = round(done / total * len(images))
            end = stamps[rank] if rank < len(images) else np.inf
            taken[split].append(images[(stamps >= begin) & (stamps < end)])
            begin = end + gap
    return {split: np.sort(np.concatenate(parts)) for split, parts in taken.items()}


def split_by_group(
    source: PairSource, shares: Mapping[str, float], seed: int, named: Mapping[str, list[str]] | None = None
) -> dict[str, Indices]:
    """Assign whole groups to splits; return the images of each split.

    ``named`` lists the groups of each split. One split may be missing; it gets the remaining groups. Groups of a split
    that is not in ``shares`` are not used. Without ``named``, groups are drawn at random until each split has its
    share of the groups, and at least one.
    Raises InputError for an unknown group, one named twice, or fewer groups than splits.
    """
    word, count = source.group_word, len(source.group_names)
    owner = np.full(count, -1)
    splits = list(shares)
    if named:
        rest = [split for split in splits if split not in named]
        if len(rest) > 1:
            raise InputError(f"name the {word}s of all splits but one; not named: {', '.join(rest)}")
        for split, names in named.items():
            for name in names:
                if name not in source.group_names:
                    raise InputError(f'no {word} has the name "{name}"; there are: {", ".join(source.group_names)}')
                index = source.group_names.index(name)
                if owner[index] >= 0:
                    raise InputError(f'{word} "{name}" is named for two splits')
                owner[index] = splits.index(split) if split in splits else len(splits)
        if rest:
            owner[owner < 0] = splits.index(rest[0])
    else:
        if count < len(splits):
            groups = word if count == 1 else f"{word}s"
            raise InputError(
                f"{count} {groups} cannot be split by {word} into {' and '.join(splits)}: "
                f"give more {word}s, split by time, or use fewer splits"
            )
        order = np.random.default_rng([seed, 0]).permutation(count)
        edges = np.round(np.cumsum(list(shares.values())) / sum(shares.values()) * count).astype(int)
        for number in range(len(edges)):  # at least one group for each split
            least = edges[number - 1] + 1 if number else 1
            edges[number] = np.clip(edges[number], least, count - len(edges) + 1 + number)
        for number, part in enumerate(np.split(order, edges[:-1])):
            owner[part] = number
    return {split: np.flatnonzero(owner[source.groups] == number) for number, split in enumerate(splits)}


def choose_pairs(
    source: PairSource, images: Indices, count: int, rng: np.random.Generator, split: str, at_most: bool = False
) -> Pairs:
    """Choose ``count`` different pairs among ``images``, half of them positive, in shuffled order.

    Each half is drawn uniformly from all pairs of its label. With ``at_most``, there are fewer if there are not enough.
    Otherwise that raises InputError, which names the ``split``.
    """
    half = count // 2
    found = find_pairs(source, images, {POSITIVE: half, NEGATIVE: half}, rng)
    available = {label: len(found[label]) for label in (POSITIVE, NEGATIVE)}
    half = _enough_pairs(available, half, len(images), split, at_most)
    pairs = np.concatenate([found[POSITIVE][:half], found[NEGATIVE][:half]])
    labels = np.repeat([POSITIVE, NEGATIVE], half).astype(np.uint8)
    order = rng.permutation(len(pairs))  # Caffe's Data layer reads a database in its order
    return Pairs(pairs[order, 0], pairs[order, 1], labels[order])


def _enough_pairs(available: Mapping[int, int], half: int, images: int, split: str, at_most: bool) -> int:
    """Return how many pairs of each label can be taken: ``half``, or with ``at_most`` fewer if there are fewer."""
    least = min(available.values())
    if least >= half:
        return half
    if least == 0 or not at_most:
        counts = " and ".join(f"{available[label]} {LABEL_WORDS[label]}" for label in available)
        lacking = next(LABEL_WORDS[label] for label in available if available[label] == least)
        remedy = f"ask for {2 * least}, or give --at-most" if least else f"it has no {lacking} pair at all"
        raise InputError(
            f"{split}: {2 * half} pairs need {half} of each label, but its {images} images have only {counts} pairs; "
            f"{remedy}"
        )
    return least


def find_pairs(
    source: PairSource, images: Indices, wanted: Mapping[int, int], rng: np.random.Generator
) -> dict[int, Indices]:
    """Draw up to ``wanted[label]`` different pairs (n, 2) of each label among ``images``, uniformly, in random order.

    If there are fewer pairs, all of them are returned.
    """
    found = {label: np.zeros((0, 2), np.intp) for label, number in wanted.items() if not number}
    listed = None if POSITIVE in found else source.positives()
    if listed is not None:
        inside = listed[np.isin(listed, images).all(axis=1)]
        inside = inside[source.judge(inside[:, 0], inside[:, 1]) == POSITIVE]
        found[POSITIVE] = _drawn(inside, wanted[POSITIVE], rng)
    open_labels = {label: number for label, number in wanted.items() if label not in found}
    possible = len(images) * (len(images) - 1) // 2
    if possible > ALL_PAIRS:
        drawn = _draw_and_judge(source, images, open_labels, rng, possible // 4)
        found |= {label: pairs for label, pairs in drawn.items() if len(pairs) == open_labels[label]}
        open_labels = {label: number for label, number in open_labels.items() if label not in found}
    if open_labels:
        found |= {
            label: _drawn(pairs, wanted[label], rng)
            for label, pairs in _all_pairs(source, images, tuple(open_labels)).items()
        }
    return found


def _drawn(pairs: Indices, wanted: int, rng: np.random.Generator) -> Indices:
    return pairs[rng.permutation(len(pairs))[:wanted]]


def _all_pairs(source: PairSource, images: Indices, labels: tuple[int, ...]) -> dict[int, Indices]:
    """Label every pair of ``images``, by blocks; return the pairs of each label (n, 2), the smaller index first."""
    parts: dict[int, list[Indices]] = {label: [] for label in labels}
    height = max(1, DRAWN_AT_ONCE // max(1, len(images)))
    for start in range(0, len(images), height):
        rows = np.arange(start, min(start + height, len(images)))
        first, second = np.nonzero(np.arange(len(images))[None] > rows[:, None])
        first, second = images[first + start], images[second]
        judged = source.judge(first, second)
        for label in labels:
            chosen = judged == label
            parts[label].append(np.column_stack([first[chosen], second[chosen]]))
    empty = np.zeros((0, 2), np.intp)
    return {label: np.concatenate([empty, *blocks]) for label, blocks in parts.items()}


def _draw_and_judge(
    source: PairSource, images: Indices, wanted: Mapping[int, int], rng: np.random.Generator, budget: int
) -> dict[int, Indices]:
    """Draw pairs uniformly and keep those of the wanted labels, until there are enough or ``budget`` were drawn."""
    count = len(images)
    codes: dict[int, Indices] = {label: np.zeros(0, np.intp) for label in wanted}
    for _ in range(0, budget, DRAWN_AT_ONCE):
        short = [label for label, number in wanted.items() if len(codes[label]) < number]
        if not short:
            break
        drawn = np.sort(rng.integers(0, count, (DRAWN_AT_ONCE, 2)), axis=1)
        drawn = drawn[drawn[:, 0] < drawn[:, 1]]
        judged = source.judge(images[drawn[:, 0]], images[drawn[:, 1]])
        for label in short:
            fresh = np.concatenate([codes[label], drawn[judged == label] @ np.array([count, 1])])
            _, at = np.unique(fresh, return_index=True)
            codes[label] = fresh[np.sort(at)][: wanted[label]]
    return {label: images[np.column_stack(np.divmod(code, count))] for label, code in codes.items()}
