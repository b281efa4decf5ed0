"""The result of a test: the mean of every output element over its batches, and how Caffe prints it.

Caffe: Solver::Test (src/caffe/solver.cpp), test() (tools/caffe.cpp)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from netspec.layers.contract.reading import Scores
from netspec.log import number
from netspec.net.net import Net

Outputs = dict[str, list[float]]
Scorer = Callable[[Sequence[torch.Tensor]], list[float]]


def scorers(net: Net, solver: Any = None) -> dict[str, Scorer]:
    """Return, by output, how its score follows from all batches, where its layer scores by itself."""
    makers = {v: layer for node, layer in zip(net.plan.nodes, net.layers, strict=True) for v in node.tops}
    found = [(name, makers.get(v)) for name, v in net.plan.outputs.items()]
    return {name: partial(layer.score, solver=solver) for name, layer in found if isinstance(layer, Scores)}


class Tally:
    """Sums up the losses and outputs of batches; ``loss`` and ``scores`` are their means so far.

    Outputs in ``scorers`` are kept instead, and scored together.
    """

    def __init__(self, scorers: Mapping[str, Scorer] | None = None) -> None:
        self.batches = 0
        self._loss = 0.0
        self._sums: Outputs = {}
        self._scorers = dict(scorers or {})
        self._gathered: dict[str, list[torch.Tensor]] = {name: [] for name in self._scorers}

    def add(self, loss: torch.Tensor, outputs: Mapping[str, torch.Tensor]) -> Outputs:
        """Add what ``Net.forward_loss`` returned for a batch; return the batch's own scores."""
        self.batches += 1
        self._loss += loss.item()
        for name, gathered in self._gathered.items():
            gathered.append(outputs[name].detach())
        batch = as_scores({name: blob for name, blob in outputs.items() if name not in self._scorers})
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
        """The mean of each element of each output blob, then the scores of those that are gathered."""
        means = {name: [value / self.batches for value in values] for name, values in self._sums.items()}
        return means | {name: score(self._gathered[name]) for name, score in self._scorers.items()}


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
