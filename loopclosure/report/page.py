"""The report of an evaluation: one self-contained HTML page, and beside it the same as PNG, CSV and JSON.

Every file says by which convention its figures are and what was excluded.
"""

from __future__ import annotations

import base64
import io
import math
from html import escape
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from loopclosure.evaluate import RECALL_AT, Evaluation, Outcome, figures
from loopclosure.places.frames import read_image
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH
from loopclosure.report import figures as report_figures
from loopclosure.report.files import EXPLANATION, share, write_files

PAIRS_SHOWN = 4
PICTURE_HEIGHT = 120  # pixels of the pictures of pairs
STYLE = """
body { font: 15px/1.5 Georgia, 'Times New Roman', serif; color: #1c1c1c; background: #fff; max-width: 68rem;
       margin: 2.5rem auto 4rem; padding: 0 1.5rem; }
h1 { font-size: 1.7rem; font-weight: normal; margin: 0 0 .3rem; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
h3 { font-size: 1rem; font-weight: bold; margin: 1.4rem 0 .4rem; }
p, figcaption, li { max-width: 58rem; }
.lead { color: #555; margin: 0 0 1.2rem; }
table { border-collapse: collapse; margin: .4rem 0 .3rem; font-size: .92rem; font-variant-numeric: tabular-nums; }
thead tr:first-child th { border-top: 1.5px solid #1c1c1c; }
thead tr:last-child th { border-bottom: 1px solid #1c1c1c; }
tbody tr:last-child td { border-bottom: 1.5px solid #1c1c1c; }
tbody tr.group td { border-top: 1px solid #ccc; }
th { font-weight: normal; font-style: italic; text-align: right; vertical-align: bottom; padding: .2rem .7rem; }
th.span { text-align: center; font-style: normal; }
td { padding: .15rem .7rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: .2rem; white-space: normal; }
td.left, th.left { text-align: left; }
td.best { font-weight: bold; }
caption, figcaption { text-align: left; color: #333; font-size: .9rem; caption-side: top; padding-bottom: .3rem; }
figure { margin: .6rem 0 1.4rem; }
figure img { max-width: 100%; height: auto; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; margin: .6rem 0; }
dt { font-style: italic; color: #555; }
dd { margin: 0; }
.pairs { display: grid; grid-template-columns: repeat(4, 1fr); gap: .4rem .8rem; margin: .2rem 0 .8rem; }
.pair { font-size: .78rem; color: #444; line-height: 1.3; }
.pair img { display: block; width: 100%; border-top: 3px solid #9e9e9e; }
.pair.found img { border-color: #1a9641; }
.pair.false img { border-color: #d7191c; }
.kind { grid-column: 1 / -1; font-style: italic; font-size: .88rem; }
.notes { font-size: .88rem; color: #444; padding-left: 1.1rem; }
code { font-size: .85rem; overflow-wrap: anywhere; }
@media print { body { margin: 0; } h2 { break-after: avoid; } figure, table, .pairs { break-inside: avoid; } }
"""


