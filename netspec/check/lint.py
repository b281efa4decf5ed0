"""What is legal but likely a mistake: the warnings of ``netspec check``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from netspec.errors import Where
from netspec.net.net import Net
from netspec.proto.schema import TRAIN
from netspec.proto.source_map import Place

FAR = 0.1  # share of the records that a test may skip, or read twice
#: The settings that each rate policy, and each update rule, reads.
POLICY_SETTINGS = {
    "step": ("gamma", "stepsize"),
    "exp": ("gamma",),
    "inv": ("gamma", "power"),
    "multistep": ("gamma", "stepvalue"),
    "poly": ("power",),
    "sigmoid": ("gamma", "stepsize"),
}
RULE_SETTINGS = {
    "adagrad": ("delta",),
    "rmsprop": ("delta", "rms_decay"),
    "adadelta": ("delta",),
    "adam": ("delta", "momentum2"),
}


def net_advice(net: Net) -> Iterator[str]:
    """Yield a line for each thing in a built net that is likely wrong."""
    yield from _towers(net)
    yield from _losses(net)
    yield from _unused(net)
    yield from _bare_batch_norms(net)
    yield from _namesakes(net)


def solver_advice(solver: Any, node: Place, nets: list[Net]) -> Iterator[str]:
    """Yield a line for each thing in a solver, with its built nets (training net first), that is likely wrong."""
    if solver.snapshot > solver.max_iter:
        yield f"{node.find('snapshot')}: snapshot {solver.snapshot} is more than max_iter {solver.max_iter}: no effect"
    elif not solver.snapshot and not solver.snapshot_after_train:
        yield f"{node.where}: no snapshot is taken; set snapshot, or snapshot_after_train: true"
    for name in _settings_without_effect(solver):
        yield f"{node.find(name)}: {name} has no effect with type {solver.type} and lr_policy {solver.lr_policy}"
    for k, net in enumerate(nets[1:]):
        yield from _test_size(solver.test_iter[k], node.find("test_iter", k), net)


def _settings_without_effect(solver: Any) -> Iterator[str]:
    for table, chosen in ((POLICY_SETTINGS, solver.lr_policy), (RULE_SETTINGS, solver.type.lower())):
        used = table.get(chosen, ())
        for name in dict.fromkeys(name for names in table.values() for name in names):
            given = len(getattr(solver, name)) if name == "stepvalue" else solver.HasField(name)
            if given and name not in used:
                yield name


def missing_data(net: Any, kept: Any, source: Any) -> Iterator[str]:
    """Yield a line if every data layer of ``net`` was filtered out, so that nothing feeds the ``kept`` layers."""
    readers = [i for i, layer in enumerate(net.layer) if not layer.bottom and layer.type != "Input"]
    fed = any(not layer.bottom for layer in kept.layer)
    if readers and kept.layer and not fed:
        layer = net.layer[readers[0]]
        place = source.at(readers[0], layer=layer.name, type=layer.type)
        yield f"{place}: no data layer is left in this phase; add one with include {{ phase: ... }}"


def _towers(net: Net) -> Iterator[str]:
    """A ContrastiveLoss compares two towers: they should share all their parameters."""
    producer = {v: i for i, node in enumerate(net.plan.nodes) for v in node.tops}

    def upstream(v: int) -> set[int]:
        found: set[int] = set()
        pending = [v]
        while pending:
            i = producer[pending.pop()]
            if i not in found:
                found.add(i)
                pending.extend(net.plan.nodes[i].bottoms)
        return found

    for node in net.plan.nodes:
        if node.type != "ContrastiveLoss":
            continue
        first, second = (upstream(v) for v in node.bottoms[:2])
        shared = {id(blob) for i in first for blob in net.layers[i].blobs}
        for i in sorted(second - first):
            count = sum(id(blob) not in shared for blob in net.layers[i].blobs)
            if count:
                total = len(net.layers[i].blobs)
                yield (
                    f"{_place(net, i)}: {count} of its {total} parameter blobs are not shared with the other tower of "
                    f'"{node.name}"; give them the same param {{ name }}'
                )


def _losses(net: Net) -> Iterator[str]:
    if net.phase != TRAIN:
        return
    for i, weights in enumerate(net.loss_weights):
        if any(weights) and not net.backward_plan.layers[i]:
            yield f"{_place(net, i)}: this loss depends on no learnable parameter"


def _unused(net: Net) -> Iterator[str]:
    if not any(any(weights) for weights in net.loss_weights):
        return  # a deploy net: its outputs are its purpose
    weighted = net.output_loss_weights
    for i, (node, layer) in enumerate(zip(net.plan.nodes, net.layers, strict=True)):
        for v in node.tops:
            name = net.plan.blobs[v]
            if net.plan.outputs.get(name) == v and not weighted[name] and not layer.label_bottoms and not layer.is_loss:
                yield f'{_place(net, i)}: no layer uses blob "{name}"'


def _bare_batch_norms(net: Net) -> Iterator[str]:
    readers: dict[int, set[str]] = {}
    for node in net.plan.nodes:
        for v in node.bottoms:
            readers.setdefault(v, set()).add(node.type)
    for i, node in enumerate(net.plan.nodes):
        if node.type == "BatchNorm" and "Scale" not in readers.get(node.tops[0], set()):
            yield f"{_place(net, i)}: no Scale layer follows; Caffe's BatchNorm itself does not scale and shift"


def _namesakes(net: Net) -> Iterator[str]:
    """Saved weights are assigned to layers by name."""
    names: set[str] = set()
    for i, (node, layer) in enumerate(zip(net.plan.nodes, net.layers, strict=True)):
        if node.name in names and layer.blob_shapes:
            yield f"{_place(net, i)}: an earlier layer has the same name; loaded weights go to that layer only"
        names.add(node.name)


def _test_size(iterations: int, where: Where, net: Net) -> Iterator[str]:
    """Compare the number of records that a test reads with the number that exists, if the data is open."""
    for layer in net.layers:
        records = getattr(layer, "num_records", 0)
        if records:
            batch = layer.top_shapes[0][0]
            read = iterations * batch
            if abs(read - records) > FAR * records:
                there = f'layer "{layer.param.name}" has {records} records'
                yield f"{where}: test_iter {iterations} x batch {batch} = {read}, but {there}"
            return


def _place(net: Net, i: int) -> Where:
    node = net.plan.nodes[i]
    return net.plan.source.at(i, layer=node.name, type=node.type)
