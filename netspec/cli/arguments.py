"""The options that several commands of netspec have, and functions that read them."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING, Any

from netspec import log
from netspec.errors import SpecError
from netspec.files.limits import read_amount
from netspec.graph.options import BF16, ENGINES, EXACT, FP32, OPENVINO, PASSES, PRECISIONS, TORCH, BuildOptions
from netspec.graph.speed import speed
from netspec.proto.binary import split_paths
from netspec.proto.forks import use_dialect
from netspec.proto.schema import PHASES
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.parser import CAFFES_LOG

if TYPE_CHECKING:
    from netspec.export.engines.choice import Choice

# Types of values


def positive(text: str) -> int:
    """Read a number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {text}, expected a positive number")
    return value


def blob_shape(text: str) -> tuple[str, tuple[int, ...]]:
    """Read ``BLOB=N,C,H,W``."""
    match = re.fullmatch(r"([^=]+)=(\d+(?:,\d+)*)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected BLOB=N,C,H,W, e.g. data=32,3,224,224")
    return match[1], tuple(int(d) for d in match[2].split(","))


def _int32(text: str) -> int:
    value = int(text)
    if not -(2**31) <= value < 2**31:
        raise argparse.ArgumentTypeError(f"found {text}, expected {-(2**31)} to {2**31 - 1}")
    return value


def _passes(text: str) -> tuple[str, ...]:
    names = () if text == "none" else tuple(text.split(","))
    for name in names:
        if name not in PASSES:
            raise argparse.ArgumentTypeError(f"found {name!r}, expected none, or some of {','.join(PASSES)}")
    return names


