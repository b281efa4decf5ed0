"""``loopclosure evaluate``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure.cli.data_set import HELP, add_data_set, keyword
from loopclosure.commands import evaluate
from loopclosure.methods.named import METHODS
from netspec.terminal.parser import Commands, seed


def add_commands(commands: Commands) -> None:
    """Add ``evaluate``."""
    parser = commands.add_parser(
        "evaluate",
        _evaluate,
        help="run methods on one data set and write a report",
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
        type=keyword,
        default=[],
        metavar="NAME.SETTING=VALUE",
        help="a setting of a method, by its name or label (may be repeated), such as fabmap.model=words.npz",
    )
    parser.add_argument(
        "--train",
        action="append",
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
    from loopclosure.report.page import verdict

    evaluation = evaluate(
        a.source,
        a.method,
        a.out,
        settings=dict(a.set),
        train=a.train,
        title=a.title,
        seed=a.seed,
        tolerance=a.tolerance,
        max_distance=a.max_distance,
        max_angle=a.max_angle,
        exclude_frames=a.exclude_frames,
        exclude_seconds=a.exclude_seconds,
        command=a.command_line,
    )
    print(verdict(evaluation))
    print(measures_text(evaluation))
    print(f"report: {Path(a.out) / 'report.html'}")
