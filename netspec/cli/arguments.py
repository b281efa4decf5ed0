"""What the commands of netspec share: their dialects, the options of several of them, and how values are read."""

from __future__ import annotations

import argparse
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from netspec import log
from netspec.errors import SpecError
from netspec.exact import CHOICES, SMALL
from netspec.export.engines.choice import BF16, ENGINES, FP32, OPENVINO, PRECISIONS, TORCH, Choice
from netspec.files.limits import read_amount
from netspec.graph.options import PASSES, BuildOptions
from netspec.load import speed
from netspec.proto.binary import split_paths
from netspec.proto.forks import forks
from netspec.proto.schema import PHASES
from netspec.terminal import commands
from netspec.terminal.commands import WrongUsage, refuse

_WARNINGS = logging.Formatter("warning: %(message)s")
_HOW: dict[str, dict[str, Any]] = {  # words that a table has behind the name of a command
    "quiet": {"log_level": logging.WARNING, "log_form": _WARNINGS},
    "warnings": {"log_level": logging.WARNING},  # Caffe's, in the form of its log
    "silent": {"log_form": None},
    "compares": {"fault_status": commands.UNREADABLE},
    "read": {},  # it reads the files of nets
    "built": {},  # it makes nets, which takes memory
}
_PLUGIN = "a dialect (the layers of a Caffe fork): its name, or a Python file of your own; may be repeated"
_LIMIT = "memory that a net may need, e.g. 64GiB; more is refused (default: this machine's)"


def _passes(text: str) -> tuple[str, ...]:
    names = () if text == "none" else tuple(text.split(","))
    for name in names:
        if name not in PASSES:
            raise argparse.ArgumentTypeError(f"found {name!r}, expected none, or some of {','.join(PASSES)}")
    return names


def _int32(text: str) -> int:
    value = int(text)
    if not -(2**31) <= value < 2**31:
        raise argparse.ArgumentTypeError(f"found {text}, expected {-(2**31)} to {2**31 - 1}")
    return value


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"found {text}, expected a positive number")
    return value


def _tolerance(text: str) -> float:
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number of at least 0")
    return value


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


def _zooms(text: str) -> tuple[float, ...]:
    from netspec.inspect.features.scaling import read_zooms

    try:
        return read_zooms(text)
    except SpecError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _amount(text: str) -> int:
    try:
        return read_amount(text)
    except ValueError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


_TYPES: dict[str, Callable[[str], Any]] = {  # by the word for a value
    "N": _positive,
    "K": int,
    "S": float,
    "SECONDS": float,
    "X": _tolerance,
    "LEVEL": _int32,
    "NAMES": _passes,
    "BLOB=N,C,H,W": _shape,
    "LAYER=DB": _source,
    "1,0.7": _zooms,
    "{TEST|TRAIN}": str.upper,
    **dict.fromkeys(("OUT", "PREFIX", "F.svg|F.png|F.html", "F.py", "FOLDER"), Path),
}
_SHARED = {
    "net": """
  [net] NET                        the net's prototxt
  --model MODEL                    the same, as Caffe's programs name it""",
    "gpu": """
  --gpu= GPU                       the GPU's number; for training also several: 0,1 or all (default: the solver's
                                   choice)""",
    "files": """
  input IN                         the file to read
  output OUT                       the file to write""",
    "phase": """
  --phase=TEST {TEST|TRAIN}        default: TEST""",
    "part": """
  --blob+ BLOB                     only the layers that compute these blobs
  --shape... BLOB=N,C,H,W          the shape of an input or a data layer's top
  @phase @state @python""",
    "picture": """
  --out! F.png|svg                 the picture to write""",
    "described": """
  net NET                          the net's prototxt
  --weights! WEIGHTS               the trained weights, several separated by commas
  --blob! BLOB                     the blob
  --input=data BLOB                the blob that the image goes into (default: data)
  --shape BLOB=N,C,H,W             its shape, if its data is not available
  @steps""",
    "state": """
  --level=0 LEVEL                  the NetState's level (default: 0)
  --stage= STAGE                   the NetState's stages, separated by commas""",
    "strict": """
  --strict                         refuse weights that lack a layer of the net""",
    "python": """
  --allow-python-layers            allow the net's Python layers to run their code""",
    "exact": f"""
  --exact={SMALL} {{{"|".join(CHOICES)}}}   which sums equal Caffe's in every bit, on the CPU; all is slower
                                   (default: {SMALL})""",
    "passes": f"""
  --passes={",".join(PASSES)} NAMES   what may speed up a net of phase TEST: {",".join(PASSES)} (the default), some of
                                   these, or none""",
    "engine": f"""
  --engine={TORCH} {{{"|".join(ENGINES)}|{OPENVINO},{BF16}}}   what runs the net (default: {TORCH}); with
                                   ,{BF16} it computes in bfloat16
  --precision {{{"|".join(PRECISIONS)}}}
  --cache DIR|none                 keep nets exported for an engine here, or do not keep them (default: the user's
                                   cache folder)""",
    "steps": """
  --swap                           images: reverse the channels, to RGB
  --raw-scale=1 S                  then multiply pixels, 0 to 255, by this
  --mean A,B,C|FILE                then subtract this: numbers in the net's order, or a .binaryproto or .npy
  --scale=1 S                      then multiply by this; these four replace the data layer's transform_param""",
}