def _amount(text: str) -> int:
    try:
        return read_amount(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


# Options of several commands


class _Verbose(argparse.Action):
    """Show the whole log, as Caffe's own commands do."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        for name, value in CAFFES_LOG.items():
            setattr(namespace, name, value)


def add_plugin(parser: argparse.ArgumentParser) -> None:
    """Add ``--plugin``, for commands that read nets; :func:`use_dialects` reads it."""
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="NAME|FILE.py",
        help="a dialect (the layers of a fork of Caffe), by name or as a Python file; may be repeated",
    )


def add_limit(parser: argparse.ArgumentParser) -> None:
    """Add ``--limit``, for commands that build nets."""
    parser.add_argument(
        "--limit",
        type=_amount,
        metavar="SIZE",
        help="refuse a net that needs more memory than this, e.g. 64GiB (default: the machine's memory)",
    )


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """Add ``-v``, for commands that build nets and otherwise show only warnings."""
    parser.add_argument("-v", "--verbose", nargs=0, action=_Verbose, help="show Caffe's log")


def add_net(parser: argparse.ArgumentParser) -> None:
    """Add the net's prototxt, as an argument and as ``--model``; :func:`model` reads them."""
    parser.add_argument("net", nargs="?", metavar="NET", help="the net's prototxt")
    parser.add_argument("--model", metavar="MODEL", help="the net's prototxt, as an option like Caffe's")


def add_gpu(parser: argparse.ArgumentParser, text: str = "number of the GPU to use (default: the CPU)") -> None:
    """Add ``--gpu``."""
    parser.add_argument("--gpu", default="", metavar="GPU", help=text)


def add_phase(
    parser: argparse.ArgumentParser, default: str | None = "TEST", text: str = "phase of the net (default: %(default)s)"
) -> None:
    """Add ``--phase``."""
    parser.add_argument("--phase", type=str.upper, default=default, choices=["TEST", "TRAIN"], help=text)


def add_state(parser: argparse.ArgumentParser) -> None:
    """Add ``--level`` and ``--stage``."""
    parser.add_argument(
        "--level", type=_int32, default=0, metavar="LEVEL", help="level of the NetState (default: %(default)s)"
    )
    parser.add_argument("--stage", default="", metavar="STAGE", help="stages of the NetState, separated by commas")


def add_blob(parser: argparse.ArgumentParser, text: str, required: bool = False) -> None:
    """Add ``--blob``, which takes several names and may be repeated."""
    parser.add_argument("--blob", action="extend", nargs="+", default=[], required=required, metavar="BLOB", help=text)


def add_shape(parser: argparse.ArgumentParser, text: str) -> None:
    """Add ``--shape``, which may be repeated."""
    parser.add_argument("--shape", action="append", type=blob_shape, default=[], metavar="BLOB=N,C,H,W", help=text)


def add_pixels(group: argparse._ArgumentGroup) -> None:
    """Add what is done with the pixels of image files, in this order."""
    group.add_argument("--swap", action="store_true", help="reverse the channels: from BGR to RGB, or back")
    group.add_argument(
        "--raw-scale", type=float, default=1.0, metavar="S", help="then multiply the pixels (0 to 255) by this"
    )
    group.add_argument(
        "--mean",
        metavar="A,B,C|FILE",
        help="then subtract this: one number per channel, in the net's order, or a .binaryproto or .npy file",
    )
    group.add_argument("--scale", type=float, default=1.0, metavar="S", help="then multiply by this")


def add_data(parser: argparse.ArgumentParser, text: str = "open databases, lists and mean files") -> None:
    """Add ``--data``."""
    parser.add_argument("--data", action="store_true", help=text)


def add_strict(parser: argparse.ArgumentParser) -> None:
    """Add ``--strict``."""
    parser.add_argument("--strict", action="store_true", help="refuse weights that lack a layer of the net")


def add_python(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-python-layers``."""
    parser.add_argument(
        "--allow-python-layers", action="store_true", help="allow the net's Python layers to run their code"
    )


def add_iterations(parser: argparse.ArgumentParser) -> None:
    """Add ``--iterations``."""
    parser.add_argument(
        "--iterations", type=positive, default=50, metavar="N", help="batches to run (default: %(default)s)"
    )


def add_exact(parser: argparse.ArgumentParser) -> None:
    """Add ``--exact``."""
    parser.add_argument(
        "--exact",
        default=BuildOptions.exact,
        choices=EXACT,
        help="which sums are bit-identical to Caffe's on the CPU; all is slower (default: %(default)s)",
    )


def add_passes(parser: argparse.ArgumentParser) -> None:
    """Add ``--passes``."""
    parser.add_argument(
        "--passes",
        type=_passes,
        default=PASSES,
        metavar="NAMES",
        help=f"optimizations for a net of phase TEST: {','.join(PASSES)} (the default), some of these, or none",
    )


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add ``--engine`` and its options; :func:`run_by` reads them."""
    parser.add_argument(
        "--engine",
        default=TORCH,
        choices=[*ENGINES, f"{OPENVINO},{BF16}"],
        metavar="NAME",
        help=f"engine that runs the net: {', '.join(ENGINES)} or {OPENVINO},{BF16}, which computes in bfloat16 "
        "(default: %(default)s)",
    )
    parser.add_argument("--precision", choices=PRECISIONS, help=argparse.SUPPRESS)
    parser.add_argument(
        "--cache",
        metavar="DIR|none",
        help="folder to keep exported nets in, or none (default: the user's cache folder)",
    )


def use_dialects(arguments: argparse.Namespace) -> None:
    """Use the dialects of ``--plugin``, for commands that have it."""
    for plugin in getattr(arguments, "plugin", ()):
        use_dialect(plugin)


# Values of the options


def model(arguments: argparse.Namespace) -> str:
    """Return the net's prototxt."""
    named = arguments.net or arguments.model
    if not named or (arguments.net and arguments.model):
        raise WrongUsage(f"name one net: {arguments.prog} net.prototxt")
    return named


def choice(arguments: argparse.Namespace) -> Choice:
    """Return the chosen engine."""
    from netspec.export.engines.choice import Choice

    engine, _, precision = arguments.engine.partition(",")
    if engine == TORCH:
        refuse(arguments, ("cache",), f"is for engines that run exported nets; {TORCH} is not one")
    cache = False if arguments.cache == "none" else arguments.cache
    return Choice.of(engine, precision or arguments.precision or FP32, cache)


_CHOSEN = {name: name for name in ("level", "exact", "strict", "passes", "limit")}
_CHOSEN |= {"allow_python_layers": "allow_python", "data": "open_data"}


def options(arguments: argparse.Namespace, **chosen: Any) -> BuildOptions:
    """Return the options for building a command's nets, from its arguments and ``chosen``, which has priority."""
    values = {field: getattr(arguments, name) for name, field in _CHOSEN.items() if name in arguments}
    if "stage" in arguments:
        values["stages"] = stages(arguments)
    return BuildOptions(**{"speed": speed(), **values, **chosen})


def stages(arguments: argparse.Namespace, as_caffe: bool = False) -> tuple[str, ...]:
    """Return the stages of ``--stage``. With ``as_caffe``, empty names count, as in Caffe: "" is one empty stage."""
    return tuple(stage for stage in arguments.stage.split(",") if stage or as_caffe)


def devices(gpu: str) -> list[Any]:
    """Return the torch devices of ``--gpu``: the CPU if it is empty, every GPU for ``all``, else the listed ones."""
    import torch

    if not gpu:
        return [torch.device("cpu")]
    count = torch.cuda.device_count()
    numbers = [str(k) for k in range(count)] or ["0"] if gpu == "all" else gpu.split(",")
    for number in numbers:
        if not number.isdigit():
            raise SpecError(f"--gpu {gpu}: expected a GPU's number, several numbers separated by commas, or all")
        if int(number) >= count:
            raise SpecError(
                f"--gpu {gpu}: torch finds {count or 'no'} GPU(s) on this machine; omit --gpu to use the CPU"
            )
    return [torch.device("cuda", int(number)) for number in numbers]


def device(gpu: str) -> Any:
    """Return the one torch device of ``--gpu``."""
    first, *others = devices(gpu)
    if others:
        raise SpecError(f"--gpu {gpu}: only training runs on several GPUs; give one number")
    return first


def load(arguments: argparse.Namespace, phase: str, gpu_site: str, cpu_site: str, write_files: bool = True) -> Any:
    """Return the net of ``--model`` on the device of ``--gpu``; the sites are where Caffe logs the device."""
    from netspec.net.build import build_file

    path, chosen = model(arguments), device(arguments.gpu)
    if chosen.type == "cpu":
        log.info(cpu_site, "Use CPU.")
    else:
        log.info(gpu_site, f"Use GPU with device ID {chosen.index}")
    built = options(arguments, device=str(chosen), stages=stages(arguments, as_caffe=True), write_files=write_files)
    return build_file(path, PHASES[phase], built)


def run_by(net: Any, arguments: argparse.Namespace, weights: str | None) -> Any:
    """Return the net, or a version of it that the chosen engine runs; ``weights`` are the files that were loaded."""
    if arguments.engine == TORCH and arguments.precision in (None, FP32) and not arguments.cache:
        return net
    from netspec.export.engines.net import with_engine

    return with_engine(net, choice(arguments), model(arguments), split_paths(weights) if weights else [])
