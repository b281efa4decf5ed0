"""``netspec extract_features``, ``device_query`` and the ``upgrade_*`` commands, as Caffe's tools."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from netspec import log
from netspec.cli.arguments import add_limit, add_plugin, device, options, positive
from netspec.files.whole_file import write_whole
from netspec.proto.schema import TEST
from netspec.terminal.parser import Commands


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_extract_features(commands)
    parser = commands.add_parser("device_query", _device_query, help="show the GPUs (caffe device_query)")
    parser.add_argument(
        "--gpu", default="all", metavar="GPU", help="one number, several separated by commas, or all (the default)"
    )
    for name, (function, text) in _UPGRADES.items():
        parser = commands.add_parser(name, function, help=text)
        if function is _upgrade_net_proto_text:
            add_plugin(parser)
        parser.add_argument("input", metavar="IN", help="the file to read")
        parser.add_output("output", type=Path, metavar="OUT", help="the file to write")


def _add_extract_features(commands: Commands) -> None:
    parser = commands.add_parser(
        "extract_features", _extract_features, help="write blobs to databases of float Datums (extract_features)"
    )
    parser.set_defaults(log_level=logging.WARNING)
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("weights", metavar="WEIGHTS", help="the trained weights")
    parser.add_argument("model", metavar="MODEL", help="the net's prototxt, with a data layer")
    parser.add_argument("blobs", metavar="BLOBS", help="blob names, separated by commas")
    parser.add_argument(
        "databases", metavar="DATABASES", help="databases to write, one for each blob, separated by commas"
    )
    parser.add_argument("batches", type=positive, metavar="N", help="mini-batches to run")
    parser.add_argument("db_type", choices=["lmdb", "leveldb"], help="format of the databases")
    parser.add_argument(
        "mode", nargs="?", default="CPU", choices=["CPU", "GPU"], help="where the net runs (default: %(default)s)"
    )
    parser.add_argument("device", nargs="?", default="0", metavar="DEVICE_ID=0", help="the GPU's number")


def _extract_features(arguments: argparse.Namespace) -> None:
    from netspec.inspect.features.records import extract_features as write_features
    from netspec.net.build import build_file
    from netspec.net.weights import load_weights

    number = arguments.device.rpartition("=")[2]
    log.error("extract_features.cpp:62", "Using CPU" if arguments.mode == "CPU" else f"Using GPU {number}")
    chosen = options(arguments, device=str(device(number if arguments.mode == "GPU" else "")))
    net = build_file(arguments.model, TEST, chosen)
    load_weights(net, arguments.weights, chosen.strict)
    write_features(
        net, arguments.blobs.split(","), arguments.databases.split(","), arguments.batches, arguments.db_type
    )
    net.close()


def _device_query(arguments: argparse.Namespace) -> None:
    import torch

    log.info("caffe.cpp:142", f"Querying GPUs {arguments.gpu}")
    count = torch.cuda.device_count()
    if not count:
        log.info("common.cpp:178", "No GPU: torch finds none on this machine")
        return
    numbers = range(count) if arguments.gpu == "all" else [device(n).index for n in arguments.gpu.split(",")]
    for number in numbers:
        properties = torch.cuda.get_device_properties(number)
        for title, value in (
            ("Device id:", number),
            ("Major revision number:", properties.major),
            ("Minor revision number:", properties.minor),
            ("Name:", properties.name),
            ("Total global memory:", properties.total_memory),
            ("Number of multiprocessors:", properties.multi_processor_count),
        ):
            log.info("common.cpp:178", f"{title:<31}{value}")


def _upgrade_net_proto_text(arguments: argparse.Namespace) -> None:
    from netspec.proto.text import read_net, write_text

    write_whole(arguments.output, write_text(read_net(arguments.input)))
    log.info("upgrade_net_proto_text.cpp:49", f"Wrote upgraded NetParameter text proto to {arguments.output}")


def _upgrade_net_proto_binary(arguments: argparse.Namespace) -> None:
    from netspec.proto.binary import read_net_binary

    write_whole(arguments.output, read_net_binary(arguments.input).SerializeToString())
    log.info("upgrade_net_proto_binary.cpp:49", f"Wrote upgraded NetParameter binary proto to {arguments.output}")


def _upgrade_solver_proto_text(arguments: argparse.Namespace) -> None:
    from netspec.proto.text import read_solver, write_text

    write_whole(arguments.output, write_text(read_solver(arguments.input)))
    log.info("upgrade_solver_proto_text.cpp:49", f"Wrote upgraded SolverParameter text proto to {arguments.output}")


_UPGRADES = {
    "upgrade_net_proto_text": (_upgrade_net_proto_text, "write a net's prototxt in the current format"),
    "upgrade_net_proto_binary": (_upgrade_net_proto_binary, "write a .caffemodel in the current format"),
    "upgrade_solver_proto_text": (_upgrade_solver_proto_text, "write a solver's prototxt in the current format"),
}
