"""Runs of a net without gradients, by kernels that are made once for each set of input shapes and of blobs to keep.

Kernels keep copies of weights: folded, or in the layout that they prefer. These copies must not become outdated. So
before each run, a KernelSequence checks whether a learned blob was written to, or whether another tensor that shares
its memory is still alive, through which it could be written to. Layers with such blobs read them directly in each run.
They are prepared again once the blobs have stayed the same for a whole run.
"""

from __future__ import annotations

import copy
import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch

from netspec.data.blobs import Shape
from netspec.exact import ALL
from netspec.exact.blas import is_recorded, one_thread
from netspec.fast import steps as planned
from netspec.fast.fold import absorbed_by, roles_of
from netspec.fast.folding import Absorbed, absorbing
from netspec.fast.kernels import Inference, Kernel, with_activation
from netspec.fast.steps import Schedule, schedule
from netspec.fast.table import entry_of, folds_of, inference_kernel, is_fresh
from netspec.files.limits import give_back_freed_memory
from netspec.graph.options import PACK
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import Seen, blobs_of, may_have_alias, uncounted
from netspec.run.parts import hooks_of
from netspec.run.shapes import fitted
from netspec.run.walk import Losses, Result, Step, Values, walk

MOST_SEQUENCES = 64  # that a net keeps; image pyramids need one for each size
MEMORY_FACTOR = 4  # all sequences together may keep this many times the memory of one run
Given = tuple[int, Shape, torch.dtype]  # a value known before the first step: its number, shape and type


@dataclass
class KernelSequence:
    """The kernels of a run in order, for one set of shapes of the inputs and of values to keep."""

    steps: list[Step]
    schedule: Schedule
    kinds: list[str]  # of the steps, see Prepared._kernel
    one_thread: bool
    frozen: list[int]  # indices of the learned blobs whose values it may have copied
    seen: Seen  # the state of these blobs
    changing: list[tuple[torch.Tensor, Seen]]  # the other blobs, which are read in each run, with their state
    memos: set[Any]  # the keys of the tensors in Prepared.memos that it uses
    kept_bytes: int  # that kernels keep for these shapes, in addition to memos
    needed_bytes: int  # the peak of the values, and kept_bytes

    def is_current(self, blobs: list[torch.Tensor]) -> bool:
        """Return whether the kernels still fit the learned blobs.

        They do not if a frozen blob was written to or replaced, or if a changing blob has stayed the same since the
        last call, so that faster kernels are possible.
        """
        if not self.seen.are([blobs[i] for i in self.frozen] if self.changing else blobs):
            return False
        if not self.changing:
            return True
        unchanged = [before.are([blob]) and not may_have_alias(blob) for blob, before in self.changing]
        self.changing = [(blob, Seen([blob], values=True)) for blob, _ in self.changing]
        return not any(unchanged)


