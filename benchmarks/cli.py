"""Time netspec, loopclosure and comparable programs, for the tables in the documentation."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.report import Row
from netspec.terminal.commands import WrongUsage, run
from netspec.terminal.parser import Commands, Parser

ENGINES = ("netspec", "netspec-onnxruntime", "netspec-openvino", "netspec-openvino-bf16")
FORWARD = (*ENGINES, "pytorch", "opencv4", "onnxruntime", "openvino", "openvino-bf16", "pycaffe")
WHOLE = ("mtcnn", "ssd300", "files", "classifier", "training", "start")
TRAINING = ("netspec", "netspec-bf16", "pycaffe", "pytorch", "pytorch-bf16")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status, as netspec's commands do."""
    words = list(sys.argv[1:] if argv is None else argv)
    made = parser()
    made.set_defaults(words=words)
    return run(made, words)


def parser() -> Parser:
    """Return the parser of all commands."""
    made = Parser(prog="tools/bench", description=__doc__)
    commands = Commands(made, log_level=logging.WARNING)
    _add_forward(commands)
    _add_train(commands)
    _add_whole(commands)
    _add_growth(commands)
    _add_revisits(commands)
    _add_tables(commands)
    commands.add_parser("pages", _pages, help="write the results in benchmarks/results into the documentation")
    commands.add_parser("list", _list, help="list the nets of the catalog")
    return made


def _add_common(parser: argparse.ArgumentParser, known: Sequence[str], default: Sequence[str]) -> None:
    parser.add_argument(
        "--with",
        dest="programs",
        nargs="+",
        choices=known,
        default=list(default),
        help=f"programs to time (default: {' '.join(default)})",
    )
    parser.add_argument(
        "--rounds", type=int, default=9, help="number of rounds; every program runs once per round (default: 9)"
    )
    _add_json(parser)
    parser.add_argument("--batch", type=int, nargs="+", default=[1], help="one or several batch sizes (default: 1)")
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1], help="one or several numbers of threads (default: 1)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=60,
        help="time limit for one net, batch size and number of threads; at least 3 rounds are run (default: 60)",
    )


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json", metavar="FILE", help="write all results and a description of the machine to this file"
    )


def _add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="folder that contains sequences, tum_fr1, place_pairs, ...",
    )
    parser.add_argument(
        "--work", type=Path, required=True, metavar="FOLDER", help="folder for images, descriptors and results"
    )


def _add_revisits(commands: Commands) -> None:
    parser = commands.add_parser(
        "revisits", _revisits, help="measure what loopclosure finds on real drives that come back"
    )
    _add_data(parser)
    parser.add_argument("drives", nargs="*", metavar="DRIVE", help="how the names of the drives begin (default: all)")


def _revisits(arguments: argparse.Namespace) -> None:
    from benchmarks.revisits import measure

    measure(arguments.data, arguments.work, arguments.drives, partial(print, flush=True), arguments.words)


def _add_tables(commands: Commands) -> None:
    parser = commands.add_parser(
        "tables", _tables, help="measure loopclosure's methods for the tables in the documentation"
    )
    _add_data(parser)
    parser.add_argument("sets", nargs="*", metavar="SET", help="data sets to measure (default: all)")
    parser.add_argument(
        "--methods",
        nargs="+",
        default=[],
        metavar="NAME",
        help="methods to measure, by their names in the tables (default: all)",
    )


def _tables(arguments: argparse.Namespace) -> None:
    from benchmarks.tables import measure

    say = partial(print, flush=True)
    measure(arguments.data, arguments.work, arguments.sets, arguments.methods, say, arguments.words)


def _pages(arguments: argparse.Namespace) -> None:
    from benchmarks import pages

    print("\n".join(f"written: {page.relative_to(pages.ROOT)}" for page in pages.write()) or "no number changed")


def _list(arguments: argparse.Namespace) -> None:
    from benchmarks.case import CATALOG

    print("\n".join(CATALOG))


