"""Checks of a training: its settings before anything is built, its threads, and the origin of a NaN.

In Caffe some of these errors appear only after days.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from netspec.errors import Code, Report, SpecError, raise_fault
from netspec.exact import ALL, NONE
from netspec.files.whole_file import whole_file, why_unwritable
from netspec.graph.plan import Node
from netspec.net.net import Net
from netspec.proto.schema import given
from netspec.proto.source_map import Position
from netspec.solver.lr_policy import policy_faults
from netspec.solver.update import rule_faults

REGULARIZATIONS = ("L2", "L1")
_AT_LEAST_ONE = ("average_loss", "iter_size")
_NOT_NEGATIVE = ("max_iter", "display", "test_interval", "snapshot")


def check_settings(param: Any, node: Position, report: Report = raise_fault) -> None:
    """Report all errors in the solver's own settings; its nets are checked separately."""
    for fault in (*rule_faults(param, node), *policy_faults(param, node)):
        report(fault)
    if param.regularization_type not in REGULARIZATIONS:
        message = f'unknown regularization_type "{param.regularization_type}", expected {" or ".join(REGULARIZATIONS)}'
        report(SpecError(message, node.find("regularization_type")))
    for name in _AT_LEAST_ONE + _NOT_NEGATIVE:
        value, least = getattr(param, name), int(name in _AT_LEAST_ONE)
        if value < least:
            report(SpecError(f"found {name} {value}, expected at least {least}", node.find(name)))
    for i, count in enumerate(param.test_iter):
        if count < 0:
            report(SpecError(f"found test_iter {count}, expected at least 0", node.find("test_iter", i)))
    if param.snapshot > 0 and not param.snapshot_prefix:
        report(SpecError("snapshot is given but snapshot_prefix is not", node.find("snapshot")))


def fields_without_effect(param: Any, node: Position, read: frozenset[str] = frozenset()) -> Iterator[str]:
    """Yield a line for each field of a fork without effect; ``read`` are those that layers of the test nets read."""
    for field in given(param):
        name = field.name
        if field.descriptor.is_extension and name not in read:
            yield f"{node.find(name)}: {name} has no effect: it is a fork's field, and nothing in these nets reads it"


def check_prefix(param: Any, node: Position, report: Report = raise_fault, *, try_it: bool = True) -> None:
    """Report a snapshot_prefix that is not writable.

    The permissions are checked; with ``try_it``, a file is also written (Caffe: CheckSnapshotWritePermissions).
    """
    probe = Path(f"{param.snapshot_prefix}_iter_0.tempfile")
    reason = why_unwritable(probe)
    if try_it and not reason:
        try:
            with whole_file(probe) as unfinished:
                unfinished.write_bytes(b"tried")
            probe.unlink()
        except SpecError as fault:
            reason = str(fault.details[0]) if fault.code is Code.UNWRITABLE else fault.message
    if reason:
        begins = "" if probe.is_absolute() else f"; relative paths start from {Path.cwd()}"
        advice = f"make sure that the directory exists and is writable{begins}"
        message = f'cannot write to snapshot prefix "{param.snapshot_prefix}": {reason}; {advice}'
        report(SpecError(message, node.find("snapshot_prefix")))


def divided_sums(net: Net) -> list[str]:
    """Return the layers on the CPU whose sums torch divides among threads, since they are not in Caffe's order."""
    if net.options.exact == ALL or net.device.type != "cpu":
        return []
    return [
        node.name
        for node, layer in zip(net.plan.nodes, net.layers, strict=True)
        if layer.small is not None and (net.options.exact == NONE or not layer.small)
    ]


def dependence(net: Net, threads: int) -> str:
    """Return a warning if the net's results depend, in the last bits, on the number of threads; else ""."""
    layers = divided_sums(net) if threads > 1 else []
    if not layers:
        return ""
    others = f" and {len(layers) - 1} more" if len(layers) > 1 else ""
    return (
        f"{threads} threads share the sums of {layers[0]}{others}; another number of threads would change the last "
        "bits of the weights. To prevent this, set --exact all (slower) or OMP_NUM_THREADS=1"
    )


def bad_parameter(net: Net) -> str:
    """Return a description of the first learnable blob with a NaN or an infinity; "" if there is none."""
    for layer in net.layers:
        for j, blob in enumerate(layer.blobs):
            if not _is_finite(blob):
                return f'blob {j} of layer "{layer.param.name}"'
    return ""


@torch.no_grad()
def bad_top(net: Net, passes: int, part: str) -> str:
    """Repeat the last passes with the same data and random numbers; return a description of the first bad top.

    ``part`` is the argument of :meth:`Random.begin` for them. Returns "" if no top is bad, since layers may have
    changed state.
    """
    for layer in net.layers:
        state = layer.running_state()
        if "iteration" in state:
            layer.restore({"iteration": max(0, int(state["iteration"]) - passes)})  # pyright: ignore[reportArgumentType]
    net.random.begin(part)
    found: list[str] = []
    hooks = [
        layer.register_forward_hook(partial(_note_if_not_finite, node, net.plan.blobs, found))
        for node, layer in zip(net.plan.nodes, net.layers, strict=True)
    ]
    try:
        for _ in range(passes):
            net.forward_loss()
    finally:
        for hook in hooks:
            hook.remove()
    return found[0] if found else ""


def _note_if_not_finite(
    node: Node, names: Sequence[str], found: list[str], layer: Any, bottoms: Any, tops: Any
) -> None:
    for v, top in zip(node.tops, tops if isinstance(tops, tuple) else (tops,), strict=False):
        if not _is_finite(top):
            found.append(f'top "{names[v]}" of layer "{node.name}"')


def _is_finite(values: torch.Tensor) -> bool:
    return bool(torch.isfinite(values.detach()).all())
