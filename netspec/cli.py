"""The command line: its commands and their arguments; computes nothing.

Options may be written as gflags let Caffe's users write them: ``-solver s``, ``--solver=s``, ``-gpu 0``.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from netspec import log
from netspec.cli_run import WrongUsage, run, signals
from netspec.errors import SpecError

EFFECTS = ("stop", "snapshot", "none")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 when done, 1 for a fault of the user's files, 2 for wrong usage."""
    return run(_parser(), list(sys.argv[1:] if argv is None else argv))


def train(argv: Sequence[str] | None = None) -> int:
    """Run ``netspec train``: the door ``tools/train.py``."""
    return main(["train", *(sys.argv[1:] if argv is None else argv)])


def extract_features(argv: Sequence[str] | None = None) -> int:
    """Run ``netspec extract_features``: the door ``tools/extract_features``."""
    return main(["extract_features", *(sys.argv[1:] if argv is None else argv)])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="netspec", description="Run Caffe's prototxt in PyTorch, with Caffe's numbers.", allow_abbrev=False
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, function: Callable[[argparse.Namespace], int | None], summary: str
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        added.set_defaults(run=function, log_level=logging.INFO, log_form=log.GlogFormatter())
        plugin = "a dialect: a fork's layers, by the name they come under or by a file of one's own; may be repeated"
        added.add_argument("--plugin", action="append", default=[], metavar="NAME|FILE.py", help=plugin)
        return added

    p = command("train", _train, "train or fine-tune a model (caffe train)")
    p.add_argument("path", nargs="?", metavar="SOLVER", help="the solver's prototxt")
    p.add_argument("--solver", help="the solver's prototxt")
    p.add_argument("--snapshot", help="a .solverstate to resume from")
    p.add_argument("--weights", help="weights to start from, several separated by commas")
    _add_device(p)
    _add_state(p, phase=None)
    p.add_argument("--sigint_effect", choices=EFFECTS, default="stop", help="what Ctrl-C does (default: stop)")
    p.add_argument("--sighup_effect", choices=EFFECTS, default="snapshot", help="default: snapshot")
    _add_python(p)

    p = command("test", _test, "score a model on its TEST-phase data (caffe test)")
    p.add_argument("--model", required=True, help="the net's prototxt")
    p.add_argument("--weights", required=True, help="the trained weights")
    p.add_argument("--iterations", type=_positive, default=50, help="batches to run (default: 50)")
    _add_device(p)
    _add_state(p, phase=None)
    _add_python(p)

    p = command("time", _time, "measure a model's forward and backward milliseconds a layer (caffe time)")
    p.add_argument("--model", required=True, help="the net's prototxt")
    p.add_argument("--iterations", type=_positive, default=50, help="passes to time (default: 50)")
    _add_device(p)
    _add_state(p, phase="TRAIN")
    _add_python(p)

    p = command("check", _check, "build a net, or a solver's nets, without opening data; report every fault")
    p.set_defaults(log_level=logging.WARNING, log_form=logging.Formatter("warning: %(message)s"))
    p.add_argument("file", metavar="FILE", help="a net's or a solver's prototxt")
    _add_state(p, phase="TEST")
    p.add_argument(
        "--shape",
        action="append",
        default=[],
        type=_shape,
        metavar="BLOB=N,C,H,W",
        help="the shape of a data layer's top",
    )
    p.add_argument("--json", action="store_true", help="print blobs, params, inputs and outputs as JSON")
    _add_python(p)

    p = command("extract", _extract, "write blobs, over the records of a data layer or over images, to an .npz")
    p.add_argument("--model", required=True, help="the net's prototxt")
    p.add_argument("--weights", help="the trained weights; without, random ones")
    p.add_argument("--blob", required=True, nargs="+", action="extend", help="the blobs to write")
    p.add_argument("--out", required=True, help="the .npz to write")
    p.add_argument("--source", action="append", default=[], type=_source, metavar="LAYER=DB", help="another database")
    p.add_argument("--iterations", type=_positive, help="batches to run (default: every record once)")
    p.add_argument("--images", metavar="FOLDER|LIST", help="image files instead of records")
    p.add_argument("--input", default="data", help="the blob that images go into (default: data)")
    p.add_argument(
        "--zooms",
        type=_zooms,
        default=(),
        metavar="1,0.7",
        help="of each image the whole and its middle 0.7, one descriptor each",
    )
    p.add_argument(
        "--shape", type=_shape, metavar="BLOB=N,C,H,W", help="that blob's shape, where the data is not at hand"
    )
    _add_device(p)
    _add_state(p, phase="TEST")
    _add_python(p)

    p = command("extract_features", _extract_features, "write blobs to databases of float Datums (extract_features)")
    p.set_defaults(log_level=logging.WARNING)  # Caffe's tool does not tell how it builds the net
    p.add_argument("weights", help="the trained weights")
    p.add_argument("model", help="the net's prototxt, with a data layer")
    p.add_argument("blobs", help="blob names, separated by commas")
    p.add_argument("databases", help="as many databases to write, separated by commas")
    p.add_argument("batches", type=_positive, help="mini-batches to run")
    p.add_argument("db_type", choices=("lmdb", "leveldb"))
    p.add_argument("mode", nargs="?", choices=("CPU", "GPU"), default="CPU")
    p.add_argument("device", nargs="?", default="0", metavar="DEVICE_ID=0")

    p = command("device_query", _device_query, "show the GPUs (caffe device_query)")
    p.add_argument("--gpu", default="all", help="one number, several separated by commas, or all (the default)")

    for name, function, what in (
        ("upgrade_net_proto_text", _upgrade_net_text, "a net's prototxt"),
        ("upgrade_net_proto_binary", _upgrade_net_binary, "a .caffemodel"),
        ("upgrade_solver_proto_text", _upgrade_solver_text, "a solver's prototxt"),
    ):
        p = command(name, function, f"write {what} in the current format")
        p.add_argument("input", metavar="IN")
        p.add_argument("output", metavar="OUT")

    command("layers", _layers, "print the layers it knows, from their own descriptions")
    return parser


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--gpu", default="", help="the GPU; for training also several: 0,1 or all (default: as the solver says)"
    )


