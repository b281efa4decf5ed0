"""``netspec look``: pictures of what a net has learned."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netspec.cli.arguments import add_steps, options, positive, shape
from netspec.cli.run import BUILT, Commands
from netspec.errors import SpecError, Where, did_you_mean
from netspec.proto.binary import split_paths
from netspec.terminal.commands import WrongUsage, refuse

if TYPE_CHECKING:
    from netspec.inspect.features.images import ImageNet

PICTURES = ("png", "svg")


def add_to(commands: Commands) -> None:
    """Add the commands."""
    commands = Commands(commands.group("look", "draw what a net has learned: filters, maps, saliency, embedding"))
    p = commands.add("filters", _filters, "draw the filters of a layer, by default the first", quiet=True)
    p.add_argument("weights", metavar="WEIGHTS", help="a .caffemodel or .caffemodel.h5")
    p.add_argument("--layer", help="the layer (default: the first with filters)")
    p.add_argument("--rgb", action="store_true", help="the net was trained with red, green, blue (Caffe's order: BGR)")
    _add_out(p)

    p = commands.add("maps", _maps, "draw the maps of a blob for an image", quiet=True, net=BUILT)
    _add_net(p)
    p.add_argument("--image", required=True, help="the image file")
    _add_out(p)

    p = commands.add(
        "saliency", _saliency, "draw which pixels matter for a number of a blob, or a distance", quiet=True, net=BUILT
    )
    _add_net(p)
    p.add_argument("--image", required=True, help="the image file")
    p.add_argument("--unit", type=int, metavar="K", help="which of the blob's numbers (default: the greatest)")
    p.add_argument("--to", metavar="IMAGE", help="instead: the distance of the blob to that of this image")
    p.add_argument(
        "--samples", type=positive, default=16, metavar="N", help="average over N noisy copies (default: 16)"
    )
    _add_out(p)

    p = commands.add("embedding", _embedding, "draw descriptors in a plane, with the images as points", quiet=True)
    p.add_argument("features", metavar="FEATURES.npz", help="what netspec extract wrote")
    p.add_argument("--array", default="", help="which array of the file (default: the first with descriptors)")
    p.add_argument("--images", metavar="FOLDER|LIST|DB", help="the images: a folder, a list, or the records' database")
    p.add_argument("--method", choices=("pca", "tsne"), default="pca", help="how to find the plane (default: pca)")
    _add_out(p)


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="F.png|svg", help="the picture to write")


def _add_net(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("net", metavar="NET", help="the net's prototxt")
    parser.add_argument("--weights", required=True, help="the trained weights, several separated by commas")
    parser.add_argument("--blob", required=True, help="the blob")
    parser.add_argument("--input", default="data", help="the blob that the image goes into (default: data)")
    parser.add_argument("--shape", type=shape, metavar="BLOB=N,C,H,W", help="its shape, if its data is not available")
    add_steps(parser)


def _filters(arguments: argparse.Namespace) -> None:
    from netspec.data.stored_weights import stored_layers
    from netspec.inspect.draw.learned import filters_figure
    from netspec.inspect.draw.style import ending_of, write_figure

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


def _maps(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import maps_figure
    from netspec.inspect.draw.style import ending_of, write_figure

    ending_of(arguments.out, PICTURES)
    net = _net(arguments)
    image = _image(net, arguments.image)
    maps = net.values(net.inputs([image]))[0]
    write_figure(maps_figure(maps, image, f"{arguments.blob} of {Path(arguments.image).name}"), arguments.out)
    print(f"{arguments.out}: {arguments.blob} {maps.shape}")


def _saliency(arguments: argparse.Namespace) -> None:
    from netspec.inspect.draw.learned import saliency_figure
    from netspec.inspect.draw.style import ending_of, write_figure
    from netspec.inspect.features.saliency import of_distance, of_unit
    from netspec.log import number

    if arguments.to:
        refuse(arguments, ("unit",), "and --to exclude each other: a number of the blob, or a distance")
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
    from netspec.inspect.features.images import ImageNet
    from netspec.inspect.features.scaling import Steps

    if arguments.shape and arguments.shape[0] != arguments.input:
        raise WrongUsage(f"--shape names {arguments.shape[0]}, expected the input blob {arguments.input}")
    steps = Steps.of(arguments.mean, arguments.scale, arguments.raw_scale, arguments.swap)
    given = arguments.shape[1] if arguments.shape else None
    return ImageNet(
        arguments.net,
        split_paths(arguments.weights),
        arguments.blob,
        arguments.input,
        given,
        steps=steps,
        options=options(arguments, exact="none", passes=()),
    )


def _image(net: ImageNet, path: str) -> Any:
    from netspec.inspect.features.images import read_pixels

    return read_pixels(Path(path), net.shape[0])
