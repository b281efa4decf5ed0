"""From a prototxt to a runnable net: read, filter, insert splits, plan, build, load weights.

A .caffemodel holds its layers with their weights: :func:`recover_net` is for weights without a prototxt. The file
contains the net as it ran, usually in a training: with Split layers, in one phase, reading a database.

Caffe: Net::Init (src/caffe/net.cpp)
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from netspec import log
from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where, did_you_mean
from netspec.files.memory import no_collection
from netspec.graph.filter import add_input, filter_net, is_input, shapes_of_input, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.plan import make_plan
from netspec.graph.splits import insert_splits, without_splits
from netspec.layers import class_of, layer_class
from netspec.layers.contract.reading import channels_read, reads_data, source_of, takes_shapes
from netspec.net.net import Net
from netspec.net.weights import copy_weights, load_weights
from netspec.proto.binary import parse_net_binary
from netspec.proto.schema import TEST, LayerParameter, NetParameter, PhaseValue
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net, write_text


def load_net(
    path: str | Path, phase: PhaseValue = TEST, options: BuildOptions | None = None, weights: Iterable[str | Path] = ()
) -> Net:
    """Build the net of a prototxt, with the weights of files. Raises SpecError for every fault of the files.

    ``netspec.load_net`` (netspec/load.py) is this with a keyword for each option.
    """
    options = options or BuildOptions()
    net, source = parse_net(path)
    built = build_net(with_state(net, phase, options.level, options.stages), source, options)
    if files := list(weights):
        load_weights(built, files, options.strict)
    return built


def build_net(net: NetParameter, source: SourceMap, options: BuildOptions | None = None) -> Net:
    """Filter by the net's own ``state``, insert splits, plan, and build."""
    options = options or BuildOptions()
    return build_filtered(*filter_net(net, source), options)


@no_collection()
def build_filtered(filtered: NetParameter, source: SourceMap, options: BuildOptions) -> Net:
    """Insert splits, plan, and build a net that is already filtered by its ``state``."""
    if log.logger.isEnabledFor(logging.INFO):
        log.dump("net.cpp:53", "Initializing net from parameters: ", write_text(filtered).rstrip("\n"))
    split, source = insert_splits(filtered, source)
    for layer in split.layer:
        if not layer.HasField("phase"):
            layer.phase = split.state.phase
    built = Net(make_plan(split, source), options)
    written = NetParameter(layer=[layer for layer in split.layer if layer.blobs])
    if written.layer:  # weights in the prototxt itself
        copy_weights(built, written, source.file)
    return built


def check_sources(net: NetParameter, source: SourceMap, options: BuildOptions) -> None:
    """Raise SpecError for the first data layer of a net's ``state`` that reads from a path where nothing is.

    Building the net would raise the same, but perhaps after a long log.
    """
    with log.silent():
        net, source = filter_net(net, source)
        for i, layer in enumerate(net.layer):
            path = source_of(layer, class_of(layer))
            if path and not os.path.exists(path):  # the layer itself knows what to say of it
                build_filtered(
                    NetParameter(layer=[layer], state=net.state), source.with_layers([source.layers[i]]), options
                )


