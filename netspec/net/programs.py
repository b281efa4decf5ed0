"""Runs of a net without gradients: each layer prepared once for the shapes at hand, then called without ceremony.

A program is the line of kernels for one set of input shapes and of blobs to keep. Programs keep weights in other forms,
folded or laid out for a kernel; before each run they look whether somebody has written to a learned blob since, or
holds memory through which that could happen unseen. Layers with such blobs run from the blobs as they are, until they
have stayed the same for a run.
"""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from netspec.exact import ALL
from netspec.exact.blas import one_thread
from netspec.graph.steps import PACK, Schedule, Step, schedule
from netspec.layers.base import Kernel, Layer, Preparation, Shape
from netspec.layers.learned import Stamp, is_lent, stamp
from netspec.net.fold import absorbed_by, roles_of

if TYPE_CHECKING:
    from netspec.net.net import Net

PROGRAMS = 64  # kept for a net: pyramids of images need one for each size
Values = dict[int, torch.Tensor]
Given = tuple[int, Shape, torch.dtype]


@dataclass
class Program:
    """The kernels of a run in order, each with the values that it takes and makes, its losses, and what ends."""

    line: list[tuple[Kernel, int, tuple[int, ...], tuple[int, ...], list[tuple[int, float]], tuple[int, ...]]]
    schedule: Schedule
    kinds: list[str]
    one_thread: bool
    frozen: list[tuple[dict[str, Any], str, torch.Tensor, Stamp]]
    waiting: list[tuple[torch.Tensor, Stamp]]

    def is_current(self) -> bool:
        """Return whether no learned blob was written to or replaced, and none that was has come to rest."""
        for owner, name, blob, before in self.frozen:
            if owner[name] is not blob or stamp(blob) != before:
                return False
        if not self.waiting:
            return True
        resting = [stamp(blob) == before and not is_lent(blob) for blob, before in self.waiting]
        self.waiting = [(blob, stamp(blob)) for blob, _ in self.waiting]
        return not any(resting)


