"""``netspec plot``."""

from __future__ import annotations

import argparse
from pathlib import Path

from netspec.cli.arguments import positive
from netspec.cli.run import Commands
from netspec.errors import printable
from netspec.terminal.commands import WrongUsage


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("plot", _plot, "draw the curves of trainings from their logs, netspec's or Caffe's", quiet=True)
    p.add_argument("logs", nargs="+", metavar="LOG", help="what a training wrote to stderr")
    p.add_argument("--out", required=True, metavar="F.png|svg|html", help="the picture, or a page, to write")
    p.add_argument("--names", help="what the runs are called, separated by commas (default: the names of the files)")
    p.add_argument("--smooth", type=positive, metavar="N", help="average N points (default: a 25th of them)")
    p.add_argument("--log_scale", action="store_true", help="draw losses on a logarithmic axis")


def _plot(arguments: argparse.Namespace) -> None:
    from netspec.files.whole_file import write_whole
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.draw.training import Look, training_figure
    from netspec.inspect.draw.training_page import training_page
    from netspec.inspect.logs.run import read_log, summary

    names = [printable(name) for name in (arguments.names.split(",") if arguments.names else _names(arguments.logs))]
    if len(names) != len(arguments.logs):
        raise WrongUsage(f"found {len(names)} --names and {len(arguments.logs)} logs, expected equal numbers")
    ending = ending_of(arguments.out)
    runs = [read_log(path, name) for path, name in zip(arguments.logs, names, strict=True)]
    figure = training_figure(runs, Look(arguments.smooth, arguments.log_scale))
    if ending == "html":
        write_whole(arguments.out, training_page(runs, figure, ", ".join(names)))
    else:
        write_figure(figure, arguments.out)
    for run in runs:
        print(f"{run.name}: " + ", ".join(f"{name} {value}" for name, value in summary(run).items()))
    print(arguments.out)


def _names(paths: list[str]) -> list[str]:
    """Return the files' names, with as many folders as needed to tell them apart."""
    parts = [Path(path).parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(set(paths)):
            return names
    return list(paths)
