"""``loopclosure evaluate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure import evaluate
from loopclosure.cli.data_set import HELP, add_data_set, data_set
from loopclosure.errors import InputError
from loopclosure.methods.base import MethodContext
from loopclosure.methods.named import METHODS, named_methods
from loopclosure.places.frames import image_paths
from loopclosure.places.source import FRAMES, Source, read_source
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands, seed


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_evaluate(commands)


def _training(text: str) -> Source:
    try:
        return read_source(text, {"": FRAMES})
    except InputError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _setting(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or "." not in name:
        raise argparse.ArgumentTypeError(f"found {text}, expected NAME.SETTING=VALUE")
    return name, value


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
        help=f"a method to evaluate (may be repeated): {', '.join(METHODS)}, or one that refines another, such as "
        "features:PATH.npz, describe:small, seqslam+features:PATH.npz",
    )
    parser.add_argument(
        "--set",
        action="append",
        type=_setting,
        default=[],
        metavar="NAME.SETTING=VALUE",
        help="a setting of a method, by its name or label (may be repeated), such as fabmap.model=words.npz",
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
    parser.add_output("--out", folder=True, required=True, metavar="FOLDER", help="folder for the report")
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
    methods = named_methods(a.method, context, dict(a.set))
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
