"""The net inside a .caffemodel, for weights without a prototxt.

The file contains the net as it ran, usually in a training: with Split layers, in one phase, reading a database.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from netspec import log
from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where, did_you_mean
from netspec.export.formats.inputs import add_input, is_input, shapes_of_input
from netspec.graph.options import BuildOptions
from netspec.layers import layer_class
from netspec.layers.contract.registry import source_of
from netspec.net.build import build_filtered
from netspec.proto.binary import parse_net_binary
from netspec.proto.schema import LayerParameter, NetParameter
from netspec.proto.source_map import SourceMap
from netspec.proto.text import write_text


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
    layers = _without_splits(trained)
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
        sources = [path for layer in layers if (path := source_of(layer))]
        gone = f', and "{sources[0]}", which it was trained on, cannot be read here' if sources else ""
        raise SpecError(f"the shape of its input is not in the file{gone}; give {advice}", where)
    if without:
        blobs = ", ".join(name for name in inputs if name not in given)
        log.logger.warning(f"{path}: left out, since --shape does not give {blobs}: {', '.join(without)}")
    return net, source.with_layers([source.net] * len(net.layer))


def _reads_data(layer: LayerParameter) -> bool:
    cls = layer_class(layer.type)
    return not layer.bottom and (cls is None or cls.reads_data or cls.takes_shapes)


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
    if not os.path.exists(source_of(reader)):
        return ()
    with log.silent(), suppress(SpecError):
        alone = NetParameter(layer=[reader])
        net = build_filtered(alone, SourceMap.unknown("", 1), BuildOptions(device="meta"))
        return (1, *net.layers[0].top_shapes[0][1:])
    return ()


def _channels(blob: str, layers: list[LayerParameter]) -> int:
    """Return the channels that the filters of the first convolution of a blob have; 0 where there is none."""
    for layer in layers:
        cls = layer_class(layer.type) if blob in layer.bottom else None
        if cls and (channels := cls.channels_read(layer)):
            return channels
    return 0


def _advice(inputs: Mapping[str, Shape]) -> Iterator[str]:
    for name, shape in inputs.items():
        sizes = [str(size or letter) for size, letter in zip(shape, "NCHW", strict=False)]
        yield f"--shape {name}={','.join(sizes)}"


def _without_splits(net: NetParameter) -> list[LayerParameter]:
    """Return the layers except Split layers; each reader of a copy reads the original blob."""
    names: dict[str, str] = {}
    layers = []
    for layer in net.layer:
        if layer.type == "Split":
            names.update((top, names.get(layer.bottom[0], layer.bottom[0])) for top in layer.top)
            continue
        copy = LayerParameter()
        copy.CopyFrom(layer)
        copy.bottom[:] = [names.get(bottom, bottom) for bottom in layer.bottom]
        layers.append(copy)
    return layers
