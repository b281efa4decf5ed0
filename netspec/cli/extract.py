"""``netspec extract``."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from netspec import log
from netspec.cli.arguments import (
    add_device,
    add_engine,
    add_exact,
    add_model,
    add_passes,
    add_python,
    add_state,
    add_steps,
    add_strict,
    choice,
    device,
    load_weights,
    model,
    options,
    positive,
    run_by,
    shape,
    stages,
)
from netspec.cli.run import BUILT, Commands
from netspec.errors import SpecError
from netspec.files.whole_file import whole_file, why_unwritable
from netspec.proto.binary import split_paths
from netspec.proto.schema import PHASES
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar


def add_to(commands: Commands) -> None:
    """Add the command."""
    summary = "write blobs to an .npz file, for the records of a data layer or for images"
    p = commands.add("extract", _extract, summary, quiet=True, net=BUILT)
    add_model(p)
    p.add_argument("--weights", help="the trained weights (default: random weights)")
    p.add_argument("--blob", required=True, nargs="+", action="extend", help="the blobs to write")
    p.add_argument("--out", required=True, help="the .npz to write")
    p.add_argument(
        "--source", action="append", default=[], type=_source, metavar="LAYER=DB", help="use another database"
    )
    p.add_argument("--iterations", type=positive, help="batches to run (default: every record once)")
    p.add_argument("--images", metavar="FOLDER|LIST", help="use image files instead of records")
    p.add_argument("--input", default="data", help="the blob that images go into (default: data)")
    p.add_argument(
        "--zooms",
        type=_zooms,
        metavar="1,0.7",
        help="describe several views of each image: the whole (1) and its middle (0.7)",
    )
    p.add_argument(
        "--shape", type=shape, metavar="BLOB=N,C,H,W", help="the input blob's shape, if its data is not available"
    )
    add_steps(p)
    add_device(p)
    add_state(p, phase="TEST")
    add_python(p)
    add_exact(p)
    add_passes(p)
    add_strict(p)
    add_engine(p)


def _extract(arguments: argparse.Namespace) -> None:
    import numpy as np

    from netspec.inspect.features.records import rows_not_finite

    model(arguments)
    out = Path(arguments.out)
    if reason := why_unwritable(out):
        raise SpecError(f"--out {out}: cannot be written: {reason}")
    if not arguments.weights:
        log.logger.warning("no --weights given: the weights are random")
    arrays = _over_images(arguments) if arguments.images else _over_records(arguments)
    for line in rows_not_finite(
        {name: arrays[name] for name in (("features",) if arguments.images else arguments.blob)}
    ):
        log.logger.warning(f"{line} (from 0); did the net diverge?")
    if os.environ.get("SOURCE_DATE_EPOCH"):  # the same bytes are wanted each time: no time that was measured
        arrays.update({name: np.array(np.nan) for name in arrays if name.startswith("seconds_per_")})
    with whole_file(out) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    _tell(out, arrays)


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


def _tell(out: Path, arrays: Mapping[str, Any]) -> None:
    shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items() if values.ndim)
    (seconds,) = (name for name in arrays if name.startswith("seconds_per_"))
    what = seconds.removeprefix("seconds_per_")
    print(f"{out}: {shapes}; {arrays[seconds] * 1e3:.3g} ms per {what}")


def _zooms(text: str) -> tuple[float, ...]:
    from netspec.inspect.features.scaling import read_zooms

    try:
        return read_zooms(text)
    except SpecError as fault:
        raise argparse.ArgumentTypeError(str(fault)) from None


def _source(text: str) -> tuple[str, str]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected LAYER=DB")
    return name, path
