"""``netspec extract``, ``export`` and ``fold``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from netspec import log
from netspec.cli.arguments import (
    add_blob,
    add_engine,
    add_exact,
    add_gpu,
    add_limit,
    add_net,
    add_passes,
    add_phase,
    add_pixels,
    add_plugin,
    add_python,
    add_shape,
    add_state,
    add_strict,
    add_verbose,
    blob_shape,
    choice,
    device,
    model,
    options,
    positive,
    run_by,
    stages,
)
from netspec.errors import SpecError
from netspec.files.limits import amount
from netspec.files.whole_file import whole_file
from netspec.graph.options import OPSET
from netspec.proto.binary import split_paths
from netspec.proto.schema import PHASES
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands, Parser


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_extract(commands)
    _add_export(commands)
    _add_fold(commands)


def _layer_source(text: str) -> tuple[str, str]:
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


def _add_extract(commands: Commands) -> None:
    parser = commands.add_parser(
        "extract", _extract, help="write blobs to an .npz file, for the records of a data layer or for images"
    )
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    add_net(parser)
    parser.add_argument("--weights", metavar="WEIGHTS", help="the trained weights (default: random weights)")
    add_blob(parser, required=True, text="the blobs to write")
    parser.add_output("--out", type=Path, required=True, metavar="OUT", help="the .npz to write")
    parser.add_argument(
        "--source",
        action="append",
        type=_layer_source,
        default=[],
        metavar="LAYER=DB",
        help="let data layer LAYER read this database instead of its own",
    )
    parser.add_argument("--iterations", type=positive, metavar="N", help="batches to run (default: every record once)")
    add_gpu(parser)
    add_phase(parser)
    add_state(parser)
    add_python(parser)
    add_exact(parser)
    add_passes(parser)
    add_strict(parser)
    add_engine(parser)
    group = parser.add_argument_group(
        "image files", "With any of the last four options, the data layer's transform_param is not used."
    )
    group.add_argument("--images", metavar="FOLDER|LIST", help="use image files instead of records")
    group.add_argument(
        "--input", default="data", metavar="BLOB", help="the blob that images go into (default: %(default)s)"
    )
    group.add_argument(
        "--zooms",
        type=_zooms,
        metavar="1,0.7",
        help="describe several views of each image, e.g. the whole (1) and its center (0.7)",
    )
    group.add_argument(
        "--shape", type=blob_shape, metavar="BLOB=N,C,H,W", help="the input blob's shape, if its data is not available"
    )
    add_pixels(group)


def _extract(arguments: argparse.Namespace) -> None:
    import numpy as np

    model(arguments)
    out = arguments.out
    if not arguments.weights:
        log.logger.warning("no --weights given: the weights are random")
    arrays = _over_images(arguments) if arguments.images else _over_records(arguments)
    for name in ("features",) if arguments.images else arguments.blob:
        if len(rows := np.flatnonzero(~np.all(np.isfinite(arrays[name]), axis=1))):
            said = f"{len(rows)} of {len(arrays[name])} rows have a NaN or an infinity, the first is row {rows[0]}"
            log.logger.warning(f"{name}: {said} (from 0); did the net diverge?")
    if os.environ.get("SOURCE_DATE_EPOCH"):  # reproducible files contain no measured times
        arrays.update({name: np.array(np.nan) for name in arrays if name.startswith("seconds_per_")})
    with whole_file(out) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    _print_arrays(out, arrays)


def _over_images(arguments: argparse.Namespace) -> dict[str, Any]:
    from netspec.files.image_list import list_images
    from netspec.inspect.features.images import ImageInput, ImageNet, extract_images
    from netspec.inspect.features.scaling import Steps

    records = ("source", "iterations", "phase", "level", "stage", "allow_python_layers")
    refuse(arguments, records, "is for records; --images reads files and uses phase TEST")
    if len(arguments.blob) != 1:
        raise WrongUsage(f"--images needs exactly one --blob, found {len(arguments.blob)}")
    if arguments.shape and arguments.shape[0] != arguments.input:
        raise WrongUsage(f"--shape names {arguments.shape[0]}, expected the input blob {arguments.input}")
    steps = Steps.of(arguments.mean, arguments.scale, arguments.raw_scale, arguments.swap)
    images = list_images(arguments.images)
    weights = split_paths(arguments.weights) if arguments.weights else []
    given = arguments.shape[1] if arguments.shape else None
    (blob,) = arguments.blob
    chosen = device(arguments.gpu) if arguments.gpu else "cpu"  # without torch, where the engine needs none
    net = ImageNet(
        model(arguments),
        weights,
        blob,
        ImageInput(arguments.input, given, arguments.zooms or (1.0,), steps),
        choice(arguments),
        options(arguments, device=str(chosen)),
    )
    size, kind = " x ".join(map(str, net.shape)), "gray" if net.shape[0] == 1 else "RGB" if net.scaling.swap else "BGR"
    print(f"{model(arguments)}: {blob} of {len(images.paths)} images from {arguments.images}")
    print(f"{arguments.input} ({size}): {kind}, {net.scaling}")
    return extract_images(net, images, partial(bar, stage="extract", unit="batch"))


def _over_records(arguments: argparse.Namespace) -> dict[str, Any]:
    from netspec.graph.filter import with_state
    from netspec.inspect.features.records import extract_records, with_sources
    from netspec.net.build import build_net
    from netspec.net.weights import load_weights
    from netspec.proto.text import parse_net

    images = ("input", "shape", "zooms", "swap", "raw_scale", "mean", "scale")
    refuse(arguments, images, "is for --images; a data layer's records have its shape and its transform_param")
    message, source = parse_net(model(arguments))
    stated = with_state(message, PHASES[arguments.phase], arguments.level, stages(arguments))
    stated = with_sources(stated, source, dict(arguments.source))
    net = build_net(stated, source, options(arguments, device=str(device(arguments.gpu))))
    if arguments.weights:
        load_weights(net, split_paths(arguments.weights), arguments.strict, need_one=True)
    net = run_by(net, arguments, arguments.weights)
    arrays = extract_records(net, arguments.blob, arguments.iterations, partial(bar, stage="extract", unit="batch"))
    net.close()
    print(f"{model(arguments)}: {', '.join(arguments.blob)} of {len(arrays['keys'])} records")
    return arrays


def _print_arrays(out: Path, arrays: Mapping[str, Any]) -> None:
    shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items() if values.ndim)
    (seconds,) = (name for name in arrays if name.startswith("seconds_per_"))
    what = seconds.removeprefix("seconds_per_")
    print(f"{out}: {shapes}; {arrays[seconds] * 1e3:.3g} ms per {what}")


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


WRITTEN = {
    "onnx": "an ONNX model",
    "torch": "the source of a PyTorch module",
    "safetensors": "weights",
}
EXPORT = f"""Write a net and its weights in another format.

