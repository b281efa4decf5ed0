"""``netspec extract``."""

from __future__ import annotations

import argparse
from pathlib import Path

from netspec import log
from netspec.cli.arguments import (
    add_device,
    add_exact,
    add_python,
    add_state,
    bar,
    device,
    load_weights,
    positive,
    shape,
    stages,
)
from netspec.cli.run import Commands
from netspec.command_line import WrongUsage
from netspec.errors import SpecError
from netspec.proto.schema import PHASES


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("extract", _extract, "write blobs, over the records of a data layer or over images, to an .npz")
    p.add_argument("--model", required=True, help="the net's prototxt")
    p.add_argument("--weights", help="the trained weights; without, random ones")
    p.add_argument("--blob", required=True, nargs="+", action="extend", help="the blobs to write")
    p.add_argument("--out", required=True, help="the .npz to write")
    p.add_argument("--source", action="append", default=[], type=_source, metavar="LAYER=DB", help="another database")
    p.add_argument("--iterations", type=positive, help="batches to run (default: every record once)")
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
        "--shape", type=shape, metavar="BLOB=N,C,H,W", help="that blob's shape, where the data is not at hand"
    )
    add_device(p)
    add_state(p, phase="TEST")
    add_python(p)
    add_exact(p)


def _extract(arguments: argparse.Namespace) -> None:
    import numpy as np

    from netspec.features.image_list import list_images
    from netspec.features.images import extract_images, image_net
    from netspec.features.records import extract_records, with_sources
    from netspec.graph.filter import with_state
    from netspec.net.build import build_net
    from netspec.net.options import BuildOptions
    from netspec.proto.text import parse_net

    chosen = device(arguments.gpu)
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
        images = list_images(arguments.images)
        given = arguments.shape[1] if arguments.shape else None
        net, scaling = image_net(arguments.model, blob, arguments.input, given, chosen, arguments.exact)
        load_weights(net, arguments.weights)
        arrays = extract_images(net, scaling, blob, images, progress=bar("extract", "batch"), zooms=arguments.zooms)
    elif arguments.zooms:
        raise WrongUsage("--zooms are of --images; a data layer's records have their own transform_param")
    else:
        message, source = parse_net(arguments.model)
        stated = with_state(message, PHASES[arguments.phase], arguments.level, stages(arguments))
        stated = with_sources(stated, source, dict(arguments.source))
        options = BuildOptions(chosen, allow_python=arguments.allow_python_layers, exact=arguments.exact)
        net = build_net(stated, source, options)
        load_weights(net, arguments.weights)
        arrays = extract_records(net, arguments.blob, arguments.iterations, bar("extract", "batch"))
    net.close()
    with out.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _zooms(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected numbers with commas between, e.g. 1,0.7") from None


def _source(text: str) -> tuple[str, str]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected LAYER=DB")
    return name, path