def not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return an error for each given shape of a blob that is not a top of a data layer (or Python layer)."""
    layers = [layer for net in nets for layer in net.layer]
    makers = [layer for layer in layers if not layer.bottom or ((cls := class_of(layer)) and takes_shapes(cls))]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape: no data layer has a top "{name}"{did_you_mean(name, blobs) or ";"} their tops: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]


# The net inside a .caffemodel


def recover_net(path: str | Path, shapes: Mapping[str, Shape]) -> tuple[NetParameter, SourceMap]:
    """Return the deploy net of a .caffemodel, without its weights, and a map that knows the file only.

    Layers that read data, and blobs that no layer makes, become Input layers with the given ``shapes`` (blob -> shape).
    For a layer that reads data the shape is known if its source can be read, or if it crops images: one image, with the
    channels of the first layer's filters. Layers that need a label, or another blob that is not given, are left out,
    and so are Split layers, phases and rules. Raises SpecError if a shape is neither given nor known, and for a file
    that has only weights.
    """
    trained, source = parse_net_binary(path)
    where = Where(str(path))
    if not any(layer.type for layer in trained.layer):
        raise SpecError("contains weights but no net", where)
    layers = without_splits(trained)
    inputs = _inputs(layers)
    for name in shapes:
        if name not in inputs:
            hint = did_you_mean(name, list(inputs)) or ";"
            raise SpecError(f'--shape names "{name}"{hint} inputs of this net: {", ".join(inputs)}', where)
    given = {name: shapes.get(name) or known for name, known in inputs.items()}
    given = {name: shape for name, shape in given.items() if shape and 0 not in shape}
    made = set(given)
    net = NetParameter(name=trained.name)
    for name, shape in given.items():
        add_input(net, name, {name: shape})
    missing = {name for name in inputs if name not in given}
    without = []
    for layer in layers:
        if _reads_data(layer) or is_input(layer):
            continue
        if missing & set(layer.bottom):
            missing.update(top for top in layer.top if top not in made)
            without.append(layer.name)
            continue
        made.update(layer.top)
        kept = net.layer.add()
        kept.CopyFrom(layer)
        for name in ("blobs", "phase", "include", "exclude"):
            kept.ClearField(name)
    if len(net.layer) == len(given):
        advice = " or ".join(_advice(inputs))
        sources = [path for layer in layers if (path := source_of(layer, class_of(layer)))]
        gone = f', and "{sources[0]}", which it was trained on, cannot be read here' if sources else ""
        raise SpecError(f"the shape of its input is not in the file{gone}; give {advice}", where)
    if without:
        blobs = ", ".join(name for name in inputs if name not in given)
        log.logger.warning(f"{path}: left out, since --shape does not give {blobs}: {', '.join(without)}")
    return net, source.with_layers([source.net] * len(net.layer))


def _reads_data(layer: LayerParameter) -> bool:
    cls = layer_class(layer.type)
    return not layer.bottom and (cls is None or reads_data(cls) or takes_shapes(cls))


def _inputs(layers: list[LayerParameter]) -> dict[str, Shape]:
    """Return the blobs that no layer makes, and their shapes as far as the file has them; 0 is an unknown size."""
    inputs: dict[str, Shape] = {}
    made: set[str] = set()
    for layer in layers:
        if is_input(layer):
            inputs.update(shapes_of_input(layer))
        elif _reads_data(layer):
            inputs.update((top, _shape_of_images(layer, top, layers)) for top in layer.top)
        for bottom in layer.bottom:
            if bottom not in made and bottom not in inputs:
                inputs[bottom] = (1, _channels(bottom, layers), 0, 0)
        made.update(layer.top)
    return inputs


def _shape_of_images(reader: LayerParameter, top: str, layers: list[LayerParameter]) -> Shape:
    read = _shape_of_records(reader) if top == reader.top[0] else ()
    side = reader.transform_param.crop_size
    channels = _channels(top, layers)
    if channels and (reader.transform_param.mean_value or reader.transform_param.scale != 1):
        settings = " ".join(write_text(reader.transform_param).split())
        log.logger.warning(f'the net was trained with transform_param {{ {settings} }} for blob "{top}"')
    return read or (1, channels, side, side)


def _shape_of_records(reader: LayerParameter) -> Shape:
    """Return the shape of the first record of a data layer, as one image; () if its source cannot be read here."""
    if not os.path.exists(source_of(reader, class_of(reader))):
        return ()
    with log.silent(), suppress(SpecError):
        alone = NetParameter(layer=[reader])
        net = build_filtered(alone, SourceMap.unknown("", 1), BuildOptions(device="meta"))
        return (1, *net.layers[0].top_shapes[0][1:])
    return ()


def _channels(blob: str, layers: list[LayerParameter]) -> int:
    """Return the channels that the filters of the first convolution of a blob have; 0 where there is none."""
    for layer in layers:
        if blob in layer.bottom and (channels := channels_read(layer, layer_class(layer.type))):
            return channels
    return 0


def _advice(inputs: Mapping[str, Shape]) -> Iterator[str]:
    for name, shape in inputs.items():
        sizes = [str(size or letter) for size, letter in zip(shape, "NCHW", strict=False)]
        yield f"--shape {name}={','.join(sizes)}"
