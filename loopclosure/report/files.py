"""Writes the results of an evaluation as CSV, JSON and text. Every file states its convention and the exclusion."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.csv_file import write_csv
from loopclosure.evaluate import RECALL_AT, SOFT_ZONE, Evaluation, Outcome
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH, BestMatches, PrecisionRecall
from netspec.files.whole_file import write_whole
from netspec.terminal.output import in_columns

# The largest number of points of a curve in report.json; curve_*.csv has all points.
POINTS = 400
# The measures of the soft zone in tables.
SOFT_MEASURES = ("average precision", "recall at 100 % precision")

EXPLANATION = {
    ALL_PAIRS: "every judged pair of frames is a sample",
    BEST_MATCH: "only the best reference of each query counts; recall: share of queries with a loop and a right match",
}


def write_files(evaluation: Evaluation, folder: Path, command: str = "") -> None:
    """Write figures.csv, times.csv, report.json, and curve_*.csv and matches_*.csv of each method."""
    _write_measures_csv(evaluation, folder / "figures.csv")
    _write_times_csv(evaluation, folder / "times.csv")
    slugs = _slugs([outcome.name for outcome in evaluation.outcomes])
    for slug, outcome in zip(slugs, evaluation.outcomes, strict=True):
        _write_curves_csv(outcome, folder / f"curve_{slug}.csv")
        _write_matches_csv(evaluation, outcome, folder / f"matches_{slug}.csv")
    text = json.dumps(summary(evaluation, command), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(folder / "report.json", text + "\n", "backslashreplace")


def summary(evaluation: Evaluation, command: str = "") -> dict[str, Any]:
    """Return the whole evaluation as JSON values; an undefined measure is null."""
    data, truth, soft = evaluation.data, evaluation.data.truth, evaluation.data.soft_truth
    return {
        "data_set": data.name,
        "truth_and_exclusion": truth.description,
        "soft_zone": None if soft is None else soft.description,
        "queries": len(data.queries),
        "references": len(data.database),
        "judged_pairs": int(np.count_nonzero(truth.judged)),
        "true_pairs": truth.positives,
        "queries_with_a_loop": int(np.count_nonzero(truth.queries_with_a_loop)),
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


def curves_of(outcome: Outcome) -> dict[str, PrecisionRecall]:
    """Return the curves of a method: convention and zone -> curve."""
    zones = [("", outcome.rule)] + ([] if outcome.soft is None else [(SOFT_ZONE, outcome.soft)])
    return {curve.convention + zone: curve for zone, found in zones for curve in (found.pairs, found.best)}


def _points(curve: PrecisionRecall) -> dict[str, list[float]]:
    """Return at most POINTS points of a curve for drawing, chosen from those at which recall increases."""
    rises = _rises(curve)
    kept = rises[np.unique(np.linspace(0, len(rises) - 1, min(len(rises), POINTS)).round().astype(int))]
    return {name: [round(float(v), 6) for v in getattr(curve, name)[kept]] for name in ("recall", "precision")}


def measures_text(evaluation: Evaluation) -> str:
    """Return the table of measures for a terminal, with the description of the truth."""
    soft = evaluation.data.soft_truth
    heads = ["method", "AP", "R@P=1", "F1", "AP", "R@P=1", "F1", *(f"R@{k}" for k in RECALL_AT)]
    heads += ["AP", "R@P=1"] if soft else []
    heads.append("ms/frame")
    rows = []
    for outcome in evaluation.outcomes:
        values = outcome.shown
        cells = [share(v) for v in (*values[ALL_PAIRS].values(), *values[BEST_MATCH].values())]
        if soft:
            cells += [share(values[BEST_MATCH + SOFT_ZONE][name]) for name in SOFT_MEASURES]
        rows.append([outcome.name, *cells, f"{1e3 * outcome.seconds_on_frames / evaluation.image_count:.2f}"])
    spans = [(ALL_PAIRS, 3), (BEST_MATCH, 3 + len(RECALL_AT))]
    data = evaluation.data
    lines = [f"{data.name}: {data.truth.description}"]
    if soft:
        spans.append(("soft zone", len(SOFT_MEASURES)))
        lines.append(f"soft zone, best match of each query: a match is no mistake if {data.overlap_rule}")
    answers = [f"{outcome.name}: {outcome.answer}" for outcome in evaluation.outcomes if outcome.answer]
    answers += [f"{outcome.name}: {outcome.measured}" for outcome in evaluation.outcomes if outcome.measured]
    return "\n".join([*lines, *in_columns([heads, *rows], spans=spans), *answers])


def _write_measures_csv(evaluation: Evaluation, path: Path) -> None:
    rows = []
    for outcome in evaluation.outcomes:
        curves = curves_of(outcome)
        for convention, values in outcome.measures.items():
            for name, value in values.items():
                rows.append([outcome.name, convention, name, f"{value:.6f}", curves[convention].truth_description])
    write_csv(path, ("method", "convention", "figure", "value", "truth and exclusion"), rows, "backslashreplace")


def _write_times_csv(evaluation: Evaluation, path: Path) -> None:
    rows = []
    for outcome in evaluation.outcomes:
        for stage, seconds in outcome.seconds.items():
            each = "" if stage in outcome.training_stages else f"{1e3 * seconds / evaluation.image_count:.6f}"
            rows.append([outcome.name, stage, f"{seconds:.6f}", each, str(evaluation.image_count)])
    write_csv(path, ("method", "stage", "seconds", "milliseconds a frame", "frames"), rows, "backslashreplace")


def _write_curves_csv(outcome: Outcome, path: Path) -> None:
    """Write the points at which recall increases: average precision is a sum over these."""
    rows = []
    for convention, curve in curves_of(outcome).items():
        for i in _rises(curve):
            values = [f"{v[i]:.9g}" for v in (curve.thresholds, curve.precision, curve.recall)]
            rows.append([convention, *values, curve.truth_description])
    write_csv(path, ("convention", "threshold", "precision", "recall", "truth and exclusion"), rows, "backslashreplace")


def _rises(curve: PrecisionRecall) -> np.ndarray:
    return np.flatnonzero(np.diff(curve.recall, prepend=0.0) > 0)


def _write_matches_csv(evaluation: Evaluation, outcome: Outcome, path: Path) -> None:
    data, matches = evaluation.data, outcome.matches
    loops = data.truth.queries_with_a_loop
    heads = "query,reference,score,verdict,soft zone,query has a loop,query image,reference image,truth and exclusion"
    rows = []
    for query in np.flatnonzero(matches.reference >= 0):
        reference = int(matches.reference[query])
        soft = "" if outcome.soft is None else verdict(outcome.soft.matches, query)
        verdicts = [verdict(matches, query), soft]
        numbers = [str(query), str(reference), f"{matches.score[query]:.9g}", *verdicts, str(int(loops[query]))]
        images = [str(data.queries.paths[query]), str(data.database.paths[reference])]
        rows.append([*numbers, *images, data.truth.description])
    write_csv(path, heads.split(","), rows, "backslashreplace")


def verdict(matches: BestMatches, query: int | np.intp) -> str:
    """Return whether the best match of a query is "right", "wrong" or "ignored"."""
    return "right" if matches.right[query] else "ignored" if matches.ignored[query] else "wrong"


def _slugs(names: list[str]) -> list[str]:
    """Return a different file name for each method."""
    slugs: list[str] = []
    for name in names:
        slug = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "method"
        while slug in slugs:
            slug += "_"
        slugs.append(slug)
    return slugs


def _number(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def share(value: float) -> str:
    """Print a share in 0..1; a dash if it is undefined."""
    return "–" if math.isnan(value) else f"{value:.3f}"
