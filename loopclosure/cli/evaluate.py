"""``loopclosure evaluate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure import evaluate
from loopclosure.cli.data_set import add_data_set, data_set
from loopclosure.errors import InputError
from loopclosure.methods.base import METHODS, MethodContext
from loopclosure.places.frames import image_paths
from loopclosure.places.source import FRAMES, Source, read_source
from netspec.terminal.commands import Commands, seed
from netspec.terminal.output import bar


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("evaluate", _evaluate, "run methods on one data set and write a report")
    add_data_set(p)
    p.add_argument(
        "--method",
        action="append",
        required=True,
        metavar="[LABEL=]METHOD",
        help=f"may be repeated; METHOD is one of {', '.join(METHODS)}, with :settings, or NAME+METHOD: "
        "features:PATH.npz[:cosine][:whiten=OTHER.npz], seqslam+features:PATH.npz, fabmap:model=words.npz",
    )
    p.add_argument(
        "--train",
        action="append",
        default=[],
        type=_training,
        metavar="PATH[,KEY=VALUE]",
        help="images for vocabularies, other than those tested: a folder, list or TUM sequence, with start, stop, "
        "stride, limit; may be repeated",
    )
    p.add_argument("--out", required=True, metavar="FOLDER", help="where the report and its parts go")
    p.add_argument("--title", default="", help="heading of the report")
    p.add_argument("--seed", type=seed, default=0, help="of the methods' random numbers (default: 0)")


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
    context = MethodContext(data.exclude_frames, a.seed, data.stamps)
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
