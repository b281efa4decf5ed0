"""Shows how a net in phase TEST runs without gradients: which layers run together, and with which kernels."""

from __future__ import annotations

from typing import Any

import torch

from netspec.graph.options import PASSES
from netspec.net.net import Net
from netspec.proto.schema import TRAIN
from netspec.solver.precision import has_bfloat16

KINDS = {
    "packed": "by oneDNN, with packed weights and channels-last layout",
    "exact": "sums in Caffe's order (--exact)",
    "prepared": "by torch's kernels",
    "as is": "like a layer in training, since its parameters may be modified",
    "by value": "like a layer in training, since its shapes depend on values",
}

_BFLOAT16 = {True: "yes", False: "no", None: "unknown"}


def plan_text(net: Net) -> str:
    """Return one line per step, and an explanation of the kinds of steps. Data is not opened.

    The net must have been built with memory for its weights.
    """
    bfloat16 = f"bfloat16 on this CPU: {_BFLOAT16[has_bfloat16()]}"
    if net.phase == TRAIN:
        why = net.new_trainer()
        how = f"each pass goes through autograd: {why}" if isinstance(why, str) else "by kernels prepared once"
        return f"no passes: nets run layer by layer in phase TRAIN. Training in fp32, {how}; {bfloat16}"
    if net.prepared is None:
        return f"no passes: nets run layer by layer if passes are switched off; {bfloat16}"
    given = tuple(
        (v, shape, torch.float32)
        for node, layer in zip(net.plan.nodes, net.layers, strict=True)
        if not node.bottoms
        for v, shape in zip(node.tops, layer.top_shapes, strict=False)
    )
    sequence = net.prepared.sequence_for(given, frozenset(net.plan.outputs.values()))
    steps = sequence.schedule.steps
    used = [kind for kind in KINDS if kind in sequence.kinds]
    names = [_name(net, step) for step in steps]
    width = max((len(kind) for kind in used), default=0)
    passes = ", ".join(name for name in PASSES if name in net.prepared.passes)
    layers = sum(bool(node.bottoms) for node in net.plan.nodes)
    return "\n".join(
        [
            f"{layers} layers run as {len(steps)} steps; passes: {passes}; {bfloat16}",
            *(f"  {kind:{width}}  {name}" for kind, name in zip(sequence.kinds, names, strict=True)),
            *(f"{kind}: {KINDS[kind]}" for kind in used),
        ]
    )


def _name(net: Net, step: Any) -> str:
    members = [step.node, *(step.chain.folded if step.chain else ())]
    members = sorted(members) + ([step.activation] if step.activation is not None else [])
    return " + ".join(net.plan.nodes[i].name for i in members)
