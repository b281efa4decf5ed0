"""From a prototxt to a runnable net: read, filter, insert splits, plan, build, load weights.

Caffe: Net::Init (src/caffe/net.cpp)
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from netspec import log
from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where, did_you_mean
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.plan import make_plan
from netspec.graph.splits import insert_splits
from netspec.layers import class_of
from netspec.layers.contract.reading import takes_shapes
from netspec.net.net import Net
from netspec.net.weights import copy_weights, load_weights
from netspec.process.garbage import no_collection
from netspec.proto.schema import TEST, NetParameter, PhaseValue
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
    """Insert splits, plan, and build a net whose layers all belong to its ``state``."""
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


def not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return an error for each given shape whose blob is not a top of a data layer (or Python layer)."""
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
