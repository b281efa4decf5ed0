"""Makes list files from a source of pairs: splits, chooses, writes, and reports the chosen pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lmdb_build.pairs.choose import (
    LABEL_WORDS,
    NEGATIVE,
    POSITIVE,
    SPLITS,
    Indices,
    Pairs,
    PairSource,
    choose_pairs,
    split_by_group,
    split_by_time,
)
from lmdb_build.pairs.list_file import ROOT_FOLDER, write_pair_list
from loopclosure.errors import InputError
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
    """

    counts: Mapping[str, int]
    seed: int = 1
    by: str = "time"
    shares: Mapping[str, float] = field(default_factory=lambda: dict(zip(SPLITS, (0.6, 0.2, 0.2), strict=True)))
    split_gap: float = 0.0
    named: Mapping[str, list[str]] = field(default_factory=dict)
    at_most: bool = False

    def check(self) -> None:
        """Raise InputError for values out of range."""
        for split, count in self.counts.items():
            if count < 0 or count % 2:
                raise InputError(
                    f"--{split}: half of the pairs are positive, so their number must be even, not {count}"
                )
        if not any(self.counts.values()):
            raise InputError("no pairs are asked for; give --train, --val or --test a number")
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


def build_lists(source: PairSource, plan: Plan, root: Path, out: Path) -> dict[str, Written]:
    """Write ``out``/train.txt, val.txt and test.txt by ``plan``; return the lists.

    Raises InputError, before anything is written, if a split does not have enough pairs.
    """
    plan.check()
    splits = []
    for name, images in split_images(source, plan).items():
        stream = _stream(plan.seed, name)
        splits.append(Split(name, images, choose_pairs(source, images, plan.counts[name], stream, name, plan.at_most)))
    lists = {}
    for split in splits:
        pairs = split.pairs
        doubts = source.warnings(pairs.first, pairs.second, pairs.labels)
        path = out / f"{split.name}.txt"
        firsts, seconds = ([source.names[index] for index in side] for side in (pairs.first, pairs.second))
        listed = zip(firsts, seconds, pairs.labels.tolist(), strict=True)
        write_pair_list(path, listed, _head(source, plan, split, root, out))
        lists[split.name] = Written(path, report(source, split), [f"{split.name}: {doubt}" for doubt in doubts])
    return lists


def split_images(source: PairSource, plan: Plan) -> dict[str, Indices]:
    """Return the images of each split that gets pairs; no image is in two splits."""
    shares = {split: plan.shares[split] for split in SPLITS if plan.counts.get(split)}
    if plan.by == "time":
        return split_by_time(source, shares, plan.split_gap)
    return split_by_group(source, shares, plan.seed, plan.named)


def _stream(seed: int, split: str) -> np.random.Generator:
    return np.random.default_rng([seed, 1 + SPLITS.index(split)])


def _head(source: PairSource, plan: Plan, split: Split, root: Path, out: Path) -> dict[str, str]:
    """Return the settings for the list's header, with which the list can be made again."""
    cut = f"time, {plan.split_gap:g} between splits" if plan.by == "time" else source.group_word
    shares = ", ".join(f"{name} {plan.shares[name]:g}" for name in SPLITS if plan.counts.get(name))
    head = dict(source.settings)
    head[ROOT_FOLDER] = relative(root.resolve(), out.resolve())
    head["split"] = f"{split.name}, by {cut}; shares: {shares}; {len(split.images)} images"
    head["pairs"] = "; ".join(f"{kind}: {number}" for kind, number in kinds(source, split.pairs).items())
    head["seed"] = str(plan.seed)
    return head


QUANTILES = (0, 5, 50, 95, 100)


def report(source: PairSource, split: Split) -> str:
    """Return a split's report: counts of each kind, then quantiles of each measure."""
    pairs = split.pairs
    used = len(np.unique(np.concatenate([pairs.first, pairs.second])))
    lines = [f"{split.name}: {len(pairs)} pairs of {len(split.images)} images, {used} of them used"]
    lines += [f"  {kind:<44}{number:>8}" for kind, number in kinds(source, pairs).items()]
    for name, values in source.measures(pairs.first, pairs.second).items():
        known = {label: values[(pairs.labels == label) & np.isfinite(values)] for label in (POSITIVE, NEGATIVE)}
        if any(len(part) for part in known.values()):
            lines.append(f"  {name:<16}" + "".join(f"{_quantile_name(quantile):>9}" for quantile in QUANTILES))
        for label, part in known.items():
            if len(part):
                figures = "".join(f"{value:9.3g}" for value in np.percentile(part, QUANTILES))
                lines.append(f"    {LABEL_WORDS[label]:<14}{figures}")
    return "\n".join(lines)


def kinds(source: PairSource, pairs: Pairs) -> dict[str, int]:
    """Count the pairs of each kind: label, within a group or across two."""
    same = source.groups[pairs.first] == source.groups[pairs.second]
    counts = {}
    for label in (POSITIVE, NEGATIVE):
        for within, where in ((True, f"same {source.group_word}"), (False, f"other {source.group_word}")):
            number = int(np.sum((pairs.labels == label) & (same == within)))
            if number:
                counts[f"{LABEL_WORDS[label]}, {where}"] = number
    return counts


def _quantile_name(quantile: int) -> str:
    return {0: "least", 50: "median", 100: "most"}.get(quantile, f"{quantile} %")
