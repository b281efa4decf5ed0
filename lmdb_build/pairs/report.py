"""The report of the chosen pairs: how many of each kind, and the distributions of their measures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.choose import LABEL_WORDS, NEGATIVE, POSITIVE, Pairs, PairSource

BINS = 24
BARS = " ▁▂▃▄▅▆▇█"
QUANTILES = (0, 5, 50, 95, 100)


def report(source: PairSource, pairs: Pairs, split: str, images: int) -> str:
    """Return a split's report: counts of each kind, then quantiles and a histogram of each measure."""
    used = len(np.unique(np.concatenate([pairs.first, pairs.second])))
    lines = [f"{split}: {len(pairs)} pairs of {images} images, {used} of them used"]
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
