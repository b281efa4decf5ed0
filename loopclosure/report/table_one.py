"""The table that compares nets on labeled pairs (the paper's Table I), as text, CSV and pictures.

A run file (JSON) lists the nets. Each entry gives the .npz files with the two descriptors of every training and
validation pair, the names of the arrays in them, and the validation losses during training.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import rankdata

from loopclosure.csv_file import write_csv
from loopclosure.errors import InputError
from netspec.files.arrays import read_npz
from netspec.files.figures import png
from netspec.files.whole_file import write_whole
from netspec.terminal.output import in_columns

# Qiu et al., IEEE IV 2018, Table I. The paper gives neither the threshold nor the recall.
PAPER = (
    ("Siamese (8)", 0.695),
    ("Siamese (128)", 0.820),
    ("Siamese + ResNet (256)", 0.850),
    ("Siamese + ResNet (512)", 0.877),
)
COLUMNS = (
    "net",
    "precision",
    "recall",
    "accuracy",
    "F1",
    "ROC AUC",
    "threshold",
    "ms/image",
    "parameters",
    "iteration",
)


@dataclass(frozen=True)
class Run:
    """The results of one net: distances (N,) and labels (N,) of its validation pairs, metrics and costs.

    ``losses`` are (iteration, validation loss); ``milliseconds`` are per image; ``iteration`` is that of the snapshot.
    """

    name: str
    metrics: PairMetrics
    distances: np.ndarray
    labels: np.ndarray
    losses: tuple[tuple[int, float], ...]
    milliseconds: float
    parameters: int
    iteration: int


def by_net(runs: Sequence[Run]) -> list[list[Run]]:
    """Return the trainings of each net; several have different seeds."""
    nets: dict[str, list[Run]] = {}
    for run in runs:
        nets.setdefault(run.name, []).append(run)
    return list(nets.values())


def _cells(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the row of a net in the order of ``COLUMNS``: the means over its trainings, and what differs in them."""
    fields = ("precision", "recall", "accuracy", "f1", "roc_auc")
    shares = [f"{np.mean([getattr(run.metrics, field) for run in runs]):.3f}" for field in fields]
    each = [(f"{r.metrics.threshold:.4g}", f"{r.milliseconds:.2f}", str(r.parameters), str(r.iteration)) for r in runs]
    return (runs[0].name, *shares, *(", ".join(dict.fromkeys(column)) for column in zip(*each, strict=True)))


def read_runs(path: Path, judged: str = "validation") -> list[Run]:
    """Read a run file and judge its nets: thresholds from the training pairs, metrics from the validation pairs.

    ``judged`` is "test" to judge them on the test pairs instead.

    Raises InputError if a file or an array is missing.
    """
    try:
        entries = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as fault:
        raise InputError(f"cannot read this run file: {fault}", str(path)) from None
    return [_judge(entry, judged) for entry in entries]


def _judge(entry: dict[str, Any], judged: str) -> Run:
    parts = []
    for kind in ("train", judged):
        arrays = read_npz(entry[kind], "the features that netspec extract writes")
        names = (*entry["descriptors"], entry["label"])
        if missing := [name for name in names if name not in arrays]:
            raise InputError(f'no array "{missing[0]}"; it has: {", ".join(arrays)}', entry[kind])
        a, b, label = (arrays[name] for name in names)
        parts.append((pair_distances(a, b), label.reshape(-1) != 0))
        seconds, parameters = float(arrays["seconds_per_record"]), int(arrays["parameters"])
    (train_distances, train_labels), (distances, labels) = parts
    return Run(
        name=entry["name"],
        metrics=metrics_at(best_threshold(train_distances, train_labels), distances, labels),
        distances=distances,
        labels=labels,
        losses=tuple((int(k), float(loss)) for k, loss in entry["losses"]),
        milliseconds=seconds * 1e3 / 2,  # a record is two images
        parameters=parameters,
        iteration=int(entry["iteration"]),
    )


