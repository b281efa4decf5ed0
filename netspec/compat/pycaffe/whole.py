"""Runs a solver's pass with netspec's kernels, and leaves the blobs with the content of a pass layer by layer.

The kernels keep their results until their next pass. The blobs get that memory, so only views that a script holds
need a copy (netspec/layers/utility/live_blobs.py).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch

from netspec.compat.pycaffe.blob_runner import BlobRunner
from netspec.graph.plan import AUTOMATIC
from netspec.layers.utility.live_blobs import Blob

LARGE = 2**22  # numbers in all blobs: in a larger net, two sets of kernels take too much memory
Passed = tuple[torch.Tensor, dict[str, torch.Tensor]]


class WholeRun:
    """Forward and backward through all layers of a net at once."""

    def __init__(self, runner: BlobRunner) -> None:
        self._runner, self._net = runner, runner.net
        self._is_large = sum(blob.count for blob in runner.blobs) > LARGE
        # the last of several that are written to the same memory
        self._tops = list({id(blob.data_memory): (v, blob) for v, blob in self._written()}.values())
        self._diffs = list({id(blob.diff_memory): (v, blob) for v, blob in self._reached()}.values())

    @staticmethod
    def suits(runner: BlobRunner) -> bool:
        """Return whether a whole pass leaves the same content in the blobs as one layer by layer. Call it after a pass.

        It does not if layers are joined. Nor if a layer draws random numbers, which a separate backward pass needs.
        """
        net = runner.net
        return not (
            net.random.has_drawn
            or AUTOMATIC in runner.names
            or runner.overwrites_shared()
            or any(len(part.members) > 1 for part in net.eager.parts())
            or any("kept" in step.reads for step in runner.steps)
            or net.backward_plan.written != net.backward_plan.computed
        )

    def run(self) -> Passed | None:
        """Run the net and fill the blobs. Return None if the layers must run one by one."""
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
        """Yield pairs of a value and its blob, in the order of a forward pass."""
        for step in self._runner.steps:
            if "data" not in step.layer.shares:
                yield from zip(step.node.tops, step.tops, strict=True)

    def _reached(self) -> Iterator[tuple[int, Blob]]:
        """Yield pairs of a value and the blob of its gradient, in the order of a backward pass."""
        for step in reversed(self._runner.steps):
            if step.reached and "diff" not in step.layer.shares:
                bottoms = zip(step.node.bottoms, step.bottoms, step.wanted, strict=True)
                yield from ((v, blob) for v, blob, wanted in bottoms if wanted)
