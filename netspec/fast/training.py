"""Trains small nets without autograd: each layer is prepared once as a forward and a backward kernel.

Autograd takes about a millisecond for ten layers, whatever their size, which is most of the time of a net with small
layers or batches. Here a run calls the kernels of the layers (kernels.py, layers/) in order. The numbers are the same.
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from netspec.exact.blas import one_thread
from netspec.fast.kernels import Kernel, Learning
from netspec.fast.table import learning_kernels, learns_alone
from netspec.files.limits import is_out_of_memory
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import Seen, blobs_of
from netspec.run.overwritten import Overwritten
from netspec.run.parts import Part, hooks_of
from netspec.run.recorded import Backward, Kernels, recorded
from netspec.run.walk import Loss, Losses

LARGEST = 2**22  # numbers in all tops: in larger nets the time of autograd is negligible, and it needs less memory
Values = list[Any]  # by value number, a tensor or None


def obstacle(plan: Plan, parts: Sequence[Part]) -> str:
    """Return the reason why prepared kernels cannot train a net of these parts; "" if they can."""
    layers = [layer for part in parts for layer in part.members]
    count = sum(math.prod(shape) for part in parts for shape in part.layer.top_shapes)
    if count > LARGEST:
        return f"its tops have {count:,} numbers, more than {LARGEST:,}"
    if not layers:
        return "it has no layers"
    for node, layer in zip(plan.nodes, layers, strict=True):
        if layer.context.device.type != "cpu":
            return "it runs on a GPU"
        if layer.is_input:
            return f'"{node.name}" is an input'
        if node.bottoms and node.tops and layer.counted_axis is not None:
            return f'"{node.name}" determines the shapes of its tops in each pass'
        if any(blob.dtype != torch.float32 for blob in layer.blobs):
            return f'"{node.name}" does not compute in float32'
    readers = Counter(v for node in plan.nodes for v in node.bottoms)
    if any(count > 1 for count in readers.values()):
        return "a blob has several readers without a Split"
    owned = Counter(id(blob) for layer in layers for blob in layer.blobs if blob.requires_grad)
    for part in parts:
        if any(owned[id(blob)] > 1 for blob in part.blobs) and not learns_alone(part.layer):
            name = plan.nodes[part.last].name
            return f'"{name}" shares parameters, and only autograd adds up their gradients'
    return ""


@dataclass
class _TrainingKernels:
    """The kernels of all layers for one set of shapes."""

    forward: list[tuple[Kernel, tuple[int, ...], tuple[int, ...], tuple[Loss, ...]]]
    backward: list[tuple[Backward, tuple[int, ...], tuple[int, ...]]]
    start: Values  # the gradients at the start of the backward pass: those of the losses
    seen: Seen  # the state of the learnable blobs; kernels write to their gradients


class TrainingStep:
    """Runs a net that trains forward and backward.

    ``losses`` are the tops with a loss weight, by layer, and ``weighted(top, weight)`` returns what the top adds to the
    loss. ``overwritten[i]``: layer i, if its gradient reads memory that is overwritten in place.
    """

    def __init__(
        self,
        plan: Plan,
        parts: Sequence[Part],
        losses: Losses,
        overwritten: Sequence[Overwritten | None],
        weighted: Callable[[torch.Tensor, float], torch.Tensor],
    ) -> None:
        self._plan, self._parts, self._loss_of = plan, list(parts), losses
        self._layers = layers = [layer for part in parts for layer in part.members]
        self._overwritten, self._weighted = overwritten, weighted
        self._sources = [i for i, node in enumerate(plan.nodes) if not node.bottoms and not len(layers[i].blobs)]
        self._hooks = hooks_of(layers)
        self._blobs = blobs_of(layers)
        self._made: dict[Any, _TrainingKernels] = {}  # by shapes, and by the blobs that learn
        self._values: Values = []

    def is_watched(self) -> bool:
        """Return whether this class must not run the net.

        So it is if layers or learnable blobs have hooks, which need autograd, if gradients are switched off, or under
        autocast.
        """
        if any(self._hooks) or not torch.is_grad_enabled() or torch.is_autocast_enabled("cpu"):
            return True
        return any(blob._backward_hooks or blob._post_accumulate_grad_hooks for blob in self._blobs())

    def run(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net forward and backward; return the weighted sum of its losses, and the outputs.

        The gradients of the learnable blobs are added to ``grad``. The loss is valid until the next call.
        """
        plan, layer = self._plan, self._layers[0]
        try:
            with torch.no_grad(), one_thread():
                values: Values = [None] * len(plan.blobs)
                shapes = []
                for i in self._sources:
                    layer = self._layers[i]
                    tops = layer.forward()
                    for v, top in zip(plan.nodes[i].tops, tops if isinstance(tops, tuple) else (tops,), strict=False):
                        values[v] = top
                        shapes.append(top.shape)
                blobs = self._blobs()
                key = (*shapes, *[blob.requires_grad for blob in blobs])
                prepared = self._made.get(key)
                if prepared is None or not prepared.seen.are(blobs):
                    self._made = {key: (prepared := self._prepare(values))}
                return self._run(prepared, values)
        except (MemoryError, RuntimeError) as fault:
            if is_out_of_memory(fault):
                raise layer.error("the training needs more memory than available") from None
            raise

    def _run(self, prepared: _TrainingKernels, values: Values) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        # netspec/run/walk.py would take up to 1.1 times as long: its values are in a dict, and it copies scalar losses.
        self._values = values
        loss: torch.Tensor | None = None
        for kernel, bottoms, tops, losses in prepared.forward:
            made = kernel(*[values[v] for v in bottoms])
            if not isinstance(made, torch.Tensor):
                for v, top in zip(tops, made, strict=False):
                    values[v] = top
            else:
                if tops:
                    values[tops[0]] = made
                made = (made,)
            for j, weight, _ in losses:
                term = made[j] if weight == 1 and not made[j].shape else self._weighted(made[j], weight)
                loss = term if loss is None else loss + term
        diffs = list(prepared.start)
        for kernel, tops, bottoms in prepared.backward:
            given = [diffs[v] for v in tops]
            if all(diff is None for diff in given):
                continue
            found = kernel(*given)
            if found is not None:
                for v, diff in zip(bottoms, (found,) if isinstance(found, torch.Tensor) else found, strict=False):
                    if v >= 0 and diff is not None:
                        diffs[v] = diff if diffs[v] is None else diffs[v] + diff
        self._values = []
        outputs = {name: values[v].clone() for name, v in self._plan.outputs.items()}
        return torch.zeros(()) if loss is None else loss, outputs

    def _prepare(self, values: Values) -> _TrainingKernels:
        """Make the kernels for values of these shapes, and allocate the gradient of every learned blob."""
        plan = self._plan
        shapes = {v: tuple(x.shape) for v, x in enumerate(values) if x is not None}
        needs: set[int] = set()  # values with a gradient that is used
        blobs = self._blobs()
        for blob in blobs:
            if blob.requires_grad and blob.grad is None:
                blob.grad = torch.zeros_like(blob, memory_format=torch.contiguous_format)
        made = _TrainingKernels([], [], [None] * (len(plan.blobs) + len(plan.nodes)), Seen(blobs))
        for part in self._parts:
            i, layer, node, tops = part.last, part.layer, plan.nodes[part.first], plan.nodes[part.last].tops
            if i in self._sources:
                if losses := self._losses(i, layer, made):
                    made.forward.append((lambda *tops: tops, tops, (), losses))
                continue
            layer.fit([shapes[v] for v in node.bottoms])
            shapes.update(zip(tops, layer.top_shapes, strict=False))
            wanted = tuple(v in needs and not stop for v, stop in zip(node.bottoms, node.blocked, strict=True))
            forward, backward = self._kernels(part, wanted)
            made.forward.append((forward, node.bottoms, tops, self._losses(i, layer, made)))
            if any(wanted) or any(blob.requires_grad for blob in part.blobs):
                needs.update(tops)
                bottoms = tuple(v if w else -1 for v, w in zip(node.bottoms, wanted, strict=True))
                made.backward.append((backward, self._tops(i), bottoms))
        made.backward.reverse()
        return made

    def _losses(self, i: int, layer: Layer, made: _TrainingKernels) -> tuple[Loss, ...]:
        """Add the gradients of a layer's losses to ``made.start``. Return the losses."""
        for j, weight, learns in self._loss_of[i]:
            if learns:
                made.start[self._tops(i)[j]] = torch.full(layer.top_shapes[j], weight)
        return self._loss_of[i]

    def _tops(self, i: int) -> tuple[int, ...]:
        """Return the numbers of the values that layer ``i`` makes. A loss without a named top makes one too."""
        return self._plan.nodes[i].tops or (len(self._plan.blobs) + i,)

    def _kernels(self, part: Part, wanted: tuple[bool, ...]) -> Kernels:
        if reader := self._overwritten[part.first]:
            return self._overwritten_kernels(reader, self._plan.nodes[part.first].bottoms)
        whole = all(
            layer.blob(j) is blob and blob.is_contiguous()
            for layer in part.members
            for j, blob in enumerate(layer.blobs)
        )
        how = Learning(wanted, tuple(blob.grad if blob.requires_grad else None for blob in part.blobs))
        return (whole and learning_kernels(part.layer, how)) or recorded(part.layer.run, wanted, part.blobs)

    def _overwritten_kernels(self, reader: Overwritten, bottoms: Sequence[int]) -> Kernels:
        """Return the kernels of a layer whose gradient reads what later layers wrote into the memory of its blobs."""

        def forward(*given: torch.Tensor) -> torch.Tensor:
            return reader.layer.run(*given)[0]

        def backward(diff: torch.Tensor) -> tuple[torch.Tensor, ...]:
            values = self._values
            return reader.gradients([values[v] for v in bottoms], values[reader.final], diff)

        return Kernels(forward, backward)
