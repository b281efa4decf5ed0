"""Runs the layers of a net one by one, with gradients by autograd. Some layers run together with the next ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.run.overwritten import Memory, overwritten
from netspec.run.parts import Part, parts_of
from netspec.run.walk import Losses, Result, Step, Values, Visit, walk


class Eager:
    """Runs the layers of a plan. Every net can be run this way.

    ``losses`` are the tops with a loss weight, by layer. ``exact`` is as in netspec/exact.
    """

    def __init__(self, plan: Plan, layers: Sequence[Layer], losses: Losses, exact: str) -> None:
        self.plan, self.layers, self.losses, self.exact = plan, list(layers), losses, exact
        self.overwritten = [overwritten(layer, node, plan) for layer, node in zip(layers, plan.nodes, strict=True)]
        self._lines: dict[frozenset[int], list[Step]] = {}  # of the last run

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result:
        """Run all layers on the values ``given``. Return the loss and the values; those in ``kept`` are among them."""
        values: Values = dict(given)
        if kept not in self._lines:
            self._lines = {kept: [step for part in self.parts(kept) for step in self._step(part, kept)]}
        return walk(self._lines[kept], values, self.exact, self._remembering()), values

    def one_by_one(self) -> list[Step]:
        """Return one step for each layer, except the inputs. No step drops a value."""
        return [step._replace(ends=()) for i in range(len(self.layers)) for step in self._alone(i)]

    def _step(self, part: Part, kept: frozenset[int]) -> list[Step]:
        """Return the step that runs a part and keeps the values ``kept``."""
        nodes = self.plan.nodes
        if len(part.members) == 1:
            return self._alone(part.first, kept)
        ends = self._ending_values(part.first, part.last, kept)
        return [Step(part.last, part.run, nodes[part.first].bottoms, nodes[part.last].tops, ends=ends)]

    def parts(self, kept: frozenset[int] = frozenset()) -> list[Part]:
        """Return the layers in order, joined where the values ``kept`` allow it."""
        return parts_of(self.plan, self.layers, self._must_run_alone(), kept)

    def _alone(self, i: int, kept: frozenset[int] = frozenset()) -> list[Step]:
        """Return the step that runs layer ``i`` alone. An input needs none, because its values are given."""
        node, layer = self.plan.nodes[i], self.layers[i]
        losses, ends = self.losses[i], self._ending_values(i, i, kept)
        if not layer.is_input:
            return [Step(i, self._as_asked(i), node.bottoms, node.tops, losses, ends)]
        return [Step(i, lambda *tops: tops, node.tops, node.tops, losses, ends)] if losses or ends else []

    def _as_asked(self, i: int) -> Callable[..., tuple[torch.Tensor, ...]]:
        """Return a function that runs layer ``i``: no gradients for blocked bottoms, and float32 for every loss."""
        layer, blocked = self.layers[i], self.plan.nodes[i].blocked
        if not layer.is_loss and not any(blocked):
            return layer.run

        def run(*bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
            given = [bottom.detach() if stop else bottom for bottom, stop in zip(bottoms, blocked, strict=True)]
            if layer.is_loss:
                given = [x.float() if x.dtype in (torch.bfloat16, torch.float16) else x for x in given]
            return layer.run(*given)

        return run

    def _ending_values(self, first: int, last: int, kept: frozenset[int]) -> tuple[int, ...]:
        return tuple(v for i in range(first, last + 1) for v in self.plan.ends[i] if v not in kept)

    def _must_run_alone(self) -> list[bool]:
        """Return which layers can never be joined with others."""
        final, nodes = self.plan.final, self.plan.nodes
        read_again = {final[node.tops[0]] for node, is_read in zip(nodes, self.overwritten, strict=True) if is_read}
        return [
            any(node.blocked) or bool(losses) or any(final[v] in read_again for v in node.tops)
            for node, losses in zip(nodes, self.losses, strict=True)
        ]

    def _remembering(self) -> Visit | None:
        """Return a visit that keeps, for one run, what later layers write into memory that a gradient reads."""
        if not any(self.overwritten) or not torch.is_grad_enabled():
            return None
        plan, memories = self.plan, dict[int, Memory]()

        def visit(step: Step, bottoms: list[torch.Tensor]) -> Any:
            if reader := self.overwritten[step.node]:
                blocked = plan.nodes[step.node].blocked
                given = [x.detach() if stop else x for x, stop in zip(bottoms, blocked, strict=True)]
                tops = reader.run(given, memories.setdefault(reader.final, Memory()))
            else:
                tops = step.run(*bottoms)
            for v, top in zip(step.tops, tops, strict=False):
                if v in memories:
                    memories[v].data = top.detach()
            return tops

        return visit
