"""Insert a Split layer after every blob that is used more than once (Caffe: src/caffe/util/insert_splits.cpp).

Autograd adds gradients without these layers, but Caffe's blob names, log and caffemodel files contain them.
An explicit loss_weight of a blob counts as one use; the first of its copies then has the weight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from netspec.errors import Code, SpecError, did_you_mean
from netspec.proto.schema import NetParameter, copy_without
from netspec.proto.source_map import SourceMap

SPLIT = "Split"
Top = tuple[int, int]  # layer index, top index
MOST_NAMES = 20  # number of blobs in an error
MOST_HINTS = 20  # number of unknown blobs for which to suggest similar names, which is slow in large nets


def insert_splits(net: NetParameter, source: SourceMap) -> tuple[NetParameter, SourceMap]:
    """Return the net with Split layers inserted."""
    producer, uses, weights = _count_uses(net, source)
    split = copy_without(net, {"layer"})
    positions = []
    used: Counter[Top] = Counter()
    for i, layer in enumerate(net.layer):
        copy = split.layer.add()
        copy.CopyFrom(layer)
        positions.append(source.layers[i])
        for j, blob in enumerate(layer.bottom):
            top = producer.get((i, j))
            if top is not None and uses[top] > 1:
                copy.bottom[j] = _blob_name(net.layer[top[0]].name, blob, top[1], used[top])
                used[top] += 1
        for j, blob in enumerate(layer.top):
            top = (i, j)
            if uses[top] > 1:
                added = split.layer.add()
                positions.append(source.layers[i])
                added.name = f"{blob}_{layer.name}_{j}_split"
                added.type = SPLIT
                added.bottom.append(blob)
                added.top.extend(_blob_name(layer.name, blob, j, k) for k in range(uses[top]))
                if weights.get(top):
                    copy.ClearField("loss_weight")
                    added.loss_weight.extend([weights[top]] + [0.0] * (uses[top] - 1))
                    used[top] += 1
    return split, source.with_layers(positions)


def is_split(name: str, kind: str) -> bool:
    """Return whether :func:`insert_splits` inserts a layer with this name and type."""
    return kind == "Split" and name.endswith("_split")


def _last_names(blobs: Mapping[str, object]) -> str:
    """Return the names of the blobs so far, or only of the last ones if there are many."""
    more = f"{len(blobs) - MOST_NAMES} more, " if len(blobs) > MOST_NAMES else ""
    return more + ", ".join([*blobs][-MOST_NAMES:]) or "none"


def _blob_name(layer: str, blob: str, top: int, copy: int) -> str:
    return f"{blob}_{layer}_{top}_split_{copy}"


def _count_uses(
    net: NetParameter, source: SourceMap
) -> tuple[dict[tuple[int, int], Top], Counter[Top], dict[Top, float]]:
    """Return which top each bottom reads, how often each top is used, and the tops' explicit loss weights."""
    latest: dict[str, Top] = {}
    producer: dict[tuple[int, int], Top] = {}
    uses: Counter[Top] = Counter()
    weights: dict[Top, float] = {}
    reported: set[str] = set()
    for i, layer in enumerate(net.layer):
        for j, blob in enumerate(layer.bottom):
            if blob not in latest:
                maker, remedy = source.left_out.get(blob, ("", ""))
                if (remedy or blob) not in reported:
                    reported.add(remedy or blob)
                    hint = "" if maker or len(reported) > MOST_HINTS else did_you_mean(blob, list(latest))
                    known = (
                        f": {maker} makes it {remedy}" if maker else f"{hint or ';'} available: {_last_names(latest)}"
                    )
                    where = source.at(i, "bottom", j, layer=layer.name, type=layer.type)
                    message = f'unknown bottom blob "{blob}"{known}'
                    source.report(SpecError(message, where, Code.UNKNOWN_BOTTOM, (blob,)))
                continue
            producer[i, j] = latest[blob]
            uses[latest[blob]] += 1
        for j, blob in enumerate(layer.top):
            latest[blob] = (i, j)
        for j, weight in enumerate(layer.loss_weight[: len(layer.top)]):
            top = latest[layer.top[j]]
            weights[top] = weight
            if weight:
                uses[top] += 1
    return producer, uses, weights
