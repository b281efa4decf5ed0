"""A solver's pass as netspec makes it, after which the blobs show what passes from layer to layer leave in them.

netspec's kernels keep what they compute until their next pass. So the blobs are given that memory, and nothing is
copied but for views that a script holds (netspec/layers/utility/live_blobs.py).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from netspec.compat.pycaffe.blob_runner import BlobRunner
from netspec.compat.pycaffe.tapes import overwrites_shared
from netspec.graph.plan import AUTOMATIC
from netspec.layers.contract.gradients import gradient_reads
from netspec.layers.utility.live_blobs import Blob

LARGE = 2**22  # numbers in all blobs: of more, two sets of kernels take too much memory
Passed = tuple[torch.Tensor, dict[str, torch.Tensor]]


class WholeRun:
    """Forward and backward through all layers of a net at once."""

    def __init__(self, runner: BlobRunner) -> None:
        self._runner, self._net = runner, runner.net
        self._is_large = sum(blob.count for blob in runner.blobs) > LARGE
        # of several that are written to one memory, the last
        self._tops = list({id(blob.data_memory): (v, blob) for v, blob in self._written()}.values())
        self._diffs = list({id(blob.diff_memory): (v, blob) for v, blob in self._reached()}.values())

    @staticmethod
    def suits(runner: BlobRunner) -> bool:
        """Say whether blobs would show all that passes from layer to layer leave in them.

        Not so where layers run as one, and where a layer draws (call it after a pass): a backward pass by itself needs
        what was drawn.
        """
        net = runner.net
        return not (
            net.random.has_drawn
            or AUTOMATIC in runner.names
            or overwrites_shared(net.plan.nodes, runner.tops)
            or any(len(part.members) > 1 for part in net.eager.parts())
            or any("kept" in gradient_reads(layer) for layer in net.layers)
        )

    def run(self) -> Passed | None:
        """Run the net, and show what it computed; None where the layers must run one by one."""
        if any(self._runner.hooks.values()):
            return None
        step = self._net.trainer()
        if step is None:
            return None
        step.keeps = True
        passed = self._net.forward_backward()
        if passed is None or step.passed is None:
            return None
        (values, diffs), step.passed = step.passed, None
        for v, blob in self._tops:
            blob.put_data(values[v])
        for v, blob in self._diffs:
            diff = diffs[v]
            blob.diff_memory.put(torch.zeros(blob.shape) if diff is None else diff)
        self._runner.forget(kernels=self._is_large)
        return passed

    def _written(self) -> Iterator[tuple[int, Blob]]:
        """Yield values and the blobs that hold them, as they are written in a forward pass."""
        for node, layer, tops in zip(self._net.plan.nodes, self._net.layers, self._runner.tops, strict=True):
            if "data" not in layer.shares:
                yield from zip(node.tops, tops, strict=True)

    def _reached(self) -> Iterator[tuple[int, Blob]]:
        """Yield values and the blobs of their gradients, as they are written in a backward pass."""
        plan, runner = self._net.backward_plan, self._runner
        every = zip(self._net.plan.nodes, self._net.layers, runner.bottoms, plan.layers, plan.computed, strict=True)
        for node, layer, bottoms, reached, wanted in reversed(list(every)):
            if reached and "diff" not in layer.shares:
                yield from ((v, b) for v, b, w in zip(node.bottoms, bottoms, wanted, strict=True) if w)