class Prepared:
    """A runner without gradients. It makes a KernelSequence for each set of shapes and kept values, when needed."""

    def __init__(
        self,
        plan: Plan,
        layers: Sequence[Layer],
        losses: Losses,
        exact: str,
        passes: Collection[str],
    ) -> None:
        self.passes = frozenset(passes)
        self._plan, self._layers, self._exact = plan, list(layers), exact
        self._device = layers[0].context.device if len(layers) else None
        self._losses = losses
        self._sources = [
            Step(i, layer.run, (), node.tops, self._losses[i])
            for i, (node, layer) in enumerate(zip(plan.nodes, self._layers, strict=True))
            if not node.bottoms and not layer.is_input
        ]
        self.sequences: OrderedDict[Any, KernelSequence] = OrderedDict()
        self.memos: dict[Any, tuple[Seen, Any]] = {}  # tensors that kernels of several sequences share, by key
        self._blobs, self._hooks = blobs_of(self._layers), hooks_of(self._layers)
        self._seen: dict[int, Seen] = {}

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net on the values ``given``. Return None if torch records gradients or a layer has hooks."""
        found = self.run_in_any_layout(given, kept)
        return found and (found[0], {v: value.contiguous() for v, value in found[1].items()})

    def run_in_any_layout(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net like :meth:`run`. The returned values may be in channels_last, as kernels make them.

        Layers without bottoms run first, because the shapes of records are known only after data layers have run.
        """
        if torch.is_grad_enabled() or is_recorded() or any(self._hooks):
            return None
        values: Values = dict(given)
        with uncounted():
            loss = walk(self._sources, values, self._exact) if self._sources else None
            sequence = self.sequence_for(tuple([(v, x.shape, x.dtype) for v, x in values.items()]), kept)
            with one_thread() if sequence.one_thread else nullcontext():
                term = walk(sequence.steps, values, self._exact)
        origin = sequence.schedule.origin
        loss = term if loss is None else loss if term is None else loss + term
        return loss, {v: values[origin[v]] for v in kept}

    def sequence_for(self, given: tuple[Given, ...], kept: frozenset[int]) -> KernelSequence:
        """Return the kernels for values of these shapes and types. Make them if there are none, or if blobs changed."""
        key = (given, kept)
        sequence = self.sequences.get(key)
        if sequence is not None and sequence.is_current(self._blobs()):
            self.sequences.move_to_end(key)
            return sequence
        give_back_freed_memory()
        with torch.inference_mode(False), torch.no_grad():
            sequence = self.sequences[key] = self._make(given, kept)
        self.sequences.move_to_end(key)
        self._trim()
        return sequence

    def _trim(self) -> None:
        """Remove the least recently used sequences until the rest are within the limits."""
        learned = sum(blob.nbytes for layer in self._layers for blob in layer.blobs)
        most = MEMORY_FACTOR * (learned + max(sequence.needed_bytes for sequence in self.sequences.values()))
        while True:
            used = set[Any]().union(*(sequence.memos for sequence in self.sequences.values()))
            self.memos = {key: memo for key, memo in self.memos.items() if key in used}
            if len(self.sequences) == 1 or (len(self.sequences) <= MOST_SEQUENCES and self.kept_bytes() <= most):
                return
            self.sequences.popitem(last=False)

    def kept_bytes(self) -> int:
        """Return the bytes that sequences keep in addition to the learned blobs."""
        values = [value for _, value in self.memos.values()]
        tensors = [blob for value in values for blob in (value.blobs if isinstance(value, Absorbed) else (value,))]
        own = sum(sequence.kept_bytes for sequence in self.sequences.values())
        return own + sum({id(tensor): tensor.nbytes for tensor in tensors}.values())

    def _make(self, given: tuple[Given, ...], kept: frozenset[int]) -> KernelSequence:
        plan = self._plan
        # The layers at these shapes; None where the shapes depend on values.
        found, shapes = fitted(plan, self._layers, {v: tuple(shape) for v, shape, _ in given})
        layers = [fit or layer for fit, layer in zip(found, self._layers, strict=True)]
        changing = self._changing()
        probe = torch.empty(1, dtype=next((dtype for *_, dtype in given), torch.float32), device=self._device)
        exact = [fit is not None and fit.arithmetic(probe).is_caffes for fit in found]
        as_is = [fit is None or bool(changing & set(map(id, fit.blobs))) for fit in found]
        roles = roles_of(plan, layers)
        foldable = [not (e or a) for e, a in zip(exact, as_is, strict=True)]
        order = schedule(
            plan,
            replace(
                roles,
                absorbs=_both(roles.absorbs, foldable),
                affine=_both(roles.affine, foldable),
                absorbs_before=_both(roles.absorbs_before, foldable),
                is_activation=[fit is not None and folds_of(fit).activation is not None for fit in found],
                fresh=[fit is not None and is_fresh(fit) for fit in found],
            ),
            given=[v for v, *_ in given],
            kept=kept | {v for node, losses in zip(plan.nodes, self._losses, strict=True) if losses for v in node.tops},
            passes=self.passes,
        )
        steps, kinds, memos, own_bytes = [], [], set[Any](), list[int]()
        for step in order.steps:
            depends_on_values = found[step.node] is None
            kernel, kind = self._kernel(step, layers, depends_on_values, as_is[step.node], memos, own_bytes.append)
            kinds.append("exact" if exact[step.node] else kind)
            steps.append(Step(step.node, kernel, step.bottoms, step.tops, self._losses[step.node], step.ends))
        blobs = self._blobs()
        frozen = [i for i, blob in enumerate(blobs) if id(blob) not in changing]
        return KernelSequence(
            steps,
            order,
            kinds,
            one_thread=any(exact),
            frozen=frozen,
            seen=Seen([blobs[i] for i in frozen], values=True),
            changing=[(blob, Seen([blob], values=True)) for blob in blobs if id(blob) in changing],
            memos=memos,
            kept_bytes=sum(own_bytes),
            needed_bytes=sum(own_bytes) + _most_alive(order.steps, shapes),
        )

    def _kernel(
        self,
        step: planned.PlannedStep,
        layers: Sequence[Layer],
        depends_on_values: bool,
        as_is: bool,
        memos: set[Any],
        keeps: Callable[[int], None],
    ) -> tuple[Kernel, str]:
        """Return the kernel of a step, and its kind: "by value", "as is", "packed" or "prepared".

        ``depends_on_values``: the shapes of the layer do. ``as_is``: the kernel must not copy the layer's blobs. The
        keys of the memos that it uses are added to ``memos``; ``keeps`` is called with the number of other bytes.
        """
        layer = layers[step.node]
        last = layers[step.chain.last if step.chain else step.node]
        if depends_on_values:
            layer = layer if layer.changes_itself else copy.copy(layer)
            return lambda *bottoms: layer.run(*(bottom.contiguous() for bottom in bottoms)), "by value"
        members = (step.node, *(step.chain.folded if step.chain else ()))
        blobs = [blob for i in members for blob in layers[i].blobs]
        own_shapes = [shape for i in members for shape in layers[i].blob_shapes]  # differ with share_mode: PERMISSIVE
        uses: list[str] = []

        def memo(name: str, make: Callable[[], Any]) -> Any:
            uses.append(name)
            # Layers that share blobs in one shape share their memos too, unless other layers are folded into them.
            key = (name, step.chain, *map(id, blobs), *own_shapes)
            memos.add(key)
            kept = self.memos.get(key)
            if kept is None or not kept[0].are(blobs):
                kept = self.memos[key] = Seen(blobs, values=True), make()
            return kept[1]

        if step.chain:
            chain = step.chain
            layer = absorbing(layer, memo("fold", lambda: absorbed_by(chain, layers, layers[chain.keeper].blobs[0])))
        activation = None if step.activation is None else folds_of(layers[step.activation]).activation
        how = Inference(
            activation=activation, reuse=step.reuse, lasts=step.lasts, memo=memo, pack=PACK in self.passes, keeps=keeps
        )
        own = None if as_is else inference_kernel(layer, how)
        kernel = own or with_activation(layer.forward, activation)
        if not entry_of(layer).any_layout or self._exact == ALL:
            kernel = _contiguous(kernel)
        if own is None:
            kernel = _checked(kernel, last)
        if as_is:
            return kernel, "as is"
        own_uses = [name for name in uses if name != "fold"]
        return kernel, "packed" if own_uses else "prepared"

    def _changing(self) -> set[int]:
        """Return the learned blobs that may change between runs: those that did, and those with a live alias."""
        found = set()
        for blob in self._blobs():
            before = self._seen.get(id(blob))
            if (before and not before.are([blob])) or may_have_alias(blob):
                found.add(id(blob))
            self._seen[id(blob)] = Seen([blob], values=True)
        return found


