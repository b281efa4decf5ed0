"""Layers in a row that torch.compile makes one function of tensors.

What torch cannot trace runs between them as always: layers that read data, draw random numbers, run a user's Python,
branch on what they read (losses and Accuracy refuse labels that are no class), or add to gradients in place
(InnerProduct). A layer says by ``traceable`` that it can be traced.
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import logging
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from types import FunctionType, MethodType
from typing import Any

import torch

from netspec import log
from netspec.errors import SpecError
from netspec.exact import NONE
from netspec.files.limits import is_out_of_memory
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered
from netspec.run.walk import Step, walk

FEWEST = 2  # layers: a single one gains nothing
_numbers = count()


def missing_tool(device: torch.device) -> str:
    """Return what torch.compile lacks on this machine to compile for a device, in words; "" if nothing."""
    if device.type == "cuda":
        import importlib.util

        return "" if importlib.util.find_spec("triton") else "triton is not installed"
    usual = {"darwin": "clang++", "win32": "cl"}.get(sys.platform, "g++")
    compiler = os.environ.get("CXX") or usual
    if shutil.which(compiler):
        return ""
    return f'found no C++ compiler "{compiler}"; install one, or name another in the environment variable CXX'


def rows(layers: Sequence[Layer], apart: Sequence[bool]) -> Iterator[list[int]]:
    """Yield the numbers of layers in a row that make a segment; layers that are ``apart`` belong to none."""
    row: list[int] = []
    for i in range(len(layers) + 1):
        if i < len(layers) and not apart[i] and offered(layers[i], "traceable"):
            row.append(i)
            continue
        if len(row) >= FEWEST:
            yield row
        row = []


class Segment:
    """Layers in a row, compiled at their first pass: ``run`` takes the values ``bottoms`` and returns ``tops``.

    ``last`` is the number of the last one; the values ``within`` are seen by nobody. What is compiled serves the passes
    that are repeated: with the shapes that the net was built with, and with gradients where the net ``learns``, else
    without. In others, and where hooks look at what lies within, its layers run by the steps of ``line``.
    """

    def __init__(
        self,
        plan: Plan,
        layers: Sequence[Layer],
        row: Sequence[int],
        learns: bool,
        line: Callable[[Sequence[int], frozenset[int], bool], list[Step]],
    ) -> None:
        self.last = row[-1]
        nodes = [plan.nodes[i] for i in row]
        self._layers = [layers[i] for i in row]
        self._steps = [(layer, node.bottoms, node.tops) for layer, node in zip(self._layers, nodes, strict=True)]
        # Protobuf makes a message's fields anew at each access unless they are held; torch would compile anew, too.
        self._held = [getattr(layer.param, name.partition(".")[0]) for layer in self._layers for name in layer.reads]
        self._shapes = [list(layer.bottom_shapes) for layer in self._layers]
        made = {v for node in nodes for v in node.tops}
        read = {v for node in plan.nodes[self.last + 1 :] for v in node.bottoms} | {*plan.outputs.values()}
        given = {
            v: shape
            for node, shapes in zip(nodes, self._shapes, strict=True)
            for v, shape in zip(node.bottoms, shapes, strict=True)
            if v not in made
        }
        self.bottoms, self._given_shapes = tuple(given), list(given.values())
        self.tops = tuple(sorted(made & read))
        self.within = made - read
        self._learns = learns
        self._line = line(row, frozenset((*self.tops, *self.bottoms)), True)
        self.compiled: Any = None  # the function, once there is one

    def run(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the tops. Raises SpecError where the layers cannot be compiled."""
        if not self._serves(bottoms):
            values = dict(zip(self.bottoms, bottoms, strict=True))
            walk(self._line, values, NONE)
            return tuple(values[v] for v in self.tops)
        for layer, shapes in zip(self._layers, self._shapes, strict=True):
            layer.fit(shapes)
        return self.compiled(*bottoms) if self.compiled else self._compile(bottoms)

    def _serves(self, bottoms: Sequence[torch.Tensor]) -> bool:
        return (
            torch.is_grad_enabled() == self._learns
            and [tuple(bottom.shape) for bottom in bottoms] == self._given_shapes
            and not any(layer._forward_hooks for layer in self._layers)
        )

    def _compile(self, bottoms: Sequence[torch.Tensor]) -> Any:
        """Make the function; return what its first call returns."""
        first, last = self._layers[0], self._layers[-1]
        log.logger.info(f'compiling the layers from "{first.param.name}" to "{last.param.name}"')
        # Torch counts the compilations of each code object; so each segment has its own.
        code = _run.__code__.replace(co_name=f"segment_{next(_numbers)}")
        own: Any = MethodType(FunctionType(code, globals()), self)
        try:
            with warnings.catch_warnings(), _quiet():
                warnings.simplefilter("ignore")
                compiled: Any = torch.compile(own, fullgraph=True, dynamic=False)
                tops = compiled(*bottoms)
        except Exception as fault:  # torch's compilers have no common base of their errors
            if is_out_of_memory(fault):
                raise
            reason = next(iter(str(fault).strip().splitlines()), "") or type(fault).__name__
            message = f'cannot be compiled, up to layer "{last.param.name}": {reason}; train without --compile'
            raise SpecError(message, first.context.at()) from fault
        self.compiled = compiled
        return tops


@contextmanager
def _quiet() -> Iterator[None]:
    """Let torch's compilers log errors only within the block."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.partition(".")[0] == "torch"]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _run(segment: Segment, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Run the layers of a segment one by one, to be traced; return what later layers read."""
    values = dict(zip(segment.bottoms, bottoms, strict=True))
    for layer, numbers, made in segment._steps:
        tops = layer.forward(*[values[v] for v in numbers])
        values.update(zip(made, tops if isinstance(tops, tuple) else (tops,), strict=True))
    return tuple([values[v] for v in segment.tops])
