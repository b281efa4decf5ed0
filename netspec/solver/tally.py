"""The result of a test: the mean of every output element over its batches, and how Caffe prints it.

Caffe: Solver::Test (src/caffe/solver.cpp), test() (tools/caffe.cpp)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch

from netspec.log import number

Outputs = dict[str, list[float]]


class Tally:
    """Sums up the losses and outputs of batches; ``loss`` and ``scores`` are their means so far."""

    def __init__(self) -> None:
        self.batches = 0
        self._loss = 0.0
        self._sums: Outputs = {}

    def add(self, loss: torch.Tensor, outputs: Mapping[str, torch.Tensor]) -> Outputs:
        """Add what ``Net.forward_loss`` returned for a batch; return the batch's own scores."""
        self.batches += 1
        self._loss += loss.item()
        batch = as_scores(outputs)
        for name, values in batch.items():
            sums = self._sums.setdefault(name, [0.0] * len(values))
            self._sums[name] = [a + b for a, b in zip(sums, values, strict=True)]
        return batch

    @property
    def loss(self) -> float:
        """The mean loss."""
        return self._loss / self.batches

    @property
    def scores(self) -> Outputs:
        """The mean of each element of each output blob."""
        return {name: [value / self.batches for value in values] for name, values in self._sums.items()}


def as_scores(outputs: Mapping[str, torch.Tensor]) -> Outputs:
    """Return the elements of each output blob, in order."""
    return {name: blob.detach().reshape(-1).tolist() for name, blob in outputs.items()}


def score_lines(scores: Outputs, weights: Mapping[str, float]) -> Iterator[str]:
    """Yield ``name = value`` of each element, with its contribution to the loss if its output has a loss weight."""
    for name, values in scores.items():
        weight = weights[name]
        for value in values:
            ending = f" (* {number(weight)} = {number(weight * value)} loss)" if weight else ""
            yield f"{name} = {number(value)}{ending}"