def _add_state(parser: argparse.ArgumentParser, phase: str | None) -> None:
    if phase:
        parser.add_argument(
            "--phase", default=phase, choices=("TEST", "TRAIN"), type=str.upper, help=f"default: {phase}"
        )
    parser.add_argument("--level", type=int, default=0, help="the NetState's level (default: 0)")
    parser.add_argument("--stage", default="", help="the NetState's stages, separated by commas")


def _add_python(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--allow-python-layers", action="store_true", help="let Python layers of the net run their code"
    )


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {text}, expected a positive number")
    return value


def _zooms(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers with commas between, e.g. 1,0.7") from None


def _shape(text: str) -> tuple[str, tuple[int, ...]]:
    match = re.fullmatch(r"([^=]+)=(\d+(?:,\d+)*)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected BLOB=N,C,H,W, e.g. data=32,3,224,224")
    return match[1], tuple(int(d) for d in match[2].split(","))


def _source(text: str) -> tuple[str, str]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected LAYER=DB")
    return name, path


def _stages(arguments: argparse.Namespace) -> tuple[str, ...]:
    return tuple(stage for stage in arguments.stage.split(",") if stage)


def _devices(gpu: str) -> list[Any]:
    """Return the torch devices of ``--gpu``: the CPU where it is empty, every GPU for ``all``, else those numbered."""
    import torch

    if not gpu:
        return [torch.device("cpu")]
    count = torch.cuda.device_count()
    numbers = [str(k) for k in range(count)] or ["0"] if gpu == "all" else gpu.split(",")
    for number in numbers:
        if not number.isdigit():
            raise SpecError(f"--gpu {gpu}: expected the number of a GPU, several separated by commas, or all")
        if int(number) >= count:
            raise SpecError(
                f"--gpu {gpu}: this machine has {count or 'no'} GPU(s) that torch can use; leave --gpu out for the CPU"
            )
    return [torch.device("cuda", int(number)) for number in numbers]


def _device(gpu: str) -> Any:
    """Return the one torch device of ``--gpu``."""
    first, *others = _devices(gpu)
    if others:
        raise SpecError(f"--gpu {gpu}: several GPUs are for training; give one number")
    return first


def _bar(description: str, unit: str) -> Callable[[Any], Any]:
    """Return a wrapper that shows a progress bar on a terminal."""
    from tqdm import tqdm

    return lambda items: tqdm(items, desc=description, unit=unit, disable=not sys.stderr.isatty(), leave=False)


def _train(arguments: argparse.Namespace) -> None:
    from tqdm import tqdm

    from netspec.solver.solver import load_solver

    path = arguments.solver or arguments.path
    if not path or (arguments.solver and arguments.path):
        raise WrongUsage("need one solver definition: netspec train solver.prototxt")
    if arguments.snapshot and arguments.weights:
        raise WrongUsage("give a snapshot to resume training or weights to fine-tune, not both")
    effects = {signal.SIGINT: arguments.sigint_effect, signal.SIGHUP: arguments.sighup_effect}
    with signals(effects) as action:
        solver = load_solver(
            path,
            weights=arguments.weights,
            snapshot=arguments.snapshot,
            device=_devices(arguments.gpu) if arguments.gpu else None,
            level=arguments.level,
            stages=tuple(arguments.stage.split(",")),
            allow_python=arguments.allow_python_layers,
            action=action,
        )
        log.info("caffe.cpp:239", "Starting Optimization")
        total, first, hidden = solver.param.max_iter, solver.iteration, not sys.stderr.isatty()
        with tqdm(total=total, initial=first, unit="it", disable=hidden, leave=False) as bar:
            solver.on_iteration = lambda: (bar.update(1), bar.set_postfix_str(f"loss {solver.loss:.4g}", refresh=False))
            solver.solve()
        solver.close()
    log.info("caffe.cpp:250", "Optimization Done.")


def _load(arguments: argparse.Namespace, phase: str, gpu_site: str, cpu_site: str) -> Any:
    from netspec.net import load_net

    device = _device(arguments.gpu)
    if device.type == "cpu":
        log.info(cpu_site, "Use CPU.")
    else:
        log.info(gpu_site, f"Use GPU with device ID {device.index}")
    return load_net(
        arguments.model,
        phase,
        level=arguments.level,
        stages=arguments.stage.split(","),  # without --stage an empty one, as in Caffe
        device=device,
        allow_python=arguments.allow_python_layers,
    )


def _load_weights(net: Any, paths: str | None) -> None:
    """Load weights from one file after the other; their paths are separated by commas."""
    from netspec.weights import load_weights

    for path in paths.split(",") if paths else ():
        load_weights(net, path.strip())


def _test(arguments: argparse.Namespace) -> None:
    from netspec.runs import test_net

    net = _load(arguments, "TEST", "caffe.cpp:266", "caffe.cpp:275")
    _load_weights(net, arguments.weights)
    test_net(net, arguments.iterations)
    net.close()


def _time(arguments: argparse.Namespace) -> None:
    from netspec.runs import time_net

    net = _load(arguments, arguments.phase, "caffe.cpp:340", "caffe.cpp:343")
    time_net(net, arguments.iterations)
    net.close()


def _check(arguments: argparse.Namespace) -> int:
    from netspec.check import as_json, check_file, table
    from netspec.net import PHASES

    shapes = dict(arguments.shape)
    checked = check_file(
        arguments.file,
        PHASES[arguments.phase],
        arguments.level,
        _stages(arguments),
        shapes,
        arguments.allow_python_layers,
    )
    for line in dict.fromkeys(line for part in checked for line in part.advice):
        print(f"warning: {line}", file=sys.stderr)
    faults = dict.fromkeys(str(fault) for part in checked for fault in part.faults)
    if faults:
        print("\n".join(faults), file=sys.stderr)
        return 1
    nets = [(part.label, part.net) for part in checked if part.net is not None]
    if arguments.json:
        found = {label: as_json(net) for label, net in nets}
        print(json.dumps(next(iter(found.values())) if len(found) == 1 else found))
        return 0
    for label, net in nets:
        print(f"{label}: {net.name or 'a net without a name'}\n{table(net)}\n")
    return 0


def _extract(arguments: argparse.Namespace) -> None:
    import numpy as np

    from netspec.extract import extract_images, extract_records, image_net, read_image_list, with_sources
    from netspec.graph.filter import with_state
    from netspec.net import PHASES, BuildOptions, build_net
    from netspec.proto.text import parse_net

    device = _device(arguments.gpu)
    out = Path(arguments.out)
    if not out.parent.is_dir():
        raise SpecError(f"--out {out}: there is no folder {out.parent}; make it first")
    if not arguments.weights:
        log.warning("extract_features.cpp:62", "no --weights: the net has random ones")
    if arguments.images:
        if len(arguments.blob) != 1:
            raise WrongUsage(f"--images takes one --blob, found {len(arguments.blob)}")
        (blob,) = arguments.blob
        if arguments.shape and arguments.shape[0] != arguments.input:
            raise WrongUsage(f"--shape names {arguments.shape[0]}, expected the input blob {arguments.input}")
        images = read_image_list(Path(arguments.images))
        shape = arguments.shape[1] if arguments.shape else None
        net, scaling = image_net(arguments.model, blob, arguments.input, shape, device)
        _load_weights(net, arguments.weights)
        arrays = extract_images(net, scaling, blob, images, progress=_bar("extract", "batch"), zooms=arguments.zooms)
    elif arguments.zooms:
        raise WrongUsage("--zooms are of --images; a data layer's records have their own transform_param")
    else:
        message, source = parse_net(arguments.model)
        stated = with_state(message, PHASES[arguments.phase], arguments.level, _stages(arguments))
        stated = with_sources(stated, source, dict(arguments.source))
        net = build_net(stated, source, BuildOptions(device, allow_python=arguments.allow_python_layers))
        _load_weights(net, arguments.weights)
        arrays = extract_records(net, arguments.blob, arguments.iterations, _bar("extract", "batch"))
    net.close()
    with out.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _extract_features(arguments: argparse.Namespace) -> None:
    from netspec.extract_features import extract_features as write_features
    from netspec.net import load_net

    number = arguments.device.rpartition("=")[2]
    log.error("extract_features.cpp:62", "Using CPU" if arguments.mode == "CPU" else f"Using GPU {number}")
    net = load_net(
        arguments.model, "TEST", arguments.weights, device=_device(number if arguments.mode == "GPU" else "")
    )
    write_features(
        net, arguments.blobs.split(","), arguments.databases.split(","), arguments.batches, arguments.db_type
    )
    net.close()


def _device_query(arguments: argparse.Namespace) -> None:
    import torch

    log.info("caffe.cpp:142", f"Querying GPUs {arguments.gpu}")
    count = torch.cuda.device_count()
    numbers = range(count) if arguments.gpu == "all" else [_device(n).index for n in arguments.gpu.split(",")]
    if not count:
        raise SpecError("torch finds no GPU on this machine")
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
    from netspec.proto.text import read_net, write_text

    _write(arguments.output, write_text(read_net(arguments.input)).encode())
    log.info("upgrade_net_proto_text.cpp:49", f"Wrote upgraded NetParameter text proto to {arguments.output}")


def _upgrade_net_binary(arguments: argparse.Namespace) -> None:
    from netspec.proto.binary import read_net_binary

    _write(arguments.output, read_net_binary(arguments.input).SerializeToString())
    log.info("upgrade_net_proto_binary.cpp:49", f"Wrote upgraded NetParameter binary proto to {arguments.output}")


def _upgrade_solver_text(arguments: argparse.Namespace) -> None:
    from netspec.proto.text import read_solver, write_text

    _write(arguments.output, write_text(read_solver(arguments.input)).encode())
    log.info("upgrade_solver_proto_text.cpp:49", f"Wrote upgraded SolverParameter text proto to {arguments.output}")


def _write(path: str, data: bytes) -> None:
    try:
        Path(path).write_bytes(data)
    except OSError as fault:
        raise SpecError(f"{path}: cannot be written: {fault.strerror}") from None


def _layers(arguments: argparse.Namespace) -> None:
    from netspec.layers import layer_class, layer_types

    for name in layer_types():
        cls = layer_class(name)
        first = ((cls and cls.__doc__) or "").strip().splitlines()[0]
        print(f"{name:28} {first}")
