"""Writes the report of an evaluation: a self-contained HTML page, its pictures as PNG files, and the same data as JSON.

Every file states the convention of its results and the exclusion. The template ``report.html.jinja`` escapes all
values, so names of methods, folders and notes may have any characters.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from loopclosure.evaluation import RECALL_AT, Evaluation, Outcome
from loopclosure.places.frames import read_bgr
from loopclosure.places.same_place import WIDE_ANGLE_DEG, angles_deg, distances_m
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH
from loopclosure.report import plots
from loopclosure.report.files import EXPLANATION, WIDE_MEASURES, share, write_json
from netspec.files.figures import png
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

PAIRS_SHOWN = 4
PICTURE_HEIGHT = 120  # pixels of the pictures of pairs


@dataclass(frozen=True)
class Pair:
    """A pair of images side by side (JPEG), and its caption."""

    picture: bytes
    caption: str


@dataclass(frozen=True)
class Kind:
    """A group of pairs with a title; ``name`` is their CSS class."""

    name: str
    title: str
    pairs: list[Pair]


def write_report(evaluation: Evaluation, folder: str | Path, title: str = "", command: str = "") -> Path:
    """Write report.html and its parts into ``folder``, which is created if needed; return the path of the page.

    The parts are ``report.json``, ``precision_recall.png``, ``matrices.png``, ``matches.png`` and, for one sequence
    with positions, ``map.png``. ``command``, if given, is printed at the end of the page to repeat the evaluation.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "precision_recall": plots.curves(evaluation),
        "matrices": plots.matrices(evaluation),
        "matches": plots.matches(evaluation),
    }
    if plots.has_map(evaluation):
        pictures["map"] = plots.maps(evaluation)
    encoded = {name: png(figure) for name, figure in pictures.items()}
    for name, picture in encoded.items():
        write_whole(folder / f"{name}.png", picture)
    page = folder / "report.html"
    text = _page(evaluation, encoded, title or f"Loop closure on {evaluation.data.name}", command)
    write_whole(page, text, "backslashreplace")
    write_json(evaluation, folder / "report.json", command)
    return page


def _page(evaluation: Evaluation, pictures: dict[str, bytes], title: str, command: str) -> str:
    data, truth = evaluation.data, evaluation.data.truth
    judged = int(np.count_nonzero(truth.judged))
    loops = int(np.count_nonzero(truth.queries_with_a_loop))
    frames = f"{len(data.queries)} frames"
    if data.references is not None:
        frames = f"{len(data.queries)} queries, {len(data.database)} references"
    facts = {
        "data": f"{data.name}: {frames}",
        "truth": truth.description,
        "to find": f"{truth.positives:,} true pairs of {judged:,} judged ({100 * truth.positives / judged:.2f} %); "
        f"{loops} of {len(data.queries)} queries have a loop",
        "training": evaluation.train,
    }
    return rendered(
        "report.html.jinja",
        title=title,
        verdict=verdict(evaluation),
        command=command,
        data=data,
        truth=truth.description,
        wide=None if data.wide is None else f"{WIDE_ANGLE_DEG:g} degrees",
        frames=frames,
        facts=facts,
        images=evaluation.image_count,
        outcomes=evaluation.outcomes,
        all_pairs=ALL_PAIRS,
        best_match=BEST_MATCH,
        explanation=EXPLANATION,
        recall_at=RECALL_AT,
        measures=_measures_rows(evaluation),
        pictures=pictures,
        stages=_stages,
        pairs=[(outcome.name, _kinds_of_pairs(evaluation, outcome)) for outcome in evaluation.outcomes],
    )


def verdict(evaluation: Evaluation) -> str:
    """Return a sentence about the method, or about the one of several with the most right best matches."""
    outcome = max(evaluation.outcomes, key=lambda outcome: np.count_nonzero(outcome.matches.right))
    right, matches = int(np.count_nonzero(outcome.matches.right)), outcome.matches
    loops = int(np.count_nonzero(evaluation.data.truth.queries_with_a_loop))
    which = f"{outcome.name}: " if len(evaluation.outcomes) == 1 else f"Best of all, {outcome.name}: "
    if outcome.answer:
        accepted = int(np.count_nonzero(matches.reference >= 0))
        return (
            f"{which}{accepted} of {len(matches.reference)} frames close a loop; {right} are right, {loops} could be."
        )
    before = round(outcome.best.recall_at_full_precision * loops) if loops else 0
    best = f"{right} of the {loops} frames that have a loop find it with their best match"
    return f"{which}{best}, {before} of them before the first mistake."


