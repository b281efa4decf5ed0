"""Builds a net from a prototxt: reads and filters it, inserts splits, makes a plan and the layers.

Caffe: Net::Init (src/caffe/net.cpp)
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from netspec import log
from netspec.files.limits import no_collection
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.plan import make_plan
from netspec.graph.splits import insert_splits
from netspec.layers.contract.registry import source_of
from netspec.net.net import Net
from netspec.net.weights import copy_weights
from netspec.proto.forks import forks
from netspec.proto.schema import NetParameter, PhaseValue
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net, write_text


def build_file(path: str | Path, phase: PhaseValue, options: BuildOptions) -> Net:
    """Build the net of a prototxt for a phase, and for the level and the stages of the options."""
    net, source = parse_net(path)
    return build_net(with_state(net, phase, options.level, options.stages), source, options)


def build_net(net: NetParameter, source: SourceMap, options: BuildOptions | None = None) -> Net:
    """Build a net; only the layers of its ``state`` are kept. ``source`` has the positions of its parts in the file."""
    net, source = filter_net(net, source)
    return build_filtered(net, source, options or BuildOptions())


@no_collection()
def build_filtered(filtered: NetParameter, source: SourceMap, options: BuildOptions) -> Net:
    """Build a net that has only the layers of its ``state``."""
    if log.logger.isEnabledFor(logging.INFO):
        log.dump("net.cpp:53", "Initializing net from parameters: ", write_text(filtered).rstrip("\n"))
    split, source = insert_splits(filtered, source)
    for layer in split.layer:
        if not layer.HasField("phase"):
            layer.phase = split.state.phase
    meaning = forks().meaning(split, source, options)
    built = Net(make_plan(meaning.net, source, meaning), options)
    written = NetParameter(layer=[layer for layer in split.layer if layer.blobs])
    if written.layer:  # weights in the prototxt itself
        copy_weights(built, written, source.file)
    return built


def check_sources(net: NetParameter, source: SourceMap, options: BuildOptions) -> None:
    """Raise SpecError for the first data layer of a filtered net whose source does not exist.

    Building the whole net would raise the same error, but perhaps after a long log.
    """
    for i, layer in enumerate(net.layer):
        path = source_of(layer)
        if path and not os.path.exists(path):
            only = NetParameter(layer=[layer], state=net.state)
            with log.silent():
                build_filtered(only, source.with_layers([source.layers[i]]), options)  # the layer raises the error
