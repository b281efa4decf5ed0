"""Makes list files from a source of pairs: splits, chooses, warps, writes, and reports the chosen pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.choose import (
    LABEL_WORDS,
    NEGATIVE,
    POSITIVE,
    SPLITS,
    Indices,
    Pairs,
    PairSource,
    Wanted,
    choose_pairs,
    hard_negatives,
    split_by_group,
    split_by_time,
)
from lmdb_build.pairs.list_file import ROOT_FOLDER, write_pair_list
from lmdb_build.picture import write_warped
from loopclosure.descriptors.feature_file import Features
from loopclosure.errors import InputError
from loopclosure.progress import Progress, silent
from netspec.files.paths import relative


@dataclass(frozen=True)
class Plan:
    """The lists to make from a source.

    counts       number of pairs per split; a split with 0 pairs gets no images
    by           split the images by "time" or by "group"
    shares       share of the images (or groups) for each split
    split_gap    minimum gap in time between two splits
    named        names of the groups of each split
    at_most      if there are too few pairs, use all of them instead of raising an error
    features     descriptors for choosing hard negatives
    hard_share   share of the negatives that are the nearest by ``features``
    warp_share   share of all pairs with a warped image
    """

    counts: Mapping[str, int]
    seed: int = 1
    by: str = "time"
    shares: Mapping[str, float] = field(default_factory=lambda: dict(zip(SPLITS, (0.6, 0.2, 0.2), strict=True)))
    split_gap: float = 0.0
    named: Mapping[str, list[str]] = field(default_factory=dict)
    at_most: bool = False
    features: Features | None = None
    hard_share: float = 0.5
    warp_share: float = 0.0

    def check(self) -> None:
        """Raise InputError for values out of range."""
        for split, count in self.counts.items():
            if count < 0 or count % 2:
                raise InputError(
                    f"--{split}: half of the pairs are positive, so their number must be even, not {count}"
                )
        if not any(self.counts.values()):
            raise InputError("no pairs are asked for; give --train, --val or --test a number")
        for name in ("hard_share", "warp_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"--{name.replace('_', '-')} must be 0 to 1, not {getattr(self, name)}")
        if self.seed < 0:
            raise InputError(f"a seed must be 0 or more, not {self.seed}")
        for split, share in self.shares.items():
            if share < 0 or (self.counts.get(split) and not share):
                raise InputError(f"the share of {split} is {share:g}; expected a number above 0")


@dataclass(frozen=True)
class Split:
    """The images of a split, and the pairs chosen among them."""

    name: str
    images: Indices
    pairs: Pairs


@dataclass(frozen=True)
class Written:
    """A written list: its file, a report (:func:`report`), and doubts about its labels."""

    path: Path
    report: str
    doubts: list[str]


def build_lists(
    source: PairSource, plan: Plan, root: Path, out: Path, progress: Progress = silent
) -> dict[str, Written]:
    """Write ``out``/train.txt, val.txt and test.txt by ``plan``, and warped images below ``out``; return the lists.

    Raises InputError, before anything is written, if a split does not have enough pairs.
    """
    plan.check()
    splits = []
    for name, images in split_images(source, plan).items():
        hard = None
        if plan.features is not None and len(images):
            rows = plan.features.rows_of([Path(source.names[image]) for image in images])
            hard = hard_negatives(source, images, rows, round(plan.counts[name] // 2 * plan.hard_share))
        wanted = Wanted(plan.counts[name], plan.at_most, plan.warp_share, hard)
        splits.append(Split(name, images, choose_pairs(source, images, wanted, _stream(plan.seed, name), name)))
    lists = {}
    for split in splits:
        pairs, plain = split.pairs, ~split.pairs.warped
        doubts = source.warnings(pairs.first[plain], pairs.second[plain], pairs.labels[plain])
        seconds = _write_warped(source, split, plan.seed, root, out, progress)
        path = out / f"{split.name}.txt"
        listed = zip((source.names[index] for index in pairs.first), seconds, pairs.labels.tolist(), strict=True)
        write_pair_list(path, listed, _head(source, plan, split, root, out))
        lists[split.name] = Written(path, report(source, split), [f"{split.name}: {doubt}" for doubt in doubts])
    return lists


def split_images(source: PairSource, plan: Plan) -> dict[str, Indices]:
    """Return the images of each split that gets pairs; no image is in two splits."""
    shares = {split: plan.shares[split] for split in SPLITS if plan.counts.get(split)}
    if plan.by == "time":
        return split_by_time(source, shares, plan.split_gap)
    return split_by_group(source, shares, plan.seed, plan.named)


def _stream(seed: int, split: str, *more: int) -> np.random.Generator:
    return np.random.default_rng([seed, 1 + SPLITS.index(split), *more])


def _write_warped(source: PairSource, split: Split, seed: int, root: Path, out: Path, progress: Progress) -> list[str]:
    """Write the warped images, if any; return the names of the second images, with those of the warped images."""
    pairs = split.pairs
    names = [source.names[index] for index in pairs.second]
    if not pairs.warped.any():
        return names
    folder = _below(out / f"{split.name}_warped", root)
    for number in progress(np.flatnonzero(pairs.warped), f"{split.name}: warping"):
        original = PurePosixPath(names[number])
        names[number] = f"{folder}/{number:06d}_{original.name}"
        write_warped(root / original, root / names[number], _stream(seed, split.name, 1, int(number)))
    return names


def _below(path: Path, root: Path) -> str:
    try:
        return path.resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        raise InputError(f"warped images must be below the root folder {root}; give another --root", path) from None


def _head(source: PairSource, plan: Plan, split: Split, root: Path, out: Path) -> dict[str, str]:
    """Return the settings for the list's header, with which the list can be made again."""
    cut = f"time, {plan.split_gap:g} between splits" if plan.by == "time" else source.group_word
    shares = ", ".join(f"{name} {plan.shares[name]:g}" for name in SPLITS if plan.counts.get(name))
    head = dict(source.settings)
    head[ROOT_FOLDER] = relative(root.resolve(), out.resolve())
    head["split"] = f"{split.name}, by {cut}; shares: {shares}; {len(split.images)} images"
    if plan.features is not None:
        head["hard negatives"] = f"{plan.hard_share:g} of the negatives, by {plan.features.path.name}"
    if plan.warp_share:
        head["warped"] = f"{plan.warp_share:g} of the pairs"
    head["pairs"] = "; ".join(f"{kind}: {number}" for kind, number in kinds(source, split.pairs).items())
    head["seed"] = str(plan.seed)
    return head


