"""``netspec data show`` and ``plot``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from netspec.cli.arguments import positive
from netspec.errors import printable
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar
from netspec.terminal.parser import QUIET, Commands

SHOWN_FAULTS = 4  # which come first


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_show(commands.add_group("data", help="look at the records of a database"))
    _add_plot(commands)


def _add_show(commands: Commands) -> None:
    parser = commands.add_parser("show", help="draw records with their labels, and statistics of all of them")
    parser.set_defaults(function=_show, **QUIET)
    parser.add_argument("source", metavar="DB", help="an LMDB, a LevelDB, an HDF5 file, or a list of HDF5 files")
    parser.add_output("--out", required=True, metavar="F.png|svg", help="the image to write")
    parser.add_argument("--records", type=positive, metavar="N", help="read N evenly spaced records (default: all)")
    parser.add_argument(
        "--count", type=positive, default=40, metavar="N", help="number of records to draw (default: %(default)s)"
    )
    parser.add_argument(
        "--start", type=int, metavar="K", help="index of the first record to draw (default: evenly spaced ones)"
    )
    parser.add_argument(
        "--images",
        type=positive,
        metavar="N",
        help="number of images in a record, side by side (default: 2 if there are 2 or 6 channels)",
    )


def _show(arguments: argparse.Namespace) -> None:
    from netspec.inspect.check.survey import survey
    from netspec.inspect.draw.sheet import sheet
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.records import open_records, spread

    ending_of(arguments.out)
    records = open_records(arguments.source)
    if arguments.start is not None and not 0 <= arguments.start < len(records):
        raise WrongUsage(f"found --start {arguments.start}, expected 0 to {len(records) - 1}")
    found = survey(records, spread(len(records), arguments.records), partial(bar, stage="look", unit="record"))
    if arguments.start is None:
        numbers = [fault.number for fault in found.faults[: min(SHOWN_FAULTS, arguments.count)]]
        others = [k for k in range(len(records)) if k not in numbers]
        numbers += [others[k] for k in spread(len(others), arguments.count - len(numbers))]
    else:
        numbers = list(range(arguments.start, min(arguments.start + arguments.count, len(records))))
    write_figure(sheet([records[k] for k in numbers], found, arguments.source, arguments.images), arguments.out)
    print(f"{arguments.out}: {len(numbers)} of {len(records):,} records")


def _add_plot(commands: Commands) -> None:
    parser = commands.add_parser("plot", help="draw the curves of trainings from their logs, netspec's or Caffe's")
    parser.set_defaults(function=_plot, **QUIET)
    parser.add_argument("logs", nargs="+", metavar="LOG", help="log of a training (its stderr)")
    parser.add_output("--out", required=True, metavar="F.png|svg", help="the image to write")
    parser.add_argument(
        "--names",
        metavar="NAMES,...",
        help="names of the logs, separated by commas (default: the names of the files)",
    )
    parser.add_argument("--smooth", type=positive, metavar="N", help="average over N points (default: 1/25 of them)")
    parser.add_argument("--log_scale", action="store_true", help="draw losses on a logarithmic axis")


def _plot(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.draw.training import Look, training_figure
    from netspec.inspect.logs.training_log import read_log, summary

    names = [printable(name) for name in (arguments.names.split(",") if arguments.names else _names(arguments.logs))]
    if len(names) != len(arguments.logs):
        raise WrongUsage(f"found {len(names)} --names and {len(arguments.logs)} logs, expected equal numbers")
    ending_of(arguments.out)
    logs = [read_log(path, name) for path, name in zip(arguments.logs, names, strict=True)]
    figure = training_figure(logs, Look(arguments.smooth, arguments.log_scale))
    write_figure(figure, arguments.out)
    for log in logs:
        print(f"{log.name}: " + ", ".join(f"{name} {value}" for name, value in summary(log).items()))
    print(arguments.out)


def _names(paths: list[str]) -> list[str]:
    """Return the files' names, with as many folders as needed to make them different."""
    parts = [Path(path).parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(each[-length:]) for each in parts]
        if len(set(names)) == len(set(paths)):
            return names
    return list(paths)
