"""Options that several commands share, and how their values are read."""

from __future__ import annotations

import argparse
import re
from typing import Any

from netspec import log
from netspec.errors import SpecError
from netspec.exact import CHOICES, SMALL
from netspec.export.engines.choice import ENGINES, FP32, PRECISIONS, TORCH, Choice
from netspec.graph.options import BuildOptions
from netspec.graph.steps import PASSES
from netspec.proto.binary import split_paths
from netspec.proto.schema import PHASES
from netspec.terminal.commands import WrongUsage, refuse


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add NET, and Caffe's name for it, ``--model``; :func:`model` returns the one that was given."""
    parser.add_argument("net", nargs="?", metavar="NET", help="the net's prototxt")
    parser.add_argument("--model", help="the same, as Caffe's programs name it")


def model(arguments: argparse.Namespace) -> str:
    """Return the net's prototxt."""
    named = arguments.net or arguments.model
    if not named or (arguments.net and arguments.model):
        raise WrongUsage(f"name one net: {arguments.prog} net.prototxt")
    return named


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--gpu``."""
    parser.add_argument(
        "--gpu",
        default="",
        help="the GPU's number; for training also several: 0,1 or all (default: the solver's choice)",
    )


def add_strict(parser: argparse.ArgumentParser) -> None:
    """Add ``--strict``."""
    parser.add_argument("--strict", action="store_true", help="refuse weights that lack a layer of the net")


def add_exact(parser: argparse.ArgumentParser) -> None:
    """Add ``--exact``."""
    parser.add_argument(
        "--exact",
        choices=CHOICES,
        default=SMALL,
        help=f"which sums equal Caffe's in every bit, on the CPU; all is slower (default: {SMALL})",
    )


def add_passes(parser: argparse.ArgumentParser) -> None:
    """Add ``--passes``."""
    parser.add_argument(
        "--passes",
        type=_passes,
        default=PASSES,
        metavar="NAMES",
        help=f"what may speed up a net of phase TEST: {','.join(PASSES)} (the default), some of these, or none",
    )


def _passes(text: str) -> tuple[str, ...]:
    """Read the names of passes."""
    names = () if text == "none" else tuple(text.split(","))
    for name in names:
        if name not in PASSES:
            raise argparse.ArgumentTypeError(f"found {name!r}, expected none, or some of {','.join(PASSES)}")
    return names


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add ``--engine``, ``--precision`` and ``--cache``."""
    parser.add_argument("--engine", choices=ENGINES, default=TORCH, help=f"what runs the net (default: {TORCH})")
    parser.add_argument(
        "--precision", choices=PRECISIONS, default=FP32, help=f"of the engine's arithmetic (default: {FP32})"
    )
    parser.add_argument(
        "--cache",
        metavar="DIR|none",
        help="keep nets exported for an engine here, or do not keep them (default: the user's cache folder)",
    )


def choice(arguments: argparse.Namespace) -> Choice:
    """Return the engine that is asked for."""
    if arguments.engine == TORCH:
        refuse(arguments, ("cache",), f"is for engines that run exported nets; {TORCH} does not")
    return Choice.of(arguments.engine, arguments.precision, False if arguments.cache == "none" else arguments.cache)


def add_state(parser: argparse.ArgumentParser, phase: str | None) -> None:
    """Add ``--level``, ``--stage`` and, with a default, ``--phase``."""
    if phase:
        parser.add_argument(
            "--phase", default=phase, choices=("TEST", "TRAIN"), type=str.upper, help=f"default: {phase}"
        )
    parser.add_argument("--level", type=_int32, default=0, help="the NetState's level (default: 0)")
    parser.add_argument("--stage", default="", help="the NetState's stages, separated by commas")


def _int32(text: str) -> int:
    value = int(text)
    if not -(2**31) <= value < 2**31:
        raise argparse.ArgumentTypeError(f"found {text}, expected {-(2**31)} to {2**31 - 1}")
    return value