def text_table(runs: Sequence[Run], judged: str = "validation") -> str:
    """Return the table as text, with the paper's precisions below it; ``judged`` as in ``read_runs``."""
    paper = ", ".join(f"{name} {100 * precision:.1f} %" for name, precision in PAPER)
    pairs, nets = f"{len(runs[0].labels)} {judged} pairs" if runs else "no runs", by_net(runs)
    intervals = {net[0].name: ", ".join(f"{name} {text}" for name, text in summary(net).items()) for net in nets}
    return "\n".join(
        [
            *in_columns([COLUMNS, *map(_cells, nets)]),
            "",
            *(f"{name}: {said}; 95 % by bootstrap over pairs" for name, said in intervals.items()),
            f"Judged on {pairs}; threshold of best accuracy on the training pairs; distance: Euclidean.",
            f"The paper's Table I, precision: {paper}.",
        ]
    )


def write_report(runs: Sequence[Run], folder: Path) -> list[Path]:
    """Write ``table.csv``, ``losses.png`` (the paper's Figure 3) and ``distances.png``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("table.csv", "losses.png", "distances.png")]
    write_csv(paths[0], COLUMNS, map(_cells, by_net(runs)))
    write_whole(paths[1], png(_losses(runs)))
    write_whole(paths[2], png(_distances(runs)))
    return paths


def _losses(runs: Sequence[Run]) -> Figure:
    figure = Figure(figsize=(7, 4.2), dpi=120, layout="constrained")
    axes = figure.subplots()
    for run in runs:
        if run.losses:
            line = axes.plot(*zip(*run.losses, strict=True), marker="o", markersize=3, label=run.name)[0]
            chosen = [loss for k, loss in run.losses if k == run.iteration]
            if chosen:
                axes.plot(run.iteration, chosen[0], "o", markersize=9, markerfacecolor="none", color=line.get_color())
    axes.set(
        xlabel="iteration", ylabel="contrastive loss of the validation pairs", title="Validation loss (circle: judged)"
    )
    losses = [loss for run in runs for _, loss in run.losses if math.isfinite(loss) and loss > 0]
    if losses and max(losses) > 10 * min(losses):  # large losses at the start would flatten the rest of the curve
        axes.set_yscale("log")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure


def _distances(runs: Sequence[Run]) -> Figure:
    figure = Figure(figsize=(3.6 * len(runs) + 0.6, 3.4), dpi=120, layout="constrained")
    grid = figure.subplots(1, len(runs), squeeze=False)
    for axes, run in zip(grid[0], runs, strict=True):
        edges = np.histogram_bin_edges(run.distances, 40)
        axes.hist(run.distances[run.labels], edges, alpha=0.65, color="tab:green", label="same place")
        axes.hist(run.distances[~run.labels], edges, alpha=0.55, color="tab:red", label="other place")
        axes.axvline(run.metrics.threshold, color="black", linestyle="--", linewidth=1, label="threshold")
        axes.set(xlabel="distance of the pair", title=f"{run.name}: AUC {run.metrics.roc_auc:.3f}")
        axes.title.set_fontsize(10)
    grid[0][0].set_ylabel("validation pairs")
    grid[0][0].legend(fontsize=8)
    return figure


@dataclass(frozen=True)
class PairMetrics:
    """The metrics of a set of pairs at one threshold: a pair is called the same place if its distance < threshold.

    Shares are in 0..1; a share with denominator 0 (precision if no pair is called the same) is NaN.
    """

    threshold: float
    precision: float
    recall: float
    accuracy: float
    f1: float
    roc_auc: float


def pair_distances(features_a: np.ndarray, features_b: np.ndarray) -> np.ndarray:
    """Return the Euclidean distance, which ContrastiveLoss trains, of each row to the same row of ``features_b``.

    features_a, features_b   (N, D); further axes are flattened
    returns                  (N,) float64
    """
    a = np.asarray(features_a, dtype=np.float64)
    b = np.asarray(features_b, dtype=np.float64)
    if a.shape != b.shape or a.ndim < 2:
        raise InputError(f"the two features of a pair differ in shape: {a.shape} and {b.shape}; expected (N, D) twice")
    return np.linalg.norm((a - b).reshape(len(a), -1), axis=1)


def best_threshold(distances: np.ndarray, labels: np.ndarray) -> float:
    """Return the threshold with the best accuracy on these pairs.

    It is halfway between two neighboring distances. The smallest of equally good thresholds is returned: a false
    loop harms a map more than a missed one. It is the smallest distance if calling no pair the same place is best.

    distances   (N,); labels   (N,) 1 or True = same place
    """
    distances, same = _checked(distances, labels)
    order = np.argsort(distances, kind="stable")
    ordered, positive = distances[order], same[order]
    # correct[k]: number of pairs judged correctly if exactly the k nearest are called the same place
    correct = np.concatenate([[0], np.cumsum(np.where(positive, 1, -1))]) + np.count_nonzero(~same)
    cuttable = np.concatenate([[True], ordered[1:] > ordered[:-1], [True]])
    best = int(np.argmax(np.where(cuttable, correct, -1)))
    if best == 0:
        return float(ordered[0])
    if best == len(ordered):
        return float(np.nextafter(ordered[-1], np.inf))
    below, above = float(ordered[best - 1]), float(ordered[best])
    middle = below + (above - below) / 2
    return middle if middle > below else above


def roc_auc(distances: np.ndarray, labels: np.ndarray) -> float:
    """Return the probability that a pair of one place is nearer than a pair of two places (ties count half).

    NaN if all pairs are of one kind.
    """
    distances, same = _checked(distances, labels)
    positives = int(np.count_nonzero(same))
    negatives = len(same) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    rank_sum = float(np.sum(rankdata(-distances)[same]))
    return (rank_sum - positives * (positives + 1) / 2) / (positives * negatives)


def metrics_at(threshold: float, distances: np.ndarray, labels: np.ndarray) -> PairMetrics:
    """Return the metrics of these pairs at a given threshold: distances (N,); labels (N,) 1 or True = same place."""
    distances, same = _checked(distances, labels)
    called = distances < threshold
    tp = int(np.count_nonzero(called & same))
    fp = int(np.count_nonzero(called & ~same))
    fn = int(np.count_nonzero(~called & same))
    tn = int(np.count_nonzero(~called & ~same))
    return PairMetrics(
        threshold=float(threshold),
        precision=_share(tp, tp + fp),
        recall=_share(tp, tp + fn),
        accuracy=_share(tp + tn, len(same)),
        f1=_share(2 * tp, 2 * tp + fp + fn),
        roc_auc=roc_auc(distances, same),
    )


def summary(runs: Sequence[Run], draws: int = 1000, seed: int = 0) -> dict[str, str]:
    """Return the means of precision, recall and ROC AUC over runs of one net with several seeds, as text.

    Each has an interval that contains 95 % of the means, by bootstrap over the judged pairs, the same ones in all runs.
    """
    rng = np.random.default_rng(seed)
    fields = {"precision": "precision", "recall": "recall", "ROC AUC": "roc_auc"}

    def means(drawn: np.ndarray) -> list[float]:
        found = [metrics_at(run.metrics.threshold, run.distances[drawn], run.labels[drawn]) for run in runs]
        return [float(np.mean([getattr(metrics, field) for metrics in found])) for field in fields.values()]

    count = len(runs[0].labels)
    ends = np.nanquantile([means(rng.integers(0, count, count)) for _ in range(draws)], [0.025, 0.975], axis=0)
    rows = zip(fields, means(np.arange(count)), *ends, strict=True)
    return {name: f"{mean:.3f} ({low:.3f} to {high:.3f})" for name, mean, low, high in rows}


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _checked(distances: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances as float64 and labels as bool, both (N,), N > 0."""
    distances = np.asarray(distances, dtype=np.float64).reshape(-1)
    labels = np.asarray(labels).reshape(-1)
    if len(distances) != len(labels):
        raise InputError(f"{len(distances)} distances but {len(labels)} labels; expected one label per pair")
    if len(distances) == 0:
        raise InputError("there are no pairs to judge")
    if not np.all(np.isfinite(distances)):
        count = int(np.count_nonzero(~np.isfinite(distances)))
        raise InputError(f"{count} of {len(distances)} distances are NaN or infinite; did the training diverge?")
    if not np.all(np.isin(labels, (0, 1))):
        odd = labels[~np.isin(labels, (0, 1))][0]
        raise InputError(f"a label is {odd}; expected 1 (same place) or 0 (other place)")
    return distances, labels.astype(bool)
