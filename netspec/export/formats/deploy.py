"""Converts a net for deployment: inputs for data layers, no labels and losses, BatchNorm and Scale in the weights.

The result is a NetParameter with its weights, for Caffe or any reader of its files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from netspec.data import blobs
from netspec.errors import SpecError, Where
from netspec.export.formats.inputs import add_input, wrong_given_shapes
from netspec.files.whole_file import whole_file
from netspec.graph.filter import filter_net
from netspec.graph.options import BuildOptions
from netspec.graph.plan import origins
from netspec.graph.speed import speed
from netspec.layers.contract.data_layer import DataLayer
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import NetParameter, ParamSpec, copy_without
from netspec.proto.source_map import SourceMap
from netspec.proto.text import write_text


def with_inputs(net: Any, source: SourceMap, options: BuildOptions, labels: bool = True) -> tuple[Any, SourceMap]:
    """Return a net in which layers that read data are Input layers; ``options`` has the shapes of their tops.

    Without ``labels``, only the first top of such a layer is kept. Layers that need another top (losses, accuracies)
    are left out, and the scores that they read become outputs. The ``state`` of the net determines its layers. Raises
    SpecError for errors in the net, and for a given shape of a blob that no such layer makes.
    """
    filtered, source = filter_net(net, source)
    if faults := wrong_given_shapes(options.given_shapes, [filtered], source.file):
        raise faults[0]
    probe = build_net(filtered, source, replace(options, device="meta", seed=0, open_data=False))
    built = iter(probe.layers)  # with Splits between them; two layers may have one name
    result = copy_without(filtered, {"layer"})
    positions, missing = [], set()
    for i, layer in enumerate(filtered.layer):
        made = next(each for each in built if each.param.name == layer.name)
        if missing & set(layer.bottom):
            missing.update(layer.top)
            continue
        missing.difference_update(layer.top)
        if not isinstance(made, DataLayer):
            result.layer.add().CopyFrom(layer)
            positions.append(source.layers[i])
            continue
        kept = list(layer.top) if labels else list(layer.top)[:1]
        missing.update(list(layer.top)[len(kept) :])
        add_input(result, layer.name, dict(zip(kept, made.top_shapes, strict=False)))
        positions.append(source.layers[i])
    return result, source.with_layers(positions)


def fold(net: Net) -> NetParameter:
    """Return the folded net with its weights. Layers that return their bottom, such as Split and Dropout, are removed.

    netspec/fast/fold.py says what is folded. The remaining blobs and all outputs keep their names. Layers that share
    parameters still share them if the parameters are equal after folding.
    """
    folds = _found_folds(net)
    plan = net.plan
    passes = [layer.passes_on for layer in net.layers]
    origin = origins(plan, passes)
    names = _names(net, origin)
    folded = {i for each in folds for i in each.chain.folded}
    absorbed = {each.chain.keeper: each for each in folds}
    last = {each.chain.keeper: each.chain.last for each in folds}
    first = {each.chain.keeper: min(each.chain.keeper, *each.chain.folded) for each in folds}
    result = NetParameter(name=net.name)
    for i, layer in enumerate(net.layers):
        if i in folded:
            continue
        tops = [v for v in plan.nodes[last.get(i, i)].tops if not (passes[i] and v not in names)]
        if passes[i] and not tops:
            continue
        written = result.layer.add()
        written.CopyFrom(absorbed[i].absorbed.param if i in absorbed else layer.param)
        for field in ("bottom", "top", "include", "exclude", "phase", "param", "propagate_down", "blobs"):
            written.ClearField(field)
        written.bottom.extend(names[origin[v]] for v in plan.nodes[first.get(i, i)].bottoms)
        written.top.extend(names[v] for v in tops)
        values = absorbed[i].absorbed.blobs if i in absorbed else tuple(layer.blob(j) for j in range(len(layer.blobs)))
        written.param.extend(_shared_names(net, i, absorbed))
        for blob in values:
            written.blobs.append(blobs.from_array(blob.detach().cpu().float().numpy()))
    return result


def _found_folds(net: Net) -> list[Any]:
    if speed() is None:
        raise SpecError("folding a net needs netspec/fast, which is not installed", Where(net.plan.source.file))
    from netspec.fast.fold import find_folds

    return find_folds(net.plan, list(net.layers))


def _names(net: Net, origin: tuple[int, ...]) -> dict[int, str]:
    """Return the names of the remaining values.

    An output of a layer that is removed keeps its name: the value that the layer copies gets this name. If other layers
    read that value too, or if it has several such names, it keeps its own name, and the layers that copy it stay.
    """
    plan = net.plan
    names = {v: blob for v, blob in enumerate(plan.blobs) if origin[v] == v}
    taken = {v for v, count in Counter(origin[v] for v in plan.outputs.values()).items() if count > 1}
    taken.update(v for v in plan.outputs.values() if origin[v] == v)
    taken.update(
        origin[v]
        for node, layer in zip(plan.nodes, net.layers, strict=True)
        if not layer.passes_on
        for v in node.bottoms
    )
    taken.update(v for node, layer in zip(plan.nodes, net.layers, strict=True) if layer.is_input for v in node.tops)
    for name, v in plan.outputs.items():
        if origin[v] != v and origin[v] in taken:
            names[v] = name
        elif origin[v] != v:
            names[origin[v]] = name
    return names


def _shared_names(net: Net, index: int, absorbed: Mapping[int, Any]) -> list[Any]:
    """Return the ``param { name }`` with which a layer shares its blobs; none if they differ after folding."""
    layer, node = net.layers[index], net.plan.nodes[index]
    named = [spec.name for spec in node.params]
    if not any(named):
        return []
    sharers = [
        i
        for i, other in enumerate(net.layers)
        if {id(blob) for blob in other.blobs} & {id(blob) for blob in layer.blobs}
    ]
    if len(sharers) < 2:
        return []
    values = [absorbed[i].absorbed.blobs if i in absorbed else tuple(net.layers[i].blobs) for i in sharers]
    for others in values[1:]:
        if len(others) != len(values[0]) or not all(map(_equal, others, values[0])):
            return []
    names = [*named, *[""] * (len(values[0]) - len(named))]
    return [ParamSpec(name=name or f"{named[0]}_{j}") for j, name in enumerate(names)]


def _equal(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and bool(torch.equal(a, b))


def write_caffe(message: NetParameter, prefix: str | Path) -> tuple[Path, Path]:
    """Write PREFIX.prototxt and PREFIX.caffemodel of a net with its weights; return both paths."""
    prototxt, weights = (Path(f"{prefix}.{ending}") for ending in ("prototxt", "caffemodel"))
    text = NetParameter()
    text.CopyFrom(message)
    for layer in text.layer:
        del layer.blobs[:]
    with whole_file(prototxt) as unfinished, whole_file(weights) as unfinished_weights:
        unfinished.write_text(write_text(text))
        unfinished_weights.write_bytes(message.SerializeToString(deterministic=True))
    return prototxt, weights
