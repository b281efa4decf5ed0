"""``netspec check``, ``lint``, ``draw``, ``diff``, ``fmt``, ``layers`` and ``look``."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netspec.cli.arguments import options
from netspec.errors import SpecError, Where, did_you_mean, printable
from netspec.files.whole_file import write_whole
from netspec.process.garbage import no_collection
from netspec.proto.binary import is_net_binary, split_paths
from netspec.proto.schema import PHASES, TEST, TRAIN
from netspec.terminal.commands import DONE, FAULT, SOMETHING, UNREADABLE, WrongUsage, refuse

if TYPE_CHECKING:
    from netspec.inspect.features.images import ImageNet

TABLE = """
check quiet built                  build a net, or a solver's nets, and report every error; nothing is written
  file FILE                        a net's or a solver's prototxt, or a .caffemodel
  @phase @state
  --shape... BLOB=N,C,H,W          the shape of a data layer's top; its data is then not opened
  --data                           open databases, lists and mean files too
  --weights WEIGHTS                weights that must fit the net, several separated by commas
  --plan                           print how the net runs without gradients; needs its memory
  @passes
  --json                           print blobs, params, inputs, outputs as JSON; or the faults, if any
  @strict @python
lint quiet read                    find what is legal but likely a mistake, in nets and solvers
  [files...] FILE                  a net's or a solver's prototxt
  --rules                          print the rules, with their reasons
  --json                           print faults and findings as JSON, one object for each file
  @state
  --shape... BLOB=N,C,H,W          the shape of a data layer's top; some rules need shapes
  --data                           open databases, lists and mean files
  @python
draw quiet read                    draw a net: layers, shapes, shared parameters, multiply-adds
  file FILE                        a net, a .caffemodel, or a solver, whose training net is drawn
  --out! F.svg|F.png|F.html        the file to write
  --phase {TEST|TRAIN}             only this phase (default: both in one)
  @state
  --shape... BLOB=N,C,H,W          the shape of a data layer's top; without it shapes may be unknown
  --data                           open databases and lists to learn their shapes
  --unfold                         draw every copy of what repeats (HTML has both)
  @python
diff quiet read compares           tell what differs in meaning: nets, solvers or weights
  first A                          a prototxt, a .caffemodel or a .caffemodel.h5
  second B                         another of the same kind
  --tolerance=0 X                  weights no further apart are equal (default: 0)
fmt quiet                          write prototxt files in one form; comments are kept
  files... FILE                    a net's or a solver's prototxt; - is standard input
  --check                          write nothing; name the files that would change