def _add_forward(commands: Commands) -> None:
    parser = commands.add_parser("forward", _forward, help="compare the time of forward passes with other programs")
    parser.add_argument("nets", nargs="+", metavar="NET", help="a net of the catalog (see list), or a prototxt")
    parser.add_argument("--weights", help="a .caffemodel for the prototxt (default: random weights)")
    _add_common(parser, FORWARD, (*ENGINES, "pytorch", "opencv4"))


def _forward(arguments: argparse.Namespace) -> None:
    from benchmarks.case import forward_case

    def case(name: str, batch: int) -> Any:
        needs_onnx = any(program.startswith(("onnxruntime", "openvino")) for program in arguments.programs)
        return forward_case(name, batch, arguments.weights, needs_onnx)

    _compare(arguments, case, training=False)


def _add_train(commands: Commands) -> None:
    parser = commands.add_parser("train", _train, help="time training iterations: forward, backward, update")
    parser.add_argument("nets", nargs="+", metavar="NET", help="a net of the catalog (see list)")
    _add_common(parser, TRAINING, ("netspec", "pytorch"))
    parser.add_argument("--device", default="cpu", help="torch device for netspec and pytorch (default: cpu)")


def _train(arguments: argparse.Namespace) -> None:
    from benchmarks.case import training_case

    if arguments.device != "cpu" and "pycaffe" in arguments.programs:
        raise WrongUsage("only netspec and pytorch can be timed on a device other than the CPU")
    _compare(arguments, training_case, training=True, device=arguments.device)


def _add_growth(commands: Commands) -> None:
    parser = commands.add_parser("growth", _growth, help="measure how the search grows with the frames of a drive")
    parser.add_argument("sizes", type=int, nargs="+", metavar="FRAMES", help="numbers of frames")
    _add_json(parser)


def _growth(arguments: argparse.Namespace) -> None:
    from benchmarks import growth

    rows = growth.measure(arguments.sizes)
    print(growth.table(rows))
    _keep(arguments, rows)


def _keep(arguments: argparse.Namespace, rows: Sequence[Any], described: Any = None) -> None:
    from benchmarks import results

    if arguments.json:
        results.write(arguments.json, rows, arguments.words, described)


def _add_whole(commands: Commands) -> None:
    parser = commands.add_parser("programs", _whole, help="time whole programs: detectors, files, a training, a start")
    parser.set_defaults(programs=["opencv4"])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"programs to time: {', '.join(WHOLE)} (default: all)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads (default: 1 2)")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds (default: 3)")
    _add_json(parser)


def _whole(arguments: argparse.Namespace) -> None:
    from benchmarks.whole import How, measure

    def rows(separate_python: str | None) -> Iterator[list[Row]]:
        return measure(arguments.names or WHOLE, How(arguments.threads, arguments.rounds, separate_python))

    _report(arguments, rows)


def _compare(
    arguments: argparse.Namespace,
    case_of: Callable[[str, int], Any],
    training: bool,
    device: str = "cpu",
) -> None:
    from benchmarks.compare import Comparison, rows_of

    def rows(separate_python: str | None) -> Iterator[list[Row]]:
        how = Comparison(arguments.programs, training, arguments.rounds, separate_python, arguments.seconds, device)
        for name in arguments.nets:
            for batch in arguments.batch:
                with case_of(name, batch) as case:
                    for threads in arguments.threads:
                        yield rows_of(case, threads, how)

    _report(arguments, rows)


def _report(arguments: argparse.Namespace, rows_of: Callable[[str | None], Iterator[list[Row]]]) -> None:
    """Print a table for each list of rows, and the programs that could not run; write all rows."""
    from benchmarks import environment, report, results
    from benchmarks.compare import IN_SEPARATE_ENVIRONMENT

    separate_python = environment.python() if set(arguments.programs) & set(IN_SEPARATE_ENVIRONMENT) else None
    described, rows = results.machine(separate_python), []
    for found in rows_of(separate_python):
        rows += found
        print(report.table(found), flush=True)
        for row in found:
            if row.fault:
                print(f"{row.name}: {row.fault}", file=sys.stderr)
        _keep(arguments, [report.columns(row) for row in rows], described)