--to onnx         an ONNX model (opset {OPSET}), with dynamic batch, height and width if the net allows it;
                  weights of more than 2 GB go into a second file
--to torch        the source of a PyTorch module, OUT.py, and its weights, OUT.safetensors
--to safetensors  the weights alone: LAYER.INDEX, in Caffe's order

Data layers become inputs. Give their shapes with --shape if the prototxt does not."""


def _add_export(commands: Commands) -> None:
    parser = commands.add_parser(
        "export",
        _export,
        help="write a net as ONNX, PyTorch source or safetensors",
        description=EXPORT,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument("file", metavar="FILE", help="the net's prototxt")
    parser.add_argument("--to", required=True, choices=list(WRITTEN), help="the format")
    parser.add_argument("--weights", metavar="WEIGHTS", help="the trained weights (default: random weights)")
    parser.add_output("--out", type=Path, required=True, metavar="OUT", help="the file to write")
    _add_part(parser)
    parser.add_argument(
        "--no-labels", action="store_true", help="leave out labels, and the losses and accuracies that need them"
    )
    group = parser.add_argument_group("ONNX", "What the model does to its images.")
    group.add_argument(
        "--input", default="data", metavar="BLOB", help="the input that is images (default: %(default)s)"
    )
    group.add_argument("--uint8", action="store_true", help="they are uint8")
    group.add_argument("--crop", action="store_true", help="crop larger images to their center")
    add_pixels(group)


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
        refuse(arguments, ("input",), "names the input of --crop, --swap, --raw-scale, --mean, --scale and --uint8")
    source = _source(arguments, not arguments.no_labels)
    for line in export_net(source, arguments.to, arguments.out, steps if steps.changes_images else None):
        print(f"note: {line}", file=sys.stderr)
    print(f"{arguments.out}: {WRITTEN[arguments.to]}, {amount(arguments.out.stat().st_size)}")


def _add_part(parser: Parser) -> None:
    """Add the options that choose the part of a net to write."""
    add_blob(parser, text="only the layers that compute these blobs")
    add_shape(parser, text="the shape of an input or a data layer's top")
    add_phase(parser)
    add_state(parser)
    add_python(parser)


def _add_fold(commands: Commands) -> None:
    parser = commands.add_parser("fold", _fold, help="fold BatchNorm and Scale layers into the layers before them")
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    parser.add_argument(
        "file", metavar="MODEL", help="the net's prototxt; the labels and losses of a training net are removed"
    )
    parser.add_argument("--weights", required=True, metavar="WEIGHTS", help="the trained weights")
    ends = (".prototxt", ".caffemodel")
    parser.add_output(
        "--out", ends=ends, type=Path, required=True, metavar="PREFIX", help=f"write PREFIX{' and PREFIX'.join(ends)}"
    )
    _add_part(parser)


def _fold(arguments: argparse.Namespace) -> None:
    from netspec.export.formats.convert import fold_files

    before, after = fold_files(_source(arguments, labels=False), arguments.out)
    print(f"{arguments.out}.prototxt and {arguments.out}.caffemodel: {after} layers of {before}")
