"""``netspec export`` and ``netspec fold``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from netspec import log
from netspec.cli.arguments import add_python, add_shapes, add_state, options
from netspec.cli.run import BUILT, Commands
from netspec.files.limits import amount
from netspec.proto.binary import split_paths
from netspec.terminal.commands import refuse

EXPORT = """Write a net in another form, with its weights.

--to onnx         an ONNX model (opset 21), batch, height and width free where the net allows it;
                  weights of more than 2 GB go into a file beside it
--to torch        the source of a PyTorch module, OUT.py, and its weights, OUT.safetensors beside it
--to pt2          a torch.export archive
--to safetensors  the weights alone: LAYER.INDEX, in Caffe's order

Layers that read data become inputs; --shape says what they read, where the prototxt does not."""
WRITTEN = {
    "onnx": "an ONNX model",
    "torch": "the source of a PyTorch module",
    "pt2": "a torch.export archive",
    "safetensors": "weights",
}


def add_to(commands: Commands) -> None:
    """Add the commands."""
    summary = "write a net as ONNX, PyTorch source, a torch.export archive or safetensors"
    p = commands.add("export", _export, summary, quiet=True, net=BUILT)
    p.description, p.formatter_class = EXPORT, argparse.RawDescriptionHelpFormatter
    p.add_argument("file", metavar="FILE", help="the net's prototxt")
    p.add_argument("--to", required=True, choices=("onnx", "torch", "pt2", "safetensors"), help="the form")
    p.add_argument("--weights", help="the trained weights (default: random weights)")
    p.add_argument("--out", required=True, type=Path, help="the file to write")
    _add_source(p)
    p.add_argument(
        "--no-labels", action="store_true", help="leave out labels, and the losses and accuracies that need them"
    )
    p.add_argument("--input", default="data", metavar="BLOB", help="the input for the options below (default: data)")
    p.add_argument("--crop", action="store_true", help="ONNX: take the middle of larger images")
    p.add_argument("--swap", action="store_true", help="ONNX: images come with reversed channels (RGB for BGR)")
    p.add_argument("--raw-scale", type=float, default=1.0, metavar="S", help="ONNX: multiply images by this first")
    p.add_argument(
        "--mean", metavar="A,B,C|FILE", help="ONNX: then subtract this, numbers or a .binaryproto or .npy file"
    )
    p.add_argument("--scale", type=float, default=1.0, metavar="S", help="ONNX: then multiply by this")
    p.add_argument("--uint8", action="store_true", help="ONNX: images are bytes")
    summary = "write the deploy net with BatchNorm and Scale folded in: OUT.prototxt, OUT.caffemodel"
    p = commands.add("fold", _fold, summary, quiet=True, net=BUILT)
    p.add_argument("file", metavar="MODEL", help="the net's prototxt; of a training net, labels and losses are removed")
    p.add_argument("--weights", required=True, help="the trained weights")
    p.add_argument("--out", required=True, type=Path, metavar="PREFIX", help="write PREFIX.prototxt and .caffemodel")
    _add_source(p)


def _add_source(p: argparse.ArgumentParser) -> None:
    p.add_argument("--blob", nargs="+", action="extend", default=[], help="only the layers that compute these blobs")
    add_shapes(p, "the shape of an input or a data layer's top")
    add_state(p, phase="TEST")
    add_python(p)


def _source(arguments: argparse.Namespace, labels: bool) -> Any:
    from netspec.export.formats.convert import Source

    weights = [Path(path) for path in split_paths(arguments.weights)] if arguments.weights else []
    if not weights:
        log.logger.warning("no --weights given: the weights are random")
    return Source(
        Path(arguments.file),
        weights,
        arguments.phase,
        options(arguments, given_shapes=dict(arguments.shape)),
        arguments.blob,
        labels,
    )


def _export(arguments: argparse.Namespace) -> None:
    from netspec.data.mean import read_mean_option
    from netspec.export.formats.convert import export_net
    from netspec.export.formats.preprocess import Preprocess

    steps = Preprocess(
        arguments.input,
        None if arguments.mean is None else read_mean_option(arguments.mean),
        arguments.scale,
        arguments.raw_scale,
        arguments.swap,
        arguments.crop,
        arguments.uint8,
    )
    if arguments.to != "onnx":
        refuse(arguments, ("input", "crop", "swap", "raw_scale", "mean", "scale", "uint8"), "needs --to onnx")
    elif not steps.changes_images:
        refuse(
            arguments, ("input",), "says which input --crop, --swap, --raw-scale, --mean, --scale and --uint8 change"
        )
    source = _source(arguments, not arguments.no_labels)
    for line in export_net(source, arguments.to, arguments.out, steps if steps.changes_images else None):
        print(f"note: {line}", file=sys.stderr)
    print(f"{arguments.out}: {WRITTEN[arguments.to]}, {amount(arguments.out.stat().st_size)}")


def _fold(arguments: argparse.Namespace) -> None:
    from netspec.export.formats.convert import fold_files

    before, after = fold_files(_source(arguments, labels=False), arguments.out)
    print(f"{arguments.out}.prototxt and {arguments.out}.caffemodel: {after} layers of {before}")
