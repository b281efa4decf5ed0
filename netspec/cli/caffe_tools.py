"""Caffe's smaller tools, under their own names."""

from __future__ import annotations

import argparse
import logging

from netspec import log
from netspec.cli.arguments import add_shapes, device, options, positive
from netspec.cli.run import BUILT, READ, Commands
from netspec.files.whole_file import write_whole
from netspec.terminal.commands import WrongUsage


def add_to(commands: Commands) -> None:
    """Add the commands."""
    p = commands.add(
        "extract_features", _extract_features, "write blobs to databases of float Datums (extract_features)", net=BUILT
    )
    p.set_defaults(log_level=logging.WARNING)  # Caffe's tool does not log how it builds the net
    p.add_argument("weights", help="the trained weights")
    p.add_argument("model", help="the net's prototxt, with a data layer")
    p.add_argument("blobs", help="blob names, separated by commas")
    p.add_argument("databases", help="the databases to write, one per blob, separated by commas")
    p.add_argument("batches", type=positive, help="mini-batches to run")
    p.add_argument("db_type", choices=("lmdb", "leveldb"), help="the form of the databases")
    p.add_argument("mode", nargs="?", choices=("CPU", "GPU"), default="CPU", help="where the net runs (default: CPU)")
    p.add_argument("device", nargs="?", default="0", metavar="DEVICE_ID=0", help="the GPU's number")

    p = commands.add("device_query", _device_query, "show the GPUs (caffe device_query)")
    p.add_argument("--gpu", default="all", help="one number, several separated by commas, or all (the default)")

    for name, function, what in (
        ("upgrade_net_proto_text", _upgrade_net_text, "a net's prototxt, or the net inside a .caffemodel,"),
        ("upgrade_net_proto_binary", _upgrade_net_binary, "a .caffemodel"),
        ("upgrade_solver_proto_text", _upgrade_solver_text, "a solver's prototxt"),
    ):
        text_net = name == "upgrade_net_proto_text"
        p = commands.add(name, function, f"write {what} in the current format", net=READ if text_net else 0)
        p.add_argument("input", metavar="IN", help="the file to read")
        p.add_argument("output", metavar="OUT", help="the file to write")
        if text_net:
            add_shapes(p, "of a .caffemodel, whose net is written as a deploy prototxt: the shape of an input")


def _extract_features(arguments: argparse.Namespace) -> None:
    from netspec.inspect.features.records import extract_features as write_features
    from netspec.net.build import load_net

    number = arguments.device.rpartition("=")[2]
    log.error("extract_features.cpp:62", "Using CPU" if arguments.mode == "CPU" else f"Using GPU {number}")
    chosen = options(arguments, device=str(device(number if arguments.mode == "GPU" else "")))
    net = load_net(arguments.model, options=chosen, weights=[arguments.weights])
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


def _upgrade_net_text(arguments: argparse.Namespace) -> None:
    from netspec.proto.binary import is_net_binary
    from netspec.proto.text import read_net, write_text

    if is_net_binary(arguments.input):
        from netspec.net.recovered import recover_net

        net, _ = recover_net(arguments.input, dict(arguments.shape))
    elif arguments.shape:
        raise WrongUsage("--shape is for the net inside a .caffemodel; a prototxt has its own shapes")
    else:
        net = read_net(arguments.input)
    write_whole(arguments.output, write_text(net))
    log.info("upgrade_net_proto_text.cpp:49", f"Wrote upgraded NetParameter text proto to {arguments.output}")


def _upgrade_net_binary(arguments: argparse.Namespace) -> None:
    from netspec.proto.binary import read_net_binary

    write_whole(arguments.output, read_net_binary(arguments.input).SerializeToString())
    log.info("upgrade_net_proto_binary.cpp:49", f"Wrote upgraded NetParameter binary proto to {arguments.output}")


def _upgrade_solver_text(arguments: argparse.Namespace) -> None:
    from netspec.proto.text import read_solver, write_text

    write_whole(arguments.output, write_text(read_solver(arguments.input)))
    log.info("upgrade_solver_proto_text.cpp:49", f"Wrote upgraded SolverParameter text proto to {arguments.output}")
