"""From a prototxt to a runnable net: read, filter, insert splits, plan, build, load weights.

Caffe: Net::Init (src/caffe/net.cpp)
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from pathlib import Path

import torch

from netspec.exact import SMALL
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.graph.plan import make_plan
from netspec.graph.splits import insert_splits
from netspec.graph.steps import PASSES
from netspec.net.net import Net
from netspec.net.weights import copy_weights, load_weights
from netspec.process.garbage import no_collection
from netspec.proto.schema import NetParameter, phase_of
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net, write_text
from netspec.terminal import log


def load_net(
    path: str | Path,
    phase: str | int = "TEST",
    weights: str | Path | None = None,
    level: int = 0,
    stages: Iterable[str] = (),
    device: str | torch.device = "cpu",
    seed: int | None = None,
    allow_python: bool = False,
    exact: str = SMALL,
    strict: bool = False,
    passes: Collection[str] = PASSES,
    write_files: bool = True,
) -> Net:
    """Build the net of a prototxt for a phase, level and stages; ``weights`` names a .caffemodel or .caffemodel.h5.

    A warning names the layers that the weights lack; with ``strict`` that is an error.
    ``passes`` are what may speed up a net of phase TEST that runs without gradients (netspec/graph/steps.py).
    ``exact`` says which sums are Caffe's to the last bit: "none", "small" or "all" (see netspec/exact/__init__.py).
    Without ``write_files`` no layer writes one. Raises SpecError for every fault of the files.
    """
    net, source = parse_net(path)
    options = BuildOptions(
        str(device), seed, allow_python=allow_python, exact=exact, write_files=write_files, passes=passes
    )
    built = build_net(with_state(net, phase_of(phase), level, stages), source, options)
    if weights is not None:
        load_weights(built, weights, strict)
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