BINS = 24
BARS = " ▁▂▃▄▅▆▇█"
QUANTILES = (0, 5, 50, 95, 100)


def report(source: PairSource, split: Split) -> str:
    """Return a split's report: counts of each kind, then quantiles and a histogram of each measure."""
    pairs = split.pairs
    used = len(np.unique(np.concatenate([pairs.first, pairs.second])))
    lines = [f"{split.name}: {len(pairs)} pairs of {len(split.images)} images, {used} of them used"]
    lines += [f"  {kind:<44}{number:>8}" for kind, number in kinds(source, pairs).items()]
    plain = ~pairs.warped
    first, second, labels = pairs.first[plain], pairs.second[plain], pairs.labels[plain]
    for name, values in source.measures(first, second).items():
        known = {label: values[(labels == label) & np.isfinite(values)] for label in (POSITIVE, NEGATIVE)}
        if any(len(part) for part in known.values()):
            lines += _distribution(name, known)
    return "\n".join(lines)


def kinds(source: PairSource, pairs: Pairs) -> dict[str, int]:
    """Count the pairs of each kind: label, within a group or across two, warped or not."""
    same = source.groups[pairs.first] == source.groups[pairs.second]
    counts = {}
    for label in (POSITIVE, NEGATIVE):
        for within, where in ((True, f"same {source.group_word}"), (False, f"other {source.group_word}")):
            for warped, how in ((False, ""), (True, ", one image warped")):
                number = int(np.sum((pairs.labels == label) & (same == within) & (pairs.warped == warped)))
                if number:
                    counts[f"{LABEL_WORDS[label]}, {where}{how}"] = number
    return counts


def _distribution(name: str, known: dict[int, NDArray[np.float64]]) -> list[str]:
    """Return three lines: a header, and for both labels quantiles and a histogram over one range."""
    edges = np.histogram_bin_edges(np.concatenate(list(known.values())), BINS)
    head = "".join(f"{_quantile_name(quantile):>9}" for quantile in QUANTILES)
    lines = [f"  {name:<16}{head}   {edges[0]:.3g} {'to':^{BINS - 8}} {edges[-1]:.3g}"]
    for label, values in known.items():
        if len(values):
            figures = "".join(f"{value:9.3g}" for value in np.percentile(values, QUANTILES))
            counts = np.histogram(values, edges)[0]
            heights = np.ceil(counts / counts.max() * (len(BARS) - 1)).astype(int)
            bars = "".join(BARS[height] for height in heights)
            lines.append(f"    {LABEL_WORDS[label]:<14}{figures}   {bars}".rstrip())
    return lines


def _quantile_name(quantile: int) -> str:
    return {0: "least", 50: "median", 100: "most"}.get(quantile, f"{quantile} %")
