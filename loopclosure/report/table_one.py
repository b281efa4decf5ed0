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

from loopclosure.errors import InputError
from loopclosure.report.pair_metrics import PairMetrics, judge_pairs, pair_distances
from netspec.files.whole_file import whole_file, write_csv
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

    ``losses`` are (iteration, validation loss); ``milliseconds`` are per image; ``iteration`` is the judged snapshot's.
    """

    name: str
    metrics: PairMetrics
    distances: np.ndarray
    labels: np.ndarray
    losses: tuple[tuple[int, float], ...]
    milliseconds: float
    parameters: int
    iteration: int

    def cells(self) -> tuple[str, ...]:
        """Return the row of the table, as ``COLUMNS`` names it."""
        m = self.metrics
        shares = (m.precision, m.recall, m.accuracy, m.f1, m.roc_auc)
        figures = (f"{m.threshold:.4g}", f"{self.milliseconds:.2f}", str(self.parameters), str(self.iteration))
        return (self.name, *(f"{share:.3f}" for share in shares), *figures)


def read_runs(path: Path) -> list[Run]:
    """Read a run file and judge each of its nets: threshold from the training pairs, metrics of the validation pairs.

    Raises InputError if a file or an array is missing.
    """
    try:
        entries = json.loads(path.read_text())
    except (OSError, ValueError) as fault:
        raise InputError(f"cannot read this run file: {fault}", str(path)) from None
    return [_judge(entry) for entry in entries]


def _judge(entry: dict[str, Any]) -> Run:
    parts = []
    for kind in ("train", "validation"):
        with _open(entry[kind]) as arrays:
            a, b, label = (_array(arrays, name, entry[kind]) for name in (*entry["descriptors"], entry["label"]))
            parts.append((pair_distances(a, b), label.reshape(-1) != 0))
            seconds, parameters = float(arrays["seconds_per_record"]), int(arrays["parameters"])
    (train_distances, train_labels), (distances, labels) = parts
    return Run(
        name=entry["name"],
        metrics=judge_pairs(train_distances, train_labels, distances, labels),
        distances=distances,
        labels=labels,
        losses=tuple((int(k), float(loss)) for k, loss in entry["losses"]),
        milliseconds=seconds * 1e3 / 2,  # a record is two images
        parameters=parameters,
        iteration=int(entry["iteration"]),
    )


def _open(path: str) -> Any:
    try:
        return np.load(path)
    except (OSError, ValueError) as fault:
        raise InputError(f"cannot read these features: {fault}", path) from None


def _array(arrays: Any, name: str, path: str) -> np.ndarray:
    if name not in arrays:
        raise InputError(f'no array "{name}"; it has: {", ".join(arrays.files)}', path)
    return arrays[name]


def text_table(runs: Sequence[Run]) -> str:
    """Return the table as text, with the paper's precisions below it."""
    paper = ", ".join(f"{name} {100 * precision:.1f} %" for name, precision in PAPER)
    pairs = f"{runs[0].metrics.pairs} validation pairs" if runs else "no runs"
    return "\n".join(
        [
            *in_columns([COLUMNS, *(run.cells() for run in runs)]),
            "",
            f"Judged on {pairs}; threshold of best accuracy on the training pairs; distance: Euclidean.",
            f"The paper's Table I, precision: {paper}.",
        ]
    )


def write_report(runs: Sequence[Run], folder: Path) -> list[Path]:
    """Write ``table.csv``, ``losses.png`` (the paper's Figure 3) and ``distances.png``; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("table.csv", "losses.png", "distances.png")]
    write_csv(paths[0], COLUMNS, (run.cells() for run in runs))
    _draw_losses(runs, paths[1])
    _draw_distances(runs, paths[2])
    return paths


def _draw_losses(runs: Sequence[Run], path: Path) -> None:
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for run in runs:
        if run.losses:
            line = axes.plot(*zip(*run.losses, strict=True), marker="o", markersize=3, label=run.name)[0]
            chosen = [loss for k, loss in run.losses if k == run.iteration]
            if chosen:
                axes.plot(run.iteration, chosen[0], "o", markersize=9, markerfacecolor="none", color=line.get_color())
    axes.set(
        xlabel="iteration",
        ylabel="contrastive loss of the validation pairs",
        title="Validation loss (circle: judged)",
    )
    losses = [loss for run in runs for _, loss in run.losses if math.isfinite(loss) and loss > 0]
    if losses and max(losses) > 10 * min(losses):  # a diverging start would flatten all that follows
        axes.set_yscale("log")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=120, format="png")


def _draw_distances(runs: Sequence[Run], path: Path) -> None:
    figure = Figure(figsize=(3.6 * len(runs) + 0.6, 3.4), layout="constrained")
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
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=120, format="png")
