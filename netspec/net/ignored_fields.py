"""Fields of a prototxt that have no effect: Caffe ignores them silently, a net here warns once for each.

A field may belong to another layer's type (``pooling_param`` in a Convolution, ``loss_param`` in an EuclideanLoss), to
another filler (``std`` with xavier), or to an older format (``data_param { scale: ... }``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from google.protobuf.message import Message

from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.fillers import READS
from netspec.proto.forks import forks

#: Fields of every layer, which the net reads.
COMMON = frozenset(
    {"name", "type", "bottom", "top", "phase", "loss_weight", "param", "blobs", "propagate_down", "include", "exclude"}
)
#: These set how Caffe computes, not what: no result depends on them.
HOW_NOT_WHAT = frozenset({"engine", "force_nd_im2col", "share_in_parallel", "stable_prod_grad"})

Path = tuple[str, ...]


def unused_fields(plan: Plan, layers: Iterable[Layer]) -> Iterator[str]:
    """Yield a line for each field without effect: its first place in the file, and the number of others."""
    found: dict[tuple[str, Path, str], list[int]] = {}
    for i, layer in enumerate(layers):
        for path, reason in _unused(layer):
            found.setdefault((layer.type, path, reason), []).append(i)
    for (kind, path, reason), places in found.items():
        first = places[0]
        where = plan.source.at(first, *path, layer=plan.nodes[first].name, type=kind)
        others = f" (also in {len(places) - 1} more of these layers)" if len(places) > 1 else ""
        yield f"{where}: {'.'.join(path)} has no effect: {reason}{others}"
    for field, _ in plan.net.ListFields():
        if field.is_extension or field.name == "debug_info":
            advice = "; set it in the solver" if field.name == "debug_info" else ""
            yield f"{plan.source.net.find(field.name)}: {field.name} has no effect in a net{advice}"


def doubtful_layers(plan: Plan, layers: Iterable[Layer]) -> Iterator[str]:
    """Yield a line for each type of layers of which nothing shows which fork's they are: the first of them."""
    first: dict[str, int] = {}
    for i, layer in enumerate(layers):
        if doubt := forks().doubt(layer):
            first.setdefault(doubt, i)
    for doubt, i in first.items():
        yield f"{plan.source.at(i, layer=plan.nodes[i].name, type=plan.nodes[i].type)}: {doubt}"


def _unused(layer: Layer) -> Iterator[tuple[Path, str]]:
    partly = {name.partition(".")[0] for name in layer.reads if "." in name}
    for field, value in layer.param.ListFields():
        if field.name in COMMON or field.name in HOW_NOT_WHAT:
            continue
        if field.name not in layer.reads | partly:
            yield (field.name,), f"a layer of type {layer.type} does not read it"
            continue
        if field.message_type is None:
            continue
        whole = field.name in layer.reads
        for inner, inner_value in value.ListFields():
            path = f"{field.name}.{inner.name}"
            known = (whole and not inner.is_extension and path not in layer.ignores) or path in layer.reads
            if not known and inner.name not in HOW_NOT_WHAT:
                yield (field.name, inner.name), f"a layer of type {layer.type} does not read it"
            elif inner.message_type is not None and inner.message_type.full_name == "caffe.FillerParameter":
                for filler in [inner_value] if isinstance(inner_value, Message) else inner_value:
                    for name, reason in _unused_of_filler(filler):
                        yield (field.name, inner.name, name), reason


def _unused_of_filler(filler: Any) -> Iterator[tuple[str, str]]:
    for field, _ in filler.ListFields():
        if field.name != "type" and field.name not in READS.get(filler.type, ()):
            yield field.name, f'filler "{filler.type}" does not read it'
