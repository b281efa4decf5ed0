"""Base of layers with blobs that are never learned, such as moving averages."""

from __future__ import annotations

from dataclasses import replace

from typing_extensions import override

from netspec.graph.plan import Param
from netspec.layers import Layer


class NotLearned(Layer):
    """Base of layers that set lr_mult and decay_mult of some blobs to 0."""

    not_learned: frozenset[int] = frozenset()  # indices of these blobs; the prototxt cannot change it

    @override
    def param_spec(self, j: int, given: Param | None) -> Param:
        spec = super().param_spec(j, given)
        return replace(spec, lr_mult=0.0, decay_mult=0.0) if j in self.not_learned else spec