class Programs:
    """The programs of a net, by shapes and kept blobs."""

    def __init__(self, net: Net, passes: Collection[str]) -> None:
        self.net = net
        self.passes = frozenset(passes)
        self._sources = [i for i, node in enumerate(net.plan.nodes) if not node.bottoms and not net.layers[i].is_input]
        self.made: OrderedDict[Any, Program] = OrderedDict()
        self._memos: dict[Any, tuple[tuple[Stamp, ...], Any]] = {}
        self._seen: dict[int, Stamp] = {}

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> tuple[torch.Tensor | None, Values]:
        """Run the net on the values ``given`` by the caller; return the weighted sum of its losses and what is kept.

        Layers without bottoms run first: data layers, whose records have the shapes that they have.
        """
        values: Values = dict(given)
        loss: torch.Tensor | None = None
        for i in self._sources:
            layer, node = self.net.layers[i], self.net.plan.nodes[i]
            tops = layer.run()
            values.update(zip(node.tops, tops, strict=False))
            for top, weight in zip(tops, self.net.loss_weights[i], strict=True):
                loss = self._added(loss, top, weight) if weight else loss
        program = self.program(tuple([(v, x.shape, x.dtype) for v, x in values.items()]), kept)
        with one_thread() if program.one_thread else nullcontext():
            loss = self._run(program, values, loss)
        origin = program.schedule.origin
        return loss, {v: values[origin[v]].contiguous() for v in kept}

    def _run(self, program: Program, values: Values, loss: torch.Tensor | None) -> torch.Tensor | None:
        for kernel, bottom, bottoms, tops, losses, ends in program.line:
            made = kernel(values[bottom]) if bottom >= 0 else kernel(*[values[v] for v in bottoms])
            if not isinstance(made, tuple):
                values[tops[0]] = made
                made = (made,) if losses else ()
            else:
                values.update(zip(tops, made, strict=False))
            for j, weight in losses:
                loss = self._added(loss, made[j], weight)
            for v in ends:
                del values[v]
        return loss

    def _added(self, loss: torch.Tensor | None, top: torch.Tensor, weight: float) -> torch.Tensor:
        term = self.net.weighted_sum(top, weight)
        return term if loss is None else loss + term

    def program(self, given: tuple[Given, ...], kept: frozenset[int]) -> Program:
        """Return the program for values of these shapes and types, made now or before."""
        key = (given, kept)
        program = self.made.get(key)
        if program is None or not program.is_current():
            with torch.inference_mode(False), torch.no_grad():
                program = self.made[key] = self._make(given, kept)
        self.made.move_to_end(key)
        if len(self.made) > PROGRAMS:
            self.made.popitem(last=False)
        return program

    def _make(self, given: tuple[Given, ...], kept: frozenset[int]) -> Program:
        net, plan = self.net, self.net.plan
        fitted = self._fitted(given)
        layers = [found or layer for found, layer in zip(fitted, net.layers, strict=True)]
        changing = self._changing()
        probe = torch.empty(1, dtype=next((dtype for *_, dtype in given), torch.float32), device=net.device)
        exact = [found is not None and found.is_exact(probe, found.small) for found in fitted]
        as_is = [found is None or bool(changing & _ids(found)) for found in fitted]
        roles = roles_of(plan, layers)
        foldable = [not (e or a) for e, a in zip(exact, as_is, strict=True)]
        order = schedule(
            plan,
            replace(
                roles,
                absorbs=_both(roles.absorbs, foldable),
                affine=_both(roles.affine, foldable),
                absorbs_before=_both(roles.absorbs_before, foldable),
            ),
            finishes=[found is not None and found.finishing() is not None for found in fitted],
            fresh=[found is not None and found.fresh for found in fitted],
            given=[v for v, *_ in given],
            kept=kept | {v for i, node in enumerate(plan.nodes) if any(net.loss_weights[i]) for v in node.tops},
            passes=self.passes,
        )
        line, kinds = [], []
        for step in order.steps:
            kernel, kind = self._kernel(step, layers, fitted[step.node] is None, as_is[step.node])
            kinds.append("exact" if exact[step.node] else kind)
            losses = [(j, weight) for j, weight in enumerate(net.loss_weights[step.node]) if weight]
            single = step.bottoms[0] if len(step.bottoms) == 1 else -1
            line.append((kernel, single, step.bottoms, step.tops, losses, step.ends))
        blobs = [
            (owner, *each) for owner in (layer.blobs._parameters for layer in net.layers) for each in owner.items()
        ]
        return Program(
            line,
            order,
            kinds,
            any(exact),
            [(owner, name, blob, stamp(blob)) for owner, name, blob in blobs if id(blob) not in changing],
            [(blob, stamp(blob)) for _, _, blob in blobs if id(blob) in changing],
        )

    def _kernel(self, step: Step, layers: Sequence[Layer], unknown: bool, as_is: bool) -> tuple[Kernel, str]:
        """Return what runs a step, and in which way: "by value", "as is", "packed" or "prepared"."""
        layer = layers[step.node]
        if unknown:
            layer = layer if layer.remembers else copy.copy(layer)
            return lambda *bottoms: layer.run(*(bottom.contiguous() for bottom in bottoms)), "by value"
        members = (step.node, *(step.chain.folded if step.chain else ()))
        blobs = [blob for i in members for blob in layers[i].blobs]
        uses: list[str] = []

        def memo(name: str, make: Callable[[], Any]) -> Any:
            uses.append(name)
            stamps = tuple(stamp(blob) for blob in blobs)
            key = (name, step.node if step.chain else -1, *map(id, blobs))  # layers that share blobs share this too
            if self._memos.get(key, (None,))[0] != stamps:
                self._memos[key] = stamps, make()
            return self._memos[key][1]

        if step.chain:
            chain = step.chain
            layer = layer.absorbing(memo("fold", lambda: absorbed_by(chain, layers, layers[chain.keeper].blobs[0])))
        finish = layers[step.finish].finishing() if step.finish is not None else None
        how = Preparation(finish, step.reuse, memo, PACK in self.passes)
        kernel = Layer.prepare(layer, how) if as_is else layer.prepare(how)
        if not layer.any_layout or self.net.exact == ALL:
            inner = kernel
            kernel = lambda *bottoms: inner(*(bottom.contiguous() for bottom in bottoms))  # noqa: E731
        return kernel, "as is" if as_is else "packed" if len(uses) > bool(step.chain) else "prepared"

    def _fitted(self, given: tuple[Given, ...]) -> list[Layer | None]:
        """Return copies of the layers, fitted to these shapes; None where the shapes follow only from values.

        Layers that remember something are no copies, and what follows on them is not prepared either.
        """
        shapes: dict[int, Shape] = {v: tuple(shape) for v, shape, _ in given}
        found: list[Layer | None] = []
        for node, layer in zip(self.net.plan.nodes, self.net.layers, strict=True):
            known = bool(node.bottoms) and all(v in shapes for v in node.bottoms)
            if known and not layer.remembers:
                layer = copy.copy(layer)
                layer.fit([shapes[v] for v in node.bottoms])
                if layer.counted_axis is None:
                    shapes.update(zip(node.tops, layer.top_shapes, strict=False))
                found.append(layer)
            else:
                found.append(None)
        return found

    def _changing(self) -> set[int]:
        """Return which learned blobs somebody may be writing to: those that changed, and those that are lent."""
        found = set()
        for layer in self.net.layers:
            for blob in layer.blobs:
                now = stamp(blob)
                if self._seen.get(id(blob), now) != now or is_lent(blob):
                    found.add(id(blob))
                self._seen[id(blob)] = now
        return found


def _ids(layer: Layer) -> set[int]:
    return {id(blob) for blob in layer.blobs}


def _both(these: Sequence[bool], those: Sequence[bool]) -> list[bool]:
    return [a and b for a, b in zip(these, those, strict=True)]
