"""Runs of a net without gradients: each layer is prepared once for the current shapes.

A program is the sequence of kernels for one set of input shapes and of blobs to keep. Programs keep copies of weights,
folded or in the layout of a kernel. Before each run, a program checks whether a learned blob was written to, or could
be through an alias that is still alive. Layers with such blobs read them directly until they have not changed for a
run.
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
from netspec.exact.blas import one_thread
from netspec.exact.switch import is_recorded
from netspec.fast import steps as planned
from netspec.fast.fold import absorbed_by, roles_of
from netspec.fast.folding import Absorbed, absorbing
from netspec.fast.kernels import Inference, Kernel, finished
from netspec.fast.steps import Schedule, schedule
from netspec.fast.table import entry_of, folds_of, inference_kernel, is_fresh
from netspec.files.memory import give_back_freed_memory
from netspec.graph.options import PACK
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import Seen, blobs_of, may_have_alias
from netspec.layers.contract.reading import changes_itself
from netspec.run.shapes import fitted
from netspec.run.walk import Result, Step, Values, losses_of, walk

PROGRAMS = 64  # the most that a net keeps; pyramids of images need one for each size
RUNS = 4  # all programs together may keep this many times the memory of one run
Given = tuple[int, Shape, torch.dtype]


@dataclass
class PreparedLine:
    """The kernels of a run in order, for one set of shapes of the inputs and of values to keep."""

    line: list[Step]
    schedule: Schedule
    kinds: list[str]
    one_thread: bool
    frozen: list[int]  # indices of the learned blobs that it holds values of
    seen: Seen  # the state of these blobs
    waiting: list[tuple[torch.Tensor, Seen]]  # blobs that were changing, with their state
    memos: set[Any]  # the keys of other tensors that it keeps in memory
    kept: int  # bytes that kernels keep for these shapes
    need: int  # bytes: the peak of the values, and what kernels keep

    def is_current(self, blobs: list[torch.Tensor]) -> bool:
        """Return whether no blob was written to or replaced since, and all blobs that were changing still are."""
        if not self.seen.are([blobs[i] for i in self.frozen] if self.waiting else blobs):
            return False
        if not self.waiting:
            return True
        resting = [before.are([blob]) and not may_have_alias(blob) for blob, before in self.waiting]
        self.waiting = [(blob, Seen([blob], values=True)) for blob, _ in self.waiting]
        return not any(resting)


class Prepared:
    """Runs a net by programs. One is made for each set of shapes and kept values, when it is first needed."""

    def __init__(
        self,
        plan: Plan,
        layers: Sequence[Layer],
        loss_weights: Sequence[Sequence[float]],
        exact: str,
        passes: Collection[str],
    ) -> None:
        self.passes = frozenset(passes)
        self._plan, self._layers, self._exact = plan, list(layers), exact
        self._device = layers[0].context.device if len(layers) else None
        self._losses = losses_of(loss_weights)
        self._sources = [
            Step(i, layer.run, (), node.tops, self._losses[i])
            for i, (node, layer) in enumerate(zip(plan.nodes, self._layers, strict=True))
            if not node.bottoms and not layer.is_input
        ]
        self.made: OrderedDict[Any, PreparedLine] = OrderedDict()
        self.memos: dict[Any, tuple[Seen, Any]] = {}  # tensors that layers keep, by key
        self._blobs = blobs_of(self._layers)
        self._seen: dict[int, Seen] = {}

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net on the values ``given``. Return None if torch records gradients or a graph.

        Layers without bottoms run first, because the shapes of records are known only after data layers have run.
        """
        if torch.is_grad_enabled() or is_recorded():
            return None
        values: Values = dict(given)
        loss = walk(self._sources, values, self._exact) if self._sources else None
        program = self.line_for(tuple([(v, x.shape, x.dtype) for v, x in values.items()]), kept)
        with one_thread() if program.one_thread else nullcontext():
            term = walk(program.line, values, self._exact)
        origin = program.schedule.origin
        loss = term if loss is None else loss if term is None else loss + term
        return loss, {v: values[origin[v]].contiguous() for v in kept}

    def line_for(self, given: tuple[Given, ...], kept: frozenset[int]) -> PreparedLine:
        """Return the program for values of these shapes and types. Make it if there is none."""
        key = (given, kept)
        program = self.made.get(key)
        if program is None or not program.is_current(self._blobs()):
            give_back_freed_memory()
            with torch.inference_mode(False), torch.no_grad():
                program = self.made[key] = self._make(given, kept)
            self.made.move_to_end(key)
            self._trim()
        self.made.move_to_end(key)
        return program

    def _trim(self) -> None:
        """Remove the least recently used programs until the rest are within the limits."""
        learned = sum(blob.nbytes for layer in self._layers for blob in layer.blobs)
        most = RUNS * (learned + max(program.need for program in self.made.values()))
        while True:
            used = set[Any]().union(*(program.memos for program in self.made.values()))
            self.memos = {key: memo for key, memo in self.memos.items() if key in used}
            if len(self.made) == 1 or (len(self.made) <= PROGRAMS and self.kept_bytes() <= most):
                return
            self.made.popitem(last=False)

    def kept_bytes(self) -> int:
        """Return the bytes that programs keep in addition to the learned blobs."""
        values = [value for _, value in self.memos.values()]
        tensors = [blob for value in values for blob in (value.blobs if isinstance(value, Absorbed) else (value,))]
        own = sum(program.kept for program in self.made.values())
        return own + sum({id(tensor): tensor.nbytes for tensor in tensors}.values())

    def _make(self, given: tuple[Given, ...], kept: frozenset[int]) -> PreparedLine:
        plan = self._plan
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
                finishes=[fit is not None and folds_of(fit).finish is not None for fit in found],
                fresh=[fit is not None and is_fresh(fit) for fit in found],
            ),
            given=[v for v, *_ in given],
            kept=kept | {v for node, losses in zip(plan.nodes, self._losses, strict=True) if losses for v in node.tops},
            passes=self.passes,
        )
        line, kinds, memos, own = [], [], set[Any](), list[int]()
        for step in order.steps:
            kernel, kind = self._kernel(step, layers, found[step.node] is None, as_is[step.node], memos, own.append)
            kinds.append("exact" if exact[step.node] else kind)
            line.append(Step(step.node, kernel, step.bottoms, step.tops, self._losses[step.node], step.ends))
        blobs = self._blobs()
        frozen = [i for i, blob in enumerate(blobs) if id(blob) not in changing]
        return PreparedLine(
            line,
            order,
            kinds,
            any(exact),
            frozen,
            Seen([blobs[i] for i in frozen], values=True),
            [(blob, Seen([blob], values=True)) for blob in blobs if id(blob) in changing],
            memos,
            sum(own),
            sum(own) + _most_alive(order.steps, shapes),
        )

    def _kernel(
        self,
        step: planned.PlannedStep,
        layers: Sequence[Layer],
        unknown: bool,
        as_is: bool,
        memos: set[Any],
        keeps: Callable[[int], None],
    ) -> tuple[Kernel, str]:
        """Return the kernel of a step, and its kind: "by value", "as is", "packed" or "prepared".

        The keys of the memos that it uses are added to ``memos``; ``keeps`` is called with the bytes of the rest.
        """
        layer = layers[step.node]
        promised = layers[step.chain.last if step.chain else step.node]
        if unknown:
            layer = layer if changes_itself(layer) else copy.copy(layer)
            return lambda *bottoms: layer.run(*(bottom.contiguous() for bottom in bottoms)), "by value"
        members = (step.node, *(step.chain.folded if step.chain else ()))
        blobs = [blob for i in members for blob in layers[i].blobs]
        uses: list[str] = []

        def memo(name: str, make: Callable[[], Any]) -> Any:
            uses.append(name)
            key = (name, step.node if step.chain else -1, *map(id, blobs))  # layers that share blobs share this too
            memos.add(key)
            kept = self.memos.get(key)
            if kept is None or not kept[0].are(blobs):
                kept = self.memos[key] = Seen(blobs, values=True), make()
            return kept[1]

        if step.chain:
            chain = step.chain
            layer = absorbing(layer, memo("fold", lambda: absorbed_by(chain, layers, layers[chain.keeper].blobs[0])))
        finish = None if step.finish is None else folds_of(layers[step.finish]).finish
        how = Inference(
            finish=finish, reuse=step.reuse, lasts=step.lasts, memo=memo, pack=PACK in self.passes, keeps=keeps
        )
        own = None if as_is else inference_kernel(layer, how)
        kernel = own or finished(layer.forward, finish)
        if not entry_of(layer).any_layout or self._exact == ALL:
            inner = kernel
            kernel = lambda *bottoms: inner(*(bottom.contiguous() for bottom in bottoms))  # noqa: E731
        if own is None:
            kernel = _checked(kernel, promised)
        return kernel, "as is" if as_is else "packed" if len(uses) > bool(step.chain) else "prepared"

    def _changing(self) -> set[int]:
        """Return the learned blobs that may change between runs: those that did, and those with a live alias."""
        found = set()
        for blob in self._blobs():
            before = self._seen.get(id(blob))
            if (before and not before.are([blob])) or may_have_alias(blob):
                found.add(id(blob))
            self._seen[id(blob)] = Seen([blob], values=True)
        return found


def _checked(kernel: Kernel, layer: Layer) -> Kernel:
    """Return a kernel that checks, in its first pass, the shapes that the layer promised."""

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