def add_shapes(parser: argparse.ArgumentParser, what: str) -> None:
    """Add ``--shape``, which may be repeated; ``what`` is its help."""
    parser.add_argument("--shape", action="append", default=[], type=shape, metavar="BLOB=N,C,H,W", help=what)


def add_python(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-python-layers``."""
    parser.add_argument(
        "--allow-python-layers", action="store_true", help="allow the net's Python layers to run their code"
    )


def add_steps(parser: argparse.ArgumentParser) -> None:
    """Add ``--swap``, ``--raw-scale``, ``--mean`` and ``--scale``: what is done to the pixels of image files."""
    parser.add_argument("--swap", action="store_true", help="images: reverse the channels, to RGB")
    parser.add_argument(
        "--raw-scale", type=float, default=1.0, metavar="S", help="then multiply pixels, 0 to 255, by this"
    )
    parser.add_argument(
        "--mean",
        metavar="A,B,C|FILE",
        help="then subtract this: numbers in the net's order, or a .binaryproto or .npy",
    )
    parser.add_argument(
        "--scale",
        type=float,
        default=1.0,
        metavar="S",
        help="then multiply by this; these four replace the data layer's transform_param",
    )


def positive(text: str) -> int:
    """Read a whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {text}, expected a positive number")
    return value


def shape(text: str) -> tuple[str, tuple[int, ...]]:
    """Read ``BLOB=N,C,H,W``."""
    match = re.fullmatch(r"([^=]+)=(\d+(?:,\d+)*)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected BLOB=N,C,H,W, e.g. data=32,3,224,224")
    return match[1], tuple(int(d) for d in match[2].split(","))


_CHOSEN = {name: name for name in ("level", "exact", "strict", "passes", "limit")}
_CHOSEN |= {"allow_python_layers": "allow_python", "data": "open_data"}


def options(arguments: argparse.Namespace, **chosen: Any) -> BuildOptions:
    """Return how a command's nets are built: as its options say, and as ``chosen``."""
    said = {field: getattr(arguments, name) for name, field in _CHOSEN.items() if name in arguments}
    if "stage" in arguments:
        said["stages"] = stages(arguments)
    return BuildOptions(**{**said, **chosen})


def stages(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the stages of ``--stage``."""
    return tuple(stage for stage in arguments.stage.split(",") if stage)


def devices(gpu: str) -> list[Any]:
    """Return the torch devices of ``--gpu``: the CPU where it is empty, every GPU for ``all``, else the listed ones."""
    import torch

    if not gpu:
        return [torch.device("cpu")]
    count = torch.cuda.device_count()
    numbers = [str(k) for k in range(count)] or ["0"] if gpu == "all" else gpu.split(",")
    for number in numbers:
        if not number.isdigit():
            raise SpecError(f"--gpu {gpu}: expected the number of a GPU, several numbers separated by commas, or all")
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
    """Return the net of ``--model``, on the device of ``--gpu``; the sites are where Caffe logs the device."""
    from netspec.net.build import load_net

    path, chosen = model(arguments), device(arguments.gpu)
    if chosen.type == "cpu":
        log.info(cpu_site, "Use CPU.")
    else:
        log.info(gpu_site, f"Use GPU with device ID {chosen.index}")
    stages = arguments.stage.split(",")  # without --stage an empty one, as in Caffe
    return load_net(path, PHASES[phase], options(arguments, device=str(chosen), stages=stages, write_files=write_files))


def load_weights(net: Any, paths: str | None, strict: bool) -> None:
    """Load weights from one file after the other; their paths are separated by commas. Something must fit."""
    from netspec.net import weights

    if paths:
        weights.load_weights(net, split_paths(paths), strict, some=True)


def run_by(net: Any, arguments: argparse.Namespace, weights: str | None) -> Any:
    """Return the net of ``--model`` as the chosen engine runs it; ``weights`` are those that were loaded."""
    chosen = choice(arguments)
    if (chosen.engine, chosen.precision) == (TORCH, FP32):
        return net
    from netspec.export.engines.net import with_engine

    return with_engine(net, chosen, model(arguments), split_paths(weights) if weights else [])
