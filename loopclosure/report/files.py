"""The results of an evaluation as JSON and as text; both state their conventions and the exclusion."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.evaluation import RECALL_AT, WIDE, Evaluation, Outcome
from loopclosure.places.truth import Truth
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH, PrecisionRecall
from netspec.files.whole_file import write_whole
from netspec.terminal.output import in_columns

# The largest number of points of a curve in report.json.
POINTS = 400
# The measures by the wide angle in tables.
WIDE_MEASURES = ("average precision", "recall at 100 % precision")

EXPLANATION = {
    ALL_PAIRS: "every judged pair of frames is a sample",
    BEST_MATCH: "only the best reference of each query counts; recall: share of queries with a loop and a right match",
}


def write_json(evaluation: Evaluation, path: Path, command: str = "") -> None:
    """Write the whole evaluation, as :func:`summary` returns it."""
    text = json.dumps(summary(evaluation, command), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(path, text + "\n", "backslashreplace")


def summary(evaluation: Evaluation, command: str = "") -> dict[str, Any]:
    """Return the whole evaluation as JSON values; an undefined measure is null."""
    data, truth = evaluation.data, evaluation.data.truth
    return {
        "data_set": data.name,
        **_counted(truth, "truth_and_exclusion"),
        "wide_angle": None if data.wide is None else _counted(data.wide, "truth"),
        "queries": len(data.queries),
        "references": len(data.database),
        "training": evaluation.train,
        "notes": data.notes,
        "conventions": EXPLANATION,
        "command": command,
        "methods": [
            {
                "name": outcome.name,
                "figures": {
                    convention: {name: _number(value) for name, value in values.items()}
                    for convention, values in outcome.measures.items()
                },
                "curves": {name: _points(curve) for name, curve in curves_of(outcome).items()},
                "seconds": {stage: round(seconds, 6) for stage, seconds in outcome.seconds.items()},
                "milliseconds_a_frame": {
                    stage: round(1e3 * seconds / evaluation.image_count, 6)
                    for stage, seconds in outcome.seconds.items()
                    if stage not in outcome.training_stages
                },
                "notes": outcome.notes,
            }
            for outcome in evaluation.outcomes
        ],
    }


def _counted(truth: Truth, name: str) -> dict[str, Any]:
    return {
        name: truth.description,
        "judged_pairs": int(np.count_nonzero(truth.judged)),
        "true_pairs": truth.positives,
        "queries_with_a_loop": int(np.count_nonzero(truth.queries_with_a_loop)),
    }


def curves_of(outcome: Outcome) -> dict[str, PrecisionRecall]:
    """Return the curves of a method: convention and angle -> curve."""
    angles = [("", outcome.rule)] + ([] if outcome.wide is None else [(WIDE, outcome.wide)])
    return {curve.convention + angle: curve for angle, found in angles for curve in (found.pairs, found.best)}


def _points(curve: PrecisionRecall) -> dict[str, list[float]]:
    """Return at most POINTS points of a curve for drawing, chosen from those at which recall increases."""
    rises = np.flatnonzero(np.diff(curve.recall, prepend=0.0) > 0)
    kept = rises[np.unique(np.linspace(0, len(rises) - 1, min(len(rises), POINTS)).round().astype(int))]
    return {name: [round(float(v), 6) for v in getattr(curve, name)[kept]] for name in ("recall", "precision")}


def measures_text(evaluation: Evaluation) -> str:
    """Return the table of measures for a terminal, with the description of the truth."""
    wide = evaluation.data.wide
    heads = ["method", "AP", "R@P=1", "F1", "AP", "R@P=1", "F1", *(f"R@{k}" for k in RECALL_AT)]
    heads += ["AP", "R@P=1"] if wide else []
    heads.append("ms/frame")
    rows = []
    for outcome in evaluation.outcomes:
        values = outcome.shown
        cells = [share(v) for v in (*values[ALL_PAIRS].values(), *values[BEST_MATCH].values())]
        if wide:
            cells += [share(values[BEST_MATCH + WIDE][name]) for name in WIDE_MEASURES]
        rows.append([outcome.name, *cells, f"{1e3 * outcome.seconds_on_frames / evaluation.image_count:.2f}"])
    spans = [(ALL_PAIRS, 3), (BEST_MATCH, 3 + len(RECALL_AT))]
    data = evaluation.data
    lines = [f"{data.name}: {data.truth.description}"]
    if wide:
        spans.append((f"best match{WIDE}", len(WIDE_MEASURES)))
    answers = [f"{outcome.name}: {outcome.answer}" for outcome in evaluation.outcomes if outcome.answer]
    answers += [f"{outcome.name}: {outcome.measured}" for outcome in evaluation.outcomes if outcome.measured]
    return "\n".join([*lines, *in_columns([heads, *rows], spans=spans), *answers])


def _number(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def share(value: float) -> str:
    """Print a share in 0..1; a dash if it is undefined."""
    return "–" if math.isnan(value) else f"{value:.3f}"