def _measures_rows(evaluation: Evaluation) -> list[tuple[str, list[tuple[float, bool]]]]:
    """Return the name and the measures of each method; each measure with whether it is the best of all methods."""
    rows = [[v for name in (ALL_PAIRS, BEST_MATCH) for v in o.shown[name].values()] for o in evaluation.outcomes]
    for row, outcome in zip(rows, evaluation.outcomes, strict=True):
        if outcome.wide is not None:
            row += [outcome.wide.measures()[BEST_MATCH][name] for name in WIDE_MEASURES]
    best = [max((row[i] for row in rows if not math.isnan(row[i])), default=None) for i in range(len(rows[0]))]
    return [
        (outcome.name, [(value, len(rows) > 1 and value == top) for value, top in zip(row, best, strict=True)])
        for outcome, row in zip(evaluation.outcomes, rows, strict=True)
    ]


def _stages(outcome: Outcome) -> list[tuple[str, float, bool]]:
    """Return each stage, its seconds and whether it runs only once; then the total of the stages for all frames."""
    stages = [(stage, seconds, stage in outcome.training_stages) for stage, seconds in outcome.seconds.items()]
    return [
        *stages,
        ("total without training" if outcome.training_stages else "total", outcome.seconds_on_frames, False),
    ]


def _kinds_of_pairs(evaluation: Evaluation, outcome: Outcome) -> list[Kind]:
    """Return sample pairs of a method as pictures: right, wrong and missed ones."""
    truth, matches = evaluation.data.truth, outcome.matches
    answered = matches.reference >= 0
    right = np.flatnonzero(matches.right)
    wrong = np.flatnonzero(answered & ~matches.right & ~matches.ignored)
    loops = np.flatnonzero(truth.queries_with_a_loop)
    true = plots.best_true_references(outcome, truth, loops)
    true_scores = np.nan_to_num(outcome.scores[loops, true], nan=-np.inf)
    right = right[np.argsort(-matches.score[right], kind="stable")]
    wrong = wrong[np.argsort(-matches.score[wrong], kind="stable")]
    lowest = np.argsort(true_scores, kind="stable")

    alone = evaluation.data.references is None
    least_gap = max(1, len(evaluation.data.queries) // 30) if alone else 1

    def pairs(queries: np.ndarray, references: np.ndarray) -> list[Pair]:
        shown = spread(queries.tolist(), PAIRS_SHOWN, least_gap)
        return [_pair(evaluation, outcome, queries[i], references[i]) for i in shown]

    return [
        Kind("found", "right, highest score", pairs(right, matches.reference[right])),
        Kind("false", "wrong, highest score", pairs(wrong, matches.reference[wrong])),
        Kind("missed", "true, lowest score", pairs(loops[lowest], true[lowest])),
    ]


def spread(frames: Sequence[int], count: int, least_gap: float) -> list[int]:
    """Return the indices of the first ``count`` frames that differ by at least ``least_gap`` from each other."""
    taken: list[int] = []
    for i, frame in enumerate(frames):
        if len(taken) < count and all(abs(frame - frames[other]) >= least_gap for other in taken):
            taken.append(i)
    return taken


def _pair(evaluation: Evaluation, outcome: Outcome, query: int, reference: int) -> Pair:
    score = outcome.scores[query, reference]
    caption = f"{query} and {reference}, {f'score {score:.4g}' if np.isfinite(score) else 'no score'}"
    caption += _distance_text(evaluation, int(query), int(reference))
    data = evaluation.data
    images = read_bgr(data.queries.paths[query]), read_bgr(data.database.paths[reference])
    return Pair(side_by_side(*images), caption)


def side_by_side(*images: np.ndarray) -> bytes:
    """Return two images (H, W, 3) BGR of any size, reduced and side by side, as JPEG."""
    small = [
        cv2.resize(
            image,
            (max(1, round(image.shape[1] * PICTURE_HEIGHT / image.shape[0])), PICTURE_HEIGHT),
            interpolation=cv2.INTER_AREA,
        )
        for image in images
    ]
    gap = np.full((PICTURE_HEIGHT, 2, 3), 255, np.uint8)
    _, jpeg = cv2.imencode(".jpg", np.hstack([small[0], gap, small[1]]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return jpeg.tobytes()


def _distance_text(evaluation: Evaluation, query: int, reference: int) -> str:
    """Return the distance and angle between two views; empty if the poses are not known."""
    data = evaluation.data
    if data.wide is None or data.references is not None or not data.queries.known.all():
        return ""
    poses = data.queries.known_poses()
    a, b = poses[query], poses[reference]
    return f"; {float(distances_m(a, b)):.2g} m and {float(angles_deg(a, b)):.0f} degrees apart"


def rendered(template: str, **values: object) -> str:
    """Render a template in the folder of this file; all values are escaped."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined
    )
    environment.filters |= {"share": share, "significant": _significant, "base64": _in_base64}
    colors = {"found": plots.FOUND, "false": plots.FALSE, "missed": plots.MISSED}
    return environment.get_template(template).render(**values, colors=colors)


def _in_base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _significant(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
