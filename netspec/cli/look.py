"""``netspec look``: images of what a net has learned."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netspec.cli.arguments import add_limit, add_plugin, add_steps, add_verbose, blob_shape, options, positive
from netspec.errors import SpecError, Where, did_you_mean
from netspec.proto.binary import split_paths
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.parser import QUIET, Commands

if TYPE_CHECKING:
    from netspec.inspect.features.images import ImageNet

PICTURES = ("png", "svg")


def add_commands(commands: Commands) -> None:
    """Add ``look`` and its commands."""
    look = commands.add_group("look", help="draw what a net has learned: filters, maps, saliency, embedding")
    _add_filters(look)
    _add_maps(look)
    _add_saliency(look)
    _add_embedding(look)


def _add_picture(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="F.png|svg", help="the image to write")


def _add_filters(commands: Commands) -> None:
    parser = commands.add_parser("filters", help="draw the filters of a layer, by default the first")
    parser.set_defaults(function=_filters, **QUIET)
    parser.add_argument("weights", metavar="WEIGHTS", help="a .caffemodel or .caffemodel.h5")
    parser.add_argument("--layer", metavar="LAYER", help="the layer (default: the first with filters)")
    parser.add_argument("--rgb", action="store_true", help="the net was trained on RGB images (Caffe's order is BGR)")
    _add_picture(parser)


def _filters(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import filters_figure
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.stored_weights import stored_layers

    ending_of(arguments.out, PICTURES)
    layers = [layer for layer in stored_layers(arguments.weights) if layer.has_filters]
    names = [layer.name for layer in layers]
    where = Where(arguments.weights)
    if not layers:
        raise SpecError("no layer has filters (weights of four axes)", where)
    first = min(layers, key=lambda layer: layer.blobs[0].shape[1]).name
    chosen = arguments.layer or first
    if chosen not in names:
        hint = did_you_mean(chosen, names) or ";"
        raise SpecError(f'no layer "{chosen}" with filters{hint} layers with filters: {", ".join(names)}', where)
    filters = layers[names.index(chosen)].blobs[0]
    title = f"{Path(arguments.weights).name}: filters of {chosen}"
    write_figure(filters_figure(filters, title, chosen == first, arguments.rgb), arguments.out)
    print(f"{arguments.out}: {chosen} {filters.shape}")


def _add_described_blob(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("net", metavar="NET", help="the net's prototxt")
    parser.add_argument(
        "--weights", required=True, metavar="WEIGHTS", help="the trained weights, several separated by commas"
    )
    parser.add_argument("--blob", required=True, metavar="BLOB", help="the blob")
    parser.add_argument(
        "--input", default="data", metavar="BLOB", help="the blob that the image goes into (default: %(default)s)"
    )
    parser.add_argument(
        "--shape", type=blob_shape, metavar="BLOB=N,C,H,W", help="the input blob's shape, if its data is not available"
    )
    add_steps(parser)


def _add_maps(commands: Commands) -> None:
    parser = commands.add_parser("maps", help="draw the maps of a blob for an image")
    parser.set_defaults(function=_maps, **QUIET)
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    _add_described_blob(parser)
    parser.add_argument("--image", required=True, metavar="IMAGE", help="the image file")
    _add_picture(parser)


def _maps(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import maps_figure
    from netspec.inspect.draw.style import ending_of, write_figure

    ending_of(arguments.out, PICTURES)
    net = _net(arguments)
    image = _image(net, arguments.image)
    maps = net.values(net.inputs([image]))[0]
    write_figure(maps_figure(maps, image, f"{arguments.blob} of {Path(arguments.image).name}"), arguments.out)
    print(f"{arguments.out}: {arguments.blob} {maps.shape}")


def _add_saliency(commands: Commands) -> None:
    parser = commands.add_parser("saliency", help="draw which pixels matter for one value of a blob, or for a distance")
    parser.set_defaults(function=_saliency, **QUIET)
    add_verbose(parser)
    add_plugin(parser)
    add_limit(parser)
    _add_described_blob(parser)
    parser.add_argument("--image", required=True, metavar="IMAGE", help="the image file")
    parser.add_argument(
        "--unit", type=int, metavar="K", help="index of the value in the blob (default: the largest value)"
    )
    parser.add_argument(
        "--to", metavar="IMAGE", help="explain the distance between the blobs of the two images instead"
    )
    parser.add_argument(
        "--samples", type=positive, default=16, metavar="N", help="average over N noisy copies (default: %(default)s)"
    )
    _add_picture(parser)


def _saliency(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import saliency_figure
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.features.saliency import of_distance, of_unit
    from netspec.log import number

    if arguments.to:
        refuse(arguments, ("unit",), "is for one value of the blob; --to explains a distance")
    ending_of(arguments.out, PICTURES)
    net = _net(arguments)
    images = [_image(net, path) for path in (arguments.image, arguments.to) if path]
    if arguments.to:
        *maps, value = of_distance(net, images[0], images[1], arguments.samples)
        what = f"distance of {arguments.blob} between {Path(arguments.image).name} and {Path(arguments.to).name}"
    else:
        found, unit, value = of_unit(net, images[0], arguments.unit, arguments.samples)
        maps, what = [found], f"number {unit} of {arguments.blob} of {Path(arguments.image).name}"
    title = f"what matters for the {what}: {number(value)}"
    write_figure(saliency_figure(images, maps, title), arguments.out)
    print(f"{arguments.out}: {what}: {number(value)}")


def _add_embedding(commands: Commands) -> None:
    parser = commands.add_parser("embedding", help="plot descriptors in two dimensions, one point per image")
    parser.set_defaults(function=_embedding, **QUIET)
    parser.add_argument("features", metavar="FEATURES.npz", help="a file that netspec extract wrote")
    parser.add_argument(
        "--array", default="", metavar="ARRAY", help="array of the file (default: the first with descriptors)"
    )
    parser.add_argument(
        "--images", metavar="FOLDER|LIST|DB", help="the images: a folder, a list, or a database of records"
    )
    parser.add_argument(
        "--method",
        default="pca",
        choices=["pca", "tsne"],
        help="method of dimensionality reduction (default: %(default)s)",
    )
    _add_picture(parser)


def _embedding(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import embedding_figure
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.features.embedding import in_plane, read_features, thumbnails

    ending_of(arguments.out, PICTURES)
    features = read_features(arguments.features, arguments.array)
    found = thumbnails(arguments.images, features.names, len(features.values)) if arguments.images else None
    points, words = in_plane(features.values, arguments.method)
    title = f"{features.array} of {len(points)} images: {words}"
    figure = embedding_figure(points, title, found and found.labels, found and found.images)
    write_figure(figure, arguments.out)
    print(f"{arguments.out}: {title}")


def _net(arguments: argparse.Namespace) -> ImageNet:
    from netspec.inspect.features.images import ImageInput, ImageNet
    from netspec.inspect.features.scaling import Steps

    if arguments.shape and arguments.shape[0] != arguments.input:
        raise WrongUsage(f"--shape names {arguments.shape[0]}, expected the input blob {arguments.input}")
    steps = Steps.of(arguments.mean, arguments.scale, arguments.raw_scale, arguments.swap)
    given = arguments.shape[1] if arguments.shape else None
    return ImageNet(
        arguments.net,
        split_paths(arguments.weights),
        arguments.blob,
        ImageInput(arguments.input, given, steps=steps),
        options=options(arguments, exact="none", passes=()),
    )


def _image(net: ImageNet, path: str) -> Any:
    from netspec.inspect.features.images import read_pixels

    return read_pixels(Path(path), net.shape[0])