def write_report(evaluation: Evaluation, folder: str | Path, title: str = "", command: str = "") -> Path:
    """Write report.html and its parts into ``folder`` (made if need be); return the path of the page.

    ``figures.csv``, ``times.csv``, ``report.json``; ``precision_recall.png``, ``matrices.png``, ``matches.png`` and,
    for one sequence with positions, ``map.png``; for each method ``curve_*.csv`` (one row for each recall reached, with
    the precision there) and ``matches_*.csv``.
    ``command``, if given, is printed at the end of the page, so that a reader can repeat it.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "precision_recall": report_figures.curves(evaluation),
        "matrices": report_figures.matrices(evaluation),
        "matches": report_figures.matches(evaluation),
    }
    if report_figures.has_map(evaluation):
        pictures["map"] = report_figures.maps(evaluation)
    encoded = {name: _save(figure, folder / f"{name}.png") for name, figure in pictures.items()}
    page = folder / "report.html"
    page.write_text(_page(evaluation, encoded, title or f"Loop closure on {evaluation.data.name}", command), "utf-8")
    write_files(evaluation, folder, command)
    return page


def _page(evaluation: Evaluation, pictures: dict[str, str], title: str, command: str) -> str:
    data, truth = evaluation.data, evaluation.data.truth
    judged = int(np.count_nonzero(truth.judged))
    loops = int(np.count_nonzero(truth.queries_with_a_loop))
    one_sequence = data.reference_images is None
    frames = (
        f"{len(data.query_images)} frames"
        if one_sequence
        else (f"{len(data.query_images)} queries, {len(data.references)} references")
    )
    facts = {
        "data": f"{data.name}: {frames}",
        "truth": truth.sentence,
        "to find": f"{truth.positives:,} true pairs of {judged:,} judged ({100 * truth.positives / judged:.2f} %); "
        f"{loops} of {len(data.query_images)} queries have a loop",
        "training": evaluation.train,
    }
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{len(evaluation.outcomes)} methods, {frames}</p>',
        "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items()) + "</dl>",
        _list(data.notes),
        "<h2>Figures</h2>",
        _figures_table(evaluation),
        f"<p>Conventions. <em>{ALL_PAIRS}</em>: {EXPLANATION[ALL_PAIRS]}. <em>{BEST_MATCH}</em>: "
        f"{EXPLANATION[BEST_MATCH]}. Average precision is the sum of (R<sub>n</sub> &minus; R<sub>n&minus;1</sub>) "
        "P<sub>n</sub> over all distinct scores; no threshold grid, no trapezoid.</p>",
        _figure(
            pictures["precision_recall"],
            "Figure 1. Precision against recall, exact, by both conventions; a dot marks the greatest recall at 100 % "
            f"precision, the dotted line the precision of guessing. Truth: {truth.sentence}.",
        ),
        "<h2>Similarity</h2>",
        _figure(
            pictures["matrices"],
            "Figure 2. Ground truth (black; ignored when found: orange) and the scores of each method, bright for what "
            "is more alike (1st to 99.5th percentile of the judged pairs). Grey: not judged, or no score.",
        ),
        "<h2>Loops</h2>",
        _figure(
            pictures["matches"],
            "Figure 3. Matches over the truth (light): found, false and missed loops, by the best match of each query "
            "at the threshold of each method's best F1, which is chosen on these very frames, for the picture only. A "
            "missed loop stands at the true reference that scored best.",
        ),
        _figure(pictures["map"], "Figure 4. The same loops on the trajectory.") if "map" in pictures else "",
        "<h2>Times</h2>",
        _times_table(evaluation),
        "<h2>Pairs</h2>",
        "<p>Best matches of queries: the surest that are right, the surest that are wrong, and the loops whose true "
        "reference scored lowest. Left the query, right the reference.</p>",
        *(_pairs(evaluation, outcome) for outcome in evaluation.outcomes),
        "<h2>Settings</h2>",
        *(f"<h3>{escape(o.name)}</h3>{_list(o.notes)}" for o in evaluation.outcomes),
        f"<p>Made by <code>{escape(command)}</code></p>" if command else "",
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    body = "\n".join(parts)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head><body>\n{body}\n</body></html>\n'


def _figures_table(evaluation: Evaluation) -> str:
    columns = ["AP", "R at 100&nbsp;% P", "best F1"]
    best_columns = columns + [f"R@{k}" for k in RECALL_AT]
    rows = [[v for values in figures(o).values() for v in values.values()] for o in evaluation.outcomes]
    best = [max((row[i] for row in rows if not math.isnan(row[i])), default=None) for i in range(len(rows[0]))]
    body = ""
    for outcome, row in zip(evaluation.outcomes, rows, strict=True):
        cells = "".join(
            f'<td class="best">{share(v)}</td>' if v == best[i] and len(rows) > 1 else f"<td>{share(v)}</td>"
            for i, v in enumerate(row)
        )
        body += f"<tr><td>{escape(outcome.name)}</td>{cells}</tr>"
    return (
        f"<table><caption>Table 1. Figures by both conventions; {escape(evaluation.data.truth.sentence)}.</caption>"
        "<thead><tr><th></th>"
        f'<th class="span" colspan="{len(columns)}">{ALL_PAIRS}</th>'
        f'<th class="span" colspan="{len(best_columns)}">{BEST_MATCH}</th></tr><tr><th>method</th>'
        + "".join(f"<th>{c}</th>" for c in columns + best_columns)
        + f"</tr></thead><tbody>{body}</tbody></table>"
    )


def _times_table(evaluation: Evaluation) -> str:
    body = ""
    for outcome in evaluation.outcomes:
        stages = [(stage, seconds, stage in outcome.once) for stage, seconds in outcome.seconds.items()]
        stages.append(("all but training" if outcome.once else "in all", outcome.seconds_on_frames, False))
        for number, (stage, seconds, once) in enumerate(stages):
            name = escape(outcome.name) if number == 0 else ""
            each = "once" if once else _significant(1e3 * seconds / evaluation.images)
            body += (
                f'<tr{" class=group" if number == 0 else ""}><td>{name}</td><td class="left">{escape(stage)}</td>'
                f"<td>{_significant(seconds)}</td><td>{each}</td></tr>"
            )
    return (
        f"<table><caption>Table 2. Seconds, and milliseconds for each of the {evaluation.images} frames. What is "
        "done once is training; a net's features cost what their file says.</caption>"
        '<thead><tr><th>method</th><th class="left">stage</th><th>seconds</th><th>ms a frame</th></tr></thead>'
        f"<tbody>{body}</tbody></table>"
    )


def _pairs(evaluation: Evaluation, outcome: Outcome) -> str:
    """Return the best and worst pairs of one method as pictures."""
    truth, matches = evaluation.data.truth, outcome.matches
    answered = matches.reference >= 0
    right = np.flatnonzero(matches.right)
    wrong = np.flatnonzero(answered & ~matches.right & ~matches.ignored)
    loops = np.flatnonzero(truth.queries_with_a_loop)
    true = report_figures.best_true_references(outcome, truth, loops)
    true_scores = np.nan_to_num(outcome.scores[loops, true], nan=-np.inf)
    lowest = np.argsort(true_scores, kind="stable")
    kinds = [
        ("found", "surest right", _spread(right[np.argsort(-matches.score[right], kind="stable")], evaluation)),
        ("false", "surest wrong", _spread(wrong[np.argsort(-matches.score[wrong], kind="stable")], evaluation)),
        ("missed", "true, lowest score", _spread(loops[lowest], evaluation)),
    ]
    rows = ""
    for kind, words, queries in kinds:
        pictures = ""
        for query in queries:
            reference = true[np.searchsorted(loops, query)] if kind == "missed" else matches.reference[query]
            picture = _pair_picture(evaluation.data.query_images[query], evaluation.data.references[reference])
            score = outcome.scores[query, reference]
            words_of_pair = (
                f"{query} and {reference}, score {score:.4g}"
                if np.isfinite(score)
                else f"{query} and {reference}, no score"
            )
            pictures += (
                f'<div class="pair {kind}"><img src="data:image/jpeg;base64,{picture}" alt="{words_of_pair}">'
                f"{words_of_pair}</div>"
            )
        rows += f'<div class="kind">{words}{"" if pictures else ": none"}</div>{pictures}'
    return f'<h3>{escape(outcome.name)}</h3><div class="pairs">{rows}</div>'


def _spread(queries: np.ndarray, evaluation: Evaluation) -> list[int]:
    """Take the first few queries that are not neighbours of one already taken: five times the same view says little."""
    apart = max(1, len(evaluation.data.query_images) // 30) if evaluation.data.reference_images is None else 1
    taken: list[int] = []
    for query in queries:
        if len(taken) < PAIRS_SHOWN and all(abs(int(query) - other) >= apart for other in taken):
            taken.append(int(query))
    return taken


def _pair_picture(query: Path, reference: Path) -> str:
    images = [read_image(path) for path in (query, reference)]
    small = [
        cv2.resize(
            image,
            (max(1, round(image.shape[1] * PICTURE_HEIGHT / image.shape[0])), PICTURE_HEIGHT),
            interpolation=cv2.INTER_AREA,
        )
        for image in images
    ]
    gap = np.full((PICTURE_HEIGHT, 2, 3), 255, np.uint8)
    _, data = cv2.imencode(".jpg", np.hstack([small[0], gap, small[1]]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return base64.b64encode(data.tobytes()).decode("ascii")


def _save(figure: Figure, path: Path) -> str:
    """Write a figure as PNG and return the same bytes in base64."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    path.write_bytes(stream.getvalue())
    return base64.b64encode(stream.getvalue()).decode("ascii")


def _figure(picture: str, caption: str) -> str:
    words = escape(caption)
    return f'<figure><img src="data:image/png;base64,{picture}" alt="{words}"><figcaption>{words}</figcaption></figure>'


def _list(sentences: list[str]) -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f'<ul class="notes">{items}</ul>' if items else ""


def _significant(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