def _contiguous(kernel: Kernel) -> Kernel:
    """Return a kernel that makes its bottoms contiguous first."""
    return lambda *bottoms: kernel(*(bottom.contiguous() for bottom in bottoms))


def _checked(kernel: Kernel, layer: Layer) -> Kernel:
    """Return a kernel that compares the shapes of its tops with the layer's ``top_shapes`` in its first run."""

    def checked(*bottoms: torch.Tensor) -> Any:
        nonlocal unchecked
        tops = kernel(*bottoms)
        if unchecked:
            layer.check_shapes(tops if isinstance(tops, tuple) else (tops,))
            unchecked = False
        return tops

    unchecked = True
    return checked


def _most_alive(steps: Sequence[planned.PlannedStep], shapes: Mapping[int, Shape]) -> int:
    """Return the peak memory of the values in bytes, as far as their shapes are known."""
    alive, most = dict[int, int](), 0
    for step in steps:
        alive.update((v, 4 * math.prod(shapes[v])) for v in (*step.bottoms, *step.tops) if v in shapes)
        most = max(most, sum(alive.values()))
        for v in step.ends:
            alive.pop(v, None)
    return most


def _both(these: Sequence[bool], those: Sequence[bool]) -> list[bool]:
    return [a and b for a, b in zip(these, those, strict=True)]
