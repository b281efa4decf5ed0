"""``netspec data show`` and ``plot``."""

from __future__ import annotations

import argparse
from pathlib import Path

from netspec.cli.arguments import positive
from netspec.errors import printable
from netspec.terminal.commands import WrongUsage
from netspec.terminal.parser import Commands


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    data = commands.add_group("data", help="look at the records of a database")
    parser = data.add_parser("show", _show, help="draw records with their keys and labels")
    parser.add_argument("source", metavar="DB", help="an LMDB or a LevelDB")
    parser.add_output("--out", required=True, metavar="F.png|svg", help="the image to write")
    parser.add_argument(
        "--count", type=positive, default=40, metavar="N", help="number of records to draw (default: %(default)s)"
    )
    parser.add_argument(
        "--start", type=int, metavar="K", help="index of the first record to draw (default: evenly spaced ones)"
    )
    parser = commands.add_parser(
        "plot", _plot, help="draw the curves of trainings from their logs, netspec's or Caffe's"
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="log of a training (its stderr)")
    parser.add_output("--out", required=True, metavar="F.png|svg", help="the image to write")
    parser.add_argument(
        "--names",
        metavar="NAMES,...",
        help="names of the logs, separated by commas (default: the names of the files)",
    )


def _show(arguments: argparse.Namespace) -> None:
    from netspec.data.database import open_reader
    from netspec.inspect.draw.sheet import read_record, sheet, spread
    from netspec.inspect.draw.style import ending_of, write_figure

    ending_of(arguments.out)
    leveldb = (Path(arguments.source) / "CURRENT").is_file()
    reader = open_reader(arguments.source, "leveldb" if leveldb else "lmdb")
    start, count = arguments.start, arguments.count
    if start is not None and not 0 <= start < len(reader):
        raise WrongUsage(f"found --start {start}, expected 0 to {len(reader) - 1}")
    numbers = spread(len(reader), count) if start is None else range(start, min(start + count, len(reader)))
    title = f"{arguments.source}: {len(numbers)} of {len(reader):,} records"
    write_figure(sheet([read_record(reader, number) for number in numbers], title), arguments.out)
    print(f"{arguments.out}: {len(numbers)} of {len(reader):,} records")


def _plot(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.draw.training import training_figure
    from netspec.inspect.logs.training_log import read_log, summary

    names = [printable(name) for name in (arguments.names.split(",") if arguments.names else _names(arguments.logs))]
    if len(names) != len(arguments.logs):
        raise WrongUsage(f"found {len(names)} --names and {len(arguments.logs)} logs, expected equal numbers")
    ending_of(arguments.out)
    logs = [read_log(path, name) for path, name in zip(arguments.logs, names, strict=True)]
    write_figure(training_figure(logs), arguments.out)
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
