"""``loopclosure evaluate``, ``compare`` and ``similarity``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure import evaluate
from loopclosure.cli.data_set import DATA_SET, HELP, data_set
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, top_k, write_similarity, write_top_k
from loopclosure.errors import InputError
from loopclosure.methods.base import MethodContext
from loopclosure.methods.named import METHODS
from loopclosure.places.frames import image_paths
from loopclosure.places.source import FRAMES, Source, read_source
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import WrongUsage, seed
from netspec.terminal.output import bar


def _training(text: str) -> Source:
    try:
        return read_source(text, {"": FRAMES})
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _evaluate(a: argparse.Namespace) -> None:
    # Drawing takes seconds to import, which the other commands need not wait for.
    from loopclosure.report.files import measures_text
    from loopclosure.report.page import verdict, write_report

    data = data_set(a)
    context = MethodContext(data.exclude_frames, a.seed)
    methods = [evaluate.named_method(text, context) for text in a.method]
    train: list[Path] = []
    for source in a.train:
        images = image_paths(source.path)
        train += [images[i] for i in source.selection().numbers(len(images))]
    training = f"{len(train)} images of {', '.join(t.path.name for t in a.train)}" if train else "no training images"
    evaluation = evaluate.evaluate(data, methods, train, training, bar)
    page = write_report(evaluation, a.out, a.title, a.command_line)
    print(verdict(evaluation))
    print(measures_text(evaluation))
    print(f"report: {page}")


def _compare(a: argparse.Namespace) -> None:
    # Drawing takes seconds to import, which the other commands need not wait for.
    from loopclosure.report.compare import read_reports, text, write_comparison

    if len(a.report) < 2:
        raise WrongUsage("one report was given; expected two or more")
    reports = read_reports(a.report)
    write_comparison(reports, a.out, a.command_line)
    print(text(reports))
    print(f"comparison: {a.out}")


def _similarity(a: argparse.Namespace) -> None:
    excluded = a.exclude_frames or a.exclude_seconds
    if excluded and a.top_k is None:
        raise WrongUsage("an exclusion belongs to --top-k; the matrix holds all pairs")
    if excluded and a.references is not None:
        raise WrongUsage("an exclusion belongs to one sequence; with --references nothing is near in time")
    queries = read_features(a.features)
    references = None if a.references is None else read_features(a.references).features
    if queries.views > 1:
        raise InputError("describes several views of an image; this command compares one", a.features)
    if a.top_k is None:
        shape = write_similarity(a.out, queries.features, references, a.metric, bar)
        print(f"{shape[0]} x {shape[1]} scores, float32: {a.out}")
        return
    exclusion = Exclusion(a.exclude_frames, a.exclude_seconds) if references is None else None
    found = top_k(queries.features, references, a.top_k, a.metric, exclusion, queries.stamps)
    write_top_k(a.out, found)
    print(f"the best {a.top_k} of {len(found.indices)} queries ({exclusion or 'no pair excluded'}): {a.out}")


METHOD = (
    f"may be repeated; METHOD is one of {', '.join(METHODS)}, with :settings, or NAME+METHOD: "
    "features:PATH.npz[:cosine][:whiten=OTHER.npz], seqslam+features:PATH.npz, fabmap:model=words.npz"
)
TRAINING = (
    "may be repeated: images for vocabularies, other than those tested: a folder, list or TUM sequence, "
    "with start, stop, stride, limit"
)
EVALUATE = (
    *DATA_SET,
    ("--method [LABEL=]METHOD", [str], ..., METHOD),
    ("--train PATH[,KEY=VALUE]", [_training], None, TRAINING),
    ("--out FOLDER", str, ..., "where the report and its parts go"),
    ("--title TEXT", str, "", "heading of the report"),
    ("--seed N", seed, 0, "of the methods' random numbers"),
)
COMPARE = (
    ("REPORT.json...", str, None, "two or more, as evaluate writes them"),
    ("--out FILE.html", str, "comparison.html", "the page"),
)
SIMILARITY = (
    ("FEATURES", str, None, "the .npz file of the queries"),
    ("--references F.npz", str, None, "the references (default: the queries, as one sequence)"),
    ("--metric", METRICS, METRICS[0], "of the descriptors"),
    ("--top-k K", int, None, "write the best K of each query as CSV, not all as .npy"),
    ("--exclude-frames N", int, 0, "of --top-k in one sequence"),
    ("--exclude-seconds S", float, 0.0, "the same, by stamps"),
    ("--out FILE", str, ..., "the file to write"),
)
COMMANDS = (
    ("evaluate", _evaluate, "run methods on one data set and write a report", EVALUATE, HELP),
    ("compare", _compare, "put the reports of several evaluations side by side: table and curves", COMPARE),
    ("similarity", _similarity, "compare all descriptors of a file, by blocks", SIMILARITY),
)
