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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from types import FunctionType, MethodType
from typing import TYPE_CHECKING, Any

import torch

from netspec.errors import SpecError
from netspec.files.limits import is_out_of_memory
from netspec.layers.base import Layer
from netspec.proto.schema import TRAIN
from netspec.terminal import log

if TYPE_CHECKING:
    from netspec.net.net import Net

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


def find_segments(net: Net, apart: Sequence[bool]) -> dict[int, Segment]:
    """Return the segments of a net by the number of their first layer; layers that are ``apart`` belong to none."""
    found: dict[int, Segment] = {}
    row: list[int] = []
    for i in range(len(net.layers) + 1):
        if i < len(net.layers) and net.layers[i].traceable and not apart[i]:
            row.append(i)
            continue
        if len(row) >= FEWEST:
            found[row[0]] = Segment(net, row)
        row = []
    return found


class Segment:
    """Layers in a row, compiled at their first pass. ``last`` is the number of the last one.

    It serves the passes that are repeated: with the shapes that the net was built with, and with gradients in phase
    TRAIN, without in phase TEST. Others, and passes that look at what lies within, run layer by layer.
    """

    def __init__(self, net: Net, row: Sequence[int]) -> None:
        self.last = row[-1]
        nodes = [net.plan.nodes[i] for i in row]
        self._layers: list[Layer] = [net.layers[i] for i in row]
        self._steps = [(layer, node.bottoms, node.tops) for layer, node in zip(self._layers, nodes, strict=True)]
        # Protobuf makes a message's fields anew at each access unless they are held; torch would compile anew, too.
        self._held = [getattr(layer.param, name.partition(".")[0]) for layer in self._layers for name in layer.reads]
        self._shapes = [list(layer.bottom_shapes) for layer in self._layers]
        made = {v for node in nodes for v in node.tops}
        read = {v for node in net.plan.nodes[self.last + 1 :] for v in node.bottoms} | {*net.plan.outputs.values()}
        self._given = {
            v: shape
            for node, shapes in zip(nodes, self._shapes, strict=True)
            for v, shape in zip(node.bottoms, shapes, strict=True)
            if v not in made
        }
        self._tops = sorted(made & read)
        self._within = made - read
        self._learns = net.phase == TRAIN
        self.compiled: Any = None  # the function, once there is one

    def serves(self, values: Mapping[int, torch.Tensor], kept: frozenset[int]) -> bool:
        """Return whether a pass on these values, which is to keep some, can be compiled."""
        return (
            torch.is_grad_enabled() == self._learns
            and not kept & self._within
            and all(tuple(values[v].shape) == shape for v, shape in self._given.items())
            and not any(layer._forward_hooks for layer in self._layers)
        )

    def run(self, values: dict[int, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Add to ``values`` what later layers read; return the tops of the last layer.

        Raises SpecError where the layers cannot be compiled.
        """
        for layer, shapes in zip(self._layers, self._shapes, strict=True):
            layer.fit(shapes)
        bottoms = [values[v] for v in self._given]
        tops = self.compiled(*bottoms) if self.compiled else self._compile(bottoms)
        values.update(zip(self._tops, tops, strict=True))
        return tuple(values[v] for v in self._steps[-1][2])

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
    values = dict(zip(segment._given, bottoms, strict=True))
    for layer, numbers, made in segment._steps:
        tops = layer.forward(*[values[v] for v in numbers])
        values.update(zip(made, tops if isinstance(tops, tuple) else (tops,), strict=True))
    return tuple([values[v] for v in segment._tops])
