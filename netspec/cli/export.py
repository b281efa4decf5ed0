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
from netspec.cli.arguments import choice, device, load_weights, model, options, run_by, stages
from netspec.errors import SpecError
from netspec.files.limits import amount
from netspec.files.whole_file import whole_file, why_unwritable
from netspec.proto.binary import split_paths
from netspec.proto.schema import PHASES
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar

TABLE = """
extract quiet built                write blobs to an .npz file, for the records of a data layer or for images
  @net
  --weights WEIGHTS                the trained weights (default: random weights)
  --blob+! BLOB                    the blobs to write
  --out! OUT                       the .npz to write
  --source... LAYER=DB             use another database
  --iterations N                   batches to run (default: every record once)
  --images FOLDER|LIST             use image files instead of records
  --input=data BLOB                the blob that images go into (default: data)
  --zooms 1,0.7                    describe several views of each image: the whole (1) and its middle (0.7)
  --shape BLOB=N,C,H,W             the input blob's shape, if its data is not available
  @steps @gpu @phase @state @python @exact @passes @strict @engine
export quiet built                 write a net as ONNX, PyTorch source, a torch.export archive or safetensors
  file FILE                        the net's prototxt
  --to! {onnx|torch|pt2|safetensors}   the form
  --weights WEIGHTS                the trained weights (default: random weights)
  --out! OUT                       the file to write
  @part
  --no-labels                      leave out labels, and the losses and accuracies that need them
  --input=data BLOB                the input for the options below (default: data)
  --crop                           ONNX: take the middle of larger images
  --swap                           ONNX: images come with reversed channels (RGB for BGR)
  --raw-scale=1 S                  ONNX: multiply images by this first
  --mean A,B,C|FILE                ONNX: then subtract this, numbers or a .binaryproto or .npy file
  --scale=1 S                      ONNX: then multiply by this
  --uint8                          ONNX: images are bytes
fold quiet built                   write the deploy net with BatchNorm and Scale folded in: OUT.prototxt, OUT.caffemodel
  file MODEL                       the net's prototxt; of a training net, labels and losses are removed
  --weights! WEIGHTS               the trained weights
  --out! PREFIX                    write PREFIX.prototxt and .caffemodel
  @part
"""


def _extract(arguments: argparse.Namespace) -> None:
    import numpy as np

    model(arguments)
    out = arguments.out
    if reason := why_unwritable(out):
        raise SpecError(f"--out {out}: cannot be written: {reason}")
    if not arguments.weights:
        log.logger.warning("no --weights given: the weights are random")
    arrays = _over_images(arguments) if arguments.images else _over_records(arguments)
    for name in ("features",) if arguments.images else arguments.blob:
        if len(rows := np.flatnonzero(~np.all(np.isfinite(arrays[name]), axis=1))):
            said = f"{len(rows)} of {len(arrays[name])} rows have a NaN or an infinity, the first is row {rows[0]}"
            log.logger.warning(f"{name}: {said} (from 0); did the net diverge?")
    if os.environ.get("SOURCE_DATE_EPOCH"):  # the same bytes are wanted each time: no time that was measured
        arrays.update({name: np.array(np.nan) for name in arrays if name.startswith("seconds_per_")})
    with whole_file(out) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    _tell_arrays(out, arrays)


def _over_images(arguments: argparse.Namespace) -> dict[str, Any]:
    from netspec.files.image_list import list_images
    from netspec.inspect.features.images import ImageNet, extract_images
    from netspec.inspect.features.scaling import Steps

    records = ("source", "iterations", "phase", "level", "stage", "allow_python_layers")
    refuse(arguments, records, "is for records; --images are read, and run in phase TEST")
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
        arguments.input,
        given,
        arguments.zooms or (1.0,),
        steps,
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
    from netspec.proto.text import parse_net

    images = ("input", "shape", "zooms", "swap", "raw_scale", "mean", "scale")
    refuse(arguments, images, "is for --images; a data layer's records have its shape and its transform_param")
    message, source = parse_net(model(arguments))
    stated = with_state(message, PHASES[arguments.phase], arguments.level, stages(arguments))
    stated = with_sources(stated, source, dict(arguments.source))
    net = build_net(stated, source, options(arguments, device=str(device(arguments.gpu))))
    load_weights(net, arguments.weights, arguments.strict)
    net = run_by(net, arguments, arguments.weights)
    arrays = extract_records(net, arguments.blob, arguments.iterations, partial(bar, stage="extract", unit="batch"))
    net.close()
    print(f"{model(arguments)}: {', '.join(arguments.blob)} of {len(arrays['keys'])} records")
    return arrays


def _tell_arrays(out: Path, arrays: Mapping[str, Any]) -> None:
    shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items() if values.ndim)
    (seconds,) = (name for name in arrays if name.startswith("seconds_per_"))
    what = seconds.removeprefix("seconds_per_")
    print(f"{out}: {shapes}; {arrays[seconds] * 1e3:.3g} ms per {what}")


WRITTEN = {
    "onnx": "an ONNX model",
    "torch": "the source of a PyTorch module",
    "pt2": "a torch.export archive",
    "safetensors": "weights",
}


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
    """Write a net in another form, with its weights.

    --to onnx         an ONNX model (opset 21), batch, height and width free where the net allows it;
                      weights of more than 2 GB go into a file beside it
    --to torch        the source of a PyTorch module, OUT.py, and its weights, OUT.safetensors beside it
    --to pt2          a torch.export archive
    --to safetensors  the weights alone: LAYER.INDEX, in Caffe's order

    Layers that read data become inputs; --shape says what they read, where the prototxt does not.
    """
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