class Commands(commands.Commands):
    """Commands of netspec: ``--plugin``, ``--limit`` and ``-v`` are of those that read or make nets."""

    types, shared = _TYPES, _SHARED

    def add(self, name: str, function: commands.Function, summary: str, *how: str) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``.

        A command of Caffe shows Caffe's log. A ``quiet`` command shows only warnings and, if it makes nets (``built``),
        the log with ``-v``; a ``silent`` one shows none.
        """
        added = super().add(name, function, summary)
        added.set_defaults(plugin=[], limit=None, begin=_use_dialects)
        for word in how:
            added.set_defaults(**_HOW[word])
        if "quiet" in how and "built" in how:
            added.add_argument("-v", "--verbose", nargs=0, action=_Verbose, help="show Caffe's log")
        if "read" in how or "built" in how:
            added.add_argument("--plugin", action="append", default=[], metavar="NAME|FILE.py", help=_PLUGIN)
        if "built" in how:
            added.add_argument("--limit", type=_amount, metavar="SIZE", help=_LIMIT)
        return added


def _use_dialects(arguments: argparse.Namespace) -> None:
    for plugin in arguments.plugin:
        forks().use(plugin)


class _Verbose(argparse.Action):
    """Show the whole log, like the commands that Caffe has."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        namespace.log_level, namespace.log_form = logging.INFO, log.GlogFormatter()


def model(arguments: argparse.Namespace) -> str:
    """Return the net's prototxt."""
    named = arguments.net or arguments.model
    if not named or (arguments.net and arguments.model):
        raise WrongUsage(f"name one net: {arguments.prog} net.prototxt")
    return named


def choice(arguments: argparse.Namespace) -> Choice:
    """Return the engine that is asked for."""
    engine, _, precision = arguments.engine.partition(",")
    if engine == TORCH:
        refuse(arguments, ("cache",), f"is for engines that run exported nets; {TORCH} does not")
    cache = False if arguments.cache == "none" else arguments.cache
    return Choice.of(engine, precision or arguments.precision or FP32, cache)


_CHOSEN = {name: name for name in ("level", "exact", "strict", "passes", "limit")}
_CHOSEN |= {"allow_python_layers": "allow_python", "data": "open_data"}


def options(arguments: argparse.Namespace, **chosen: Any) -> BuildOptions:
    """Return how a command's nets are built: as its options say, and as ``chosen``."""
    said = {field: getattr(arguments, name) for name, field in _CHOSEN.items() if name in arguments}
    if "stage" in arguments:
        said["stages"] = stages(arguments)
    return BuildOptions(**{"speed": speed(), **said, **chosen})


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
