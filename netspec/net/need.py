"""How much memory a net needs at least, and whether that is too much."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from netspec.errors import SpecError
from netspec.files.limits import amount, memory
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.reading import bytes_ahead
from netspec.proto.schema import TEST

BYTES = 4  # of a number: float32


class Need:
    """The memory that a net needs at least, in bytes, as far as the shapes of its layers are known.

    ``parameters`` counts shared ones once. ``tops`` is what tops need at one time: in phase TEST each is given up after
    its last use, in phase TRAIN the backward pass needs them all. Tops that are in place, or that lie in their bottom's
    memory, need nothing. ``ahead`` is what data layers read ahead. Gradients, the solver's history and what kernels
    need for their work come on top.
    """

    def __init__(self, plan: Plan, last_uses: Sequence[Sequence[int]]) -> None:
        self.parameters = self.tops = self.ahead = 0
        self._plan = plan
        self._ends = last_uses if plan.net.state.phase == TEST else [()] * len(plan.nodes)
        self._home: dict[int, int] = {}  # the value whose memory a value lies in
        self._sizes: dict[int, int] = {}
        self._users: dict[int, int] = {}
        self._alive = 0
        self._largest = (0, 0)  # bytes of the layer that needs most, and its index, negative: the first of equals

    @property
    def total(self) -> int:
        """Bytes of all of it together."""
        return self.parameters + self.tops + self.ahead

    def add(self, i: int, layer: Layer, parameters: int) -> None:
        """Count layer ``i``, which comes after all that were counted, with its bytes of parameters."""
        node, made = self._plan.nodes[i], 0
        for j, (v, shape) in enumerate(zip(node.tops, layer.top_shapes, strict=False)):
            bottom = node.bottoms[j if node.in_place[j] else 0] if node.bottoms else -1
            shared = node.in_place[j] or "data" in layer.shares
            home = self._home.get(bottom, v) if shared else v
            if home == v:
                self._sizes[v] = BYTES * math.prod(shape)
                made += self._sizes[v]
            self._home[v] = home
            self._users[home] = self._users.get(home, 0) + 1
        self._alive += made
        self.tops = max(self.tops, self._alive)
        self.parameters += parameters
        ahead = bytes_ahead(layer)
        self.ahead += ahead
        self._largest = max(self._largest, (made + parameters + ahead, -i))
        for v in self._ends[i]:
            home = self._home.pop(v, None)
            if home is not None:
                self._users[home] -= 1
                self._alive -= 0 if self._users[home] else self._sizes.pop(home)

    def fault(self, limit: int) -> SpecError | None:
        """Return an error that names the layer that needs most, if the net needs more than ``limit``, in bytes."""
        if self.total <= limit:
            return None
        size, i = self._largest[0], -self._largest[1]
        node = self._plan.nodes[i]
        most_of_all = f"needs {amount(size)} of memory, the most of all layers"
        return SpecError(
            f"{most_of_all}; the net needs at least {self}; {limit_text(limit)}",
            self._plan.source.at(i, layer=node.name, type=node.type),
        )

    def __str__(self) -> str:
        """Return the sums for people."""
        ahead = f", batches read ahead {amount(self.ahead)}" if self.ahead else ""
        return f"{amount(self.total)}: parameters {amount(self.parameters)}, tops {amount(self.tops)}{ahead}"


def limit_on(device: torch.device, limit: int | None = None) -> int:
    """Return the bytes that a net may need on a device: the limit that was chosen, or the device's memory."""
    if limit is not None:
        return limit
    return torch.cuda.mem_get_info(device)[1] if device.type == "cuda" else memory()


def limit_text(limit: int) -> str:
    """Return what the limit is, and how to set another."""
    return f"the limit is {amount(limit)}, --limit SIZE sets another"