layers quiet read                  list the layer types, each with its description
look:                              draw what a net has learned: filters, maps, saliency, embedding
filters quiet                      draw the filters of a layer, by default the first
  weights WEIGHTS                  a .caffemodel or .caffemodel.h5
  --layer LAYER                    the layer (default: the first with filters)
  --rgb                            the net was trained with red, green, blue (Caffe's order: BGR)
  @picture
maps quiet built                   draw the maps of a blob for an image
  @described
  --image! IMAGE                   the image file
  @picture
saliency quiet built               draw which pixels matter for a number of a blob, or a distance
  @described
  --image! IMAGE                   the image file
  --unit K                         which of the blob's numbers (default: the greatest)
  --to IMAGE                       instead: the distance of the blob to that of this image
  --samples=16 N                   average over N noisy copies (default: 16)
  @picture
embedding quiet                    draw descriptors in a plane, with the images as points
  features FEATURES.npz            what netspec extract wrote
  --array= ARRAY                   which array of the file (default: the first with descriptors)
  --images FOLDER|LIST|DB          the images: a folder, a list, or the records' database
  --method=pca {pca|tsne}          how to find the plane (default: pca)
  @picture
"""


@no_collection()  # of the whole command: of the text and the table too
def _check(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.check import as_json, check_file
    from netspec.inspect.check.findings import said_as_json, said_once
    from netspec.inspect.check.plan import plan_text
    from netspec.net.table import table

    if not arguments.plan:
        refuse(arguments, ("passes",), "needs --plan, which prints what they do")
    elif arguments.json:
        refuse(arguments, ("plan",), "is not part of the JSON; leave out --json")
    how = {} if arguments.plan else {"device": "meta", "passes": ()}
    checked = check_file(
        arguments.file,
        PHASES[arguments.phase],
        options(arguments, given_shapes=dict(arguments.shape), **how),
        arguments.weights,
    )
    if len(checked) > 1:
        refuse(arguments, ("phase",), "is for a net; of a solver the nets of both phases are checked")
    elif is_net_binary(arguments.file):
        refuse(arguments, ("phase", "level", "stage", "weights", "strict"), f"is for a prototxt, not {arguments.file}")
    elif checked[0].net is not None and not arguments.weights:
        refuse(arguments, ("strict",), "needs --weights")
    advice = {str(found): found for part in checked for found in part.advice}
    for line in said_once(advice.values()):
        print(f"warning: {line}", file=sys.stderr)
    faults = {str(fault): fault for part in checked for fault in part.faults}
    if faults:
        print("\n".join(faults), file=sys.stderr)
        if arguments.json:
            print(json.dumps(said_as_json(faults.values(), advice.values())))
        return 1
    nets = [(part.label, part.net) for part in checked if part.net is not None]
    if arguments.json:
        found = {label: as_json(net) for label, net in nets}
        print(json.dumps(next(iter(found.values())) if len(found) == 1 else found))
        return 0
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None  # a file gets all columns
    for label, net in nets:
        print(f"{label}: {printable(net.name) or 'a net without a name'}\n{table(net.plan, list(net.layers), width)}")
        print(f"memory: at least {net.need}\n")
        if arguments.plan:
            print(plan_text(net) + "\n")
    return 0


def _lint(arguments: argparse.Namespace) -> int:
    if arguments.rules == bool(arguments.files):
        raise WrongUsage("give files, or --rules")
    if arguments.rules:
        refuse(
            arguments, ("json", "level", "stage", "shape", "data", "allow_python_layers"), "is for files, not --rules"
        )
    from netspec.inspect.check.findings import RULES, said_as_json, said_once
    from netspec.inspect.check.lint import lint_file

    for rule in sorted(RULES.values(), key=lambda rule: rule.name) if arguments.rules else ():
        print(f"{rule.name}: {rule.reason}")
    status = DONE
    for path in arguments.files:
        given = dict(arguments.shape)
        linted = lint_file(path, options(arguments, device="meta", given_shapes=given, passes=()))
        for fault in linted.unknown:
            print(f"warning: {fault}; rules that need shapes are not applied", file=sys.stderr)
        if arguments.json:
            print(json.dumps({"file": path, **said_as_json(linted.faults, linted.found)}))
        for line in [*linted.faults, *said_once(linted.found)] if not arguments.json else ():
            print(line, file=sys.stdout if linted.readable else sys.stderr)
        found = SOMETHING if linted.faults or linted.found else DONE
        status = max(status, found if linted.readable else UNREADABLE)
    return status


FORMATS = (".svg", ".png", ".html")
STDIN = "-"


def _draw(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix not in FORMATS:
        raise WrongUsage(f"--out {arguments.out}: expected a name that ends in {', '.join(FORMATS)}")
    if arguments.out.suffix == ".html":
        refuse(arguments, ("unfold",), "is for .svg and .png; a page shows both")
    from netspec.inspect.draw.files import write_picture

    drawn = write_picture(
        arguments.file,
        arguments.out,
        phases=[PHASES[arguments.phase]] if arguments.phase else [TRAIN, TEST],
        options=options(arguments, given_shapes=dict(arguments.shape)),
        unfolded=arguments.unfold,
    )
    for fault in drawn.faults:
        print(f"warning: {fault}; shapes are missing from there on", file=sys.stderr)
    layers = sum(1 + len(box.attached) for box in drawn.boxes)
    print(f"{arguments.out}: {layers} layers of {printable(drawn.name) or 'a net without a name'}")


def _diff(arguments: argparse.Namespace) -> int:
    from netspec.inspect.check.compare import compare_files

    status = DONE
    for each in compare_files(arguments.first, arguments.second, arguments.tolerance):
        print(each)
        status = SOMETHING
    return status


def _fmt(arguments: argparse.Namespace) -> int:
    from netspec.proto.format import format_text
    from netspec.proto.text import text_of

    status = DONE
    for path in arguments.files:
        try:
            text = sys.stdin.read() if path == STDIN else text_of(path)
            formatted = format_text(text, path)
        except SpecError as fault:  # the other files are formatted all the same
            print(fault, file=sys.stderr)
            status = UNREADABLE if arguments.check else max(status, FAULT)
            continue
        if arguments.check:
            status = max(status, _differs(path, text, formatted))
        elif path == STDIN:
            print(formatted, end="")
        elif formatted == text:
            print(f"{path}: was in this form already")
        else:
            _write(path, formatted)
    return status


def _differs(path: str, text: str, formatted: str) -> int:
    """Say where a file would change; return the status."""
    if text == formatted:
        return DONE
    lines = zip(text.split("\n"), formatted.split("\n"), strict=False)
    first = next((k for k, (a, b) in enumerate(lines, 1) if a != b), 1)
    print(f"{path}:{first}:1: netspec fmt would change this line, the first of them")
    return SOMETHING


def _write(path: str, text: str) -> None:
    write_whole(path, text, "surrogateescape")
    print(f"{path}: formatted")


def _layers(arguments: argparse.Namespace) -> None:
    from netspec.layers import layer_class, layer_types

    for name in layer_types():
        cls = layer_class(name)
        first = ((cls and cls.__doc__) or "").strip().splitlines()[0]
        print(f"{name:28} {first}")


PICTURES = ("png", "svg")


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
