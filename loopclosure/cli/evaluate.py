"""``loopclosure evaluate``, ``compare`` and ``similarity``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure import evaluate
from loopclosure.cli.data_set import HELP, add_data_set, data_set
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, top_k, write_similarity, write_top_k
from loopclosure.errors import InputError
from loopclosure.methods.base import MethodContext
from loopclosure.methods.named import METHODS
from loopclosure.places.frames import image_paths
from loopclosure.places.source import FRAMES, Source, read_source
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands, seed


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_evaluate(commands)
    _add_compare(commands)
    _add_similarity(commands)


def _training(text: str) -> Source:
    try:
        return read_source(text, {"": FRAMES})
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _add_evaluate(commands: Commands) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="run methods on one data set and write a report",
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(function=_evaluate)
    add_data_set(parser)
    parser.add_argument(
        "--method",
        action="append",
        required=True,
        default=[],
        metavar="[LABEL=]METHOD",
        help=f"a method to evaluate (may be repeated): {', '.join(METHODS)}, with :SETTINGS, or NAME+METHOD, such as "
        "features:PATH.npz[:cosine][:whiten=OTHER.npz], seqslam+features:PATH.npz or fabmap:model=words.npz",
    )
    parser.add_argument(
        "--train",
        action="append",
        type=_training,
        default=[],
        metavar="PATH[,KEY=VALUE]",
        help="images to train vocabularies on, not those evaluated: a folder, list or TUM sequence, "
        "with start, stop, stride, limit; may be repeated",
    )
    parser.add_argument("--out", required=True, metavar="FOLDER", help="folder for the report")
    parser.add_argument("--title", default="", metavar="TEXT", help="heading of the report")
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="random seed of the methods (default: %(default)s)"
    )


def _evaluate(a: argparse.Namespace) -> None:
    # Imported here, since it takes seconds and only this command needs it.
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


def _add_compare(commands: Commands) -> None:
    parser = commands.add_parser("compare", help="compare the reports of several evaluations in a table and curves")
    parser.set_defaults(function=_compare)
    parser.add_argument("report", nargs="+", metavar="REPORT.json", help="two or more reports that evaluate wrote")
    parser.add_argument(
        "--out", default="comparison.html", metavar="FILE.html", help="the page to write (default: %(default)s)"
    )


def _compare(a: argparse.Namespace) -> None:
    # Imported here, since it takes seconds and only this command needs it.
    from loopclosure.report.compare import read_reports, text, write_comparison

    if len(a.report) < 2:
        raise WrongUsage("one report was given; expected two or more")
    reports = read_reports(a.report)
    write_comparison(reports, a.out, a.command_line)
    print(text(reports))
    print(f"comparison: {a.out}")


def _add_similarity(commands: Commands) -> None:
    parser = commands.add_parser("similarity", help="compute the similarity of all pairs of descriptors in a file")
    parser.set_defaults(function=_similarity)
    parser.add_argument("features", metavar="FEATURES", help="the .npz file with the queries")
    parser.add_argument(
        "--references", metavar="F.npz", help="the .npz file with the references (default: the queries)"
    )
    parser.add_argument(
        "--metric", default=METRICS[0], choices=METRICS, help="metric of the descriptors (default: %(default)s)"
    )
    parser.add_argument(
        "--top-k",
        type=int,
        metavar="K",
        help="write the best K references of each query as CSV (default: write all as .npy)",
    )
    parser.add_argument(
        "--exclude-frames",
        type=int,
        default=0,
        metavar="N",
        help="with --top-k and without --references: exclude pairs within N frames (default: %(default)s)",
    )
    parser.add_argument(
        "--exclude-seconds",
        type=float,
        default=0.0,
        metavar="S",
        help="the same, within S seconds (default: %(default)g)",
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write")


def _similarity(a: argparse.Namespace) -> None:
    excluded = a.exclude_frames or a.exclude_seconds
    if excluded and a.top_k is None:
        raise WrongUsage("--exclude-frames and --exclude-seconds need --top-k")
    if excluded and a.references is not None:
        raise WrongUsage("--exclude-frames and --exclude-seconds cannot be used with --references")
    queries = read_features(a.features)
    references = None if a.references is None else read_features(a.references).features
    if queries.views > 1:
        raise InputError("describes several views of each image; this command needs one", a.features)
    if a.top_k is None:
        shape = write_similarity(a.out, queries.features, references, a.metric, bar)
        print(f"{shape[0]} x {shape[1]} scores, float32: {a.out}")
        return
    exclusion = Exclusion(a.exclude_frames, a.exclude_seconds) if references is None else None
    found = top_k(queries.features, references, a.top_k, a.metric, exclusion, queries.stamps)
    write_top_k(a.out, found)
    print(f"the best {a.top_k} of {len(found.indices)} queries ({exclusion or 'no pair excluded'}): {a.out}")
