"""The Python layer, which runs users' code for pycaffe.

Caffe: include/caffe/layers/python_layer.hpp
"""

from __future__ import annotations

import importlib
import json
import os
import sysconfig
import traceback
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from typing_extensions import override

from netspec import log
from netspec.errors import SpecError, did_you_mean
from netspec.layers.contract.base import ALL_AXES, Layer, Shape, State
from netspec.layers.contract.registry import register
from netspec.layers.utility.live_blobs import Blob
from netspec.layers.utility.pycaffe_shim import can_import, importable
from netspec.proto.schema import PHASE_NAMES, LayerParameter


class _Call(torch.autograd.Function):
    """One forward pass of a Python layer and its backward; the tensors are its bottoms, then its learnable blobs."""

    @staticmethod
    def forward(ctx: Any, layer: Python, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        ctx.layer = layer
        return layer.call_forward(tensors)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        return None, *ctx.layer.call_backward(grads, ctx.needs_input_grad[1:])


class _Phase(int):
    """Caffe's number of a phase. Its text is the name, as in rbgirshick/caffe-fast-rcnn and yjxiong/caffe."""

    def __str__(self) -> str:
        return PHASE_NAMES[self]


@register("Python", "python_param")
class Python(Layer):
    """Run the class python_param.layer of python_param.module, on numpy views of the blobs.

    The module is searched in the current directory, then in Python's path (PYTHONPATH). Its class has setup,
    reshape and forward(bottom, top) and backward(top, propagate_down, bottom), and has self.param_str, self.phase and
    self.blobs. As in Caffe, backward belongs to the last forward. On a GPU the arrays are copies in main memory.
    A class with state other than its blobs can define running_state(), which returns JSON values, and resume(state).
    They are called when a snapshot is taken and when a training is resumed.

    bottom[i]  any shape
    top[i]     the shape set by reshape or forward
    blobs[i]   added by setup with self.blobs.add_blob(...)
    Caffe: include/caffe/layers/python_layer.hpp
    """

    not_allowed = "a Python layer runs code named in the prototxt; pass --allow-python-layers if you trust it"
    bottoms = (0, None)
    tops = (0, None)
    counted_axis = ALL_AXES  # as in Caffe, the code may reshape its tops in forward

    def setup(self) -> None:
        given = self.context.options.given_shapes
        self.code: Any = None
        if not self.context.options.open_data and all(name in given for name in self.param.top):
            return
        if not self.context.options.allow_python:
            raise self.error(self.not_allowed, "type")
        names = list(self.param.bottom)
        self.bottom = [Blob(shape) for shape in self.bottom_shapes]
        self.top = [self.bottom[names.index(n)] if n in names else Blob() for n in self.param.top]  # one blob in place
        self.code = self._load()
        self._call("setup", self.bottom, self.top)
        for blob in self.code.blobs:
            self.add_blob(blob.shape)

    @override
    def allocate(self) -> None:
        """Fill the blobs with what the code's setup wrote to its own."""
        super().allocate()
        for mine, blob in zip(self.blobs, self.code.blobs if self.code else (), strict=False):
            if mine.device.type != "meta":
                mine.data.copy_(torch.from_numpy(blob.data))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if self.code is None:
            return [self.context.options.given_shapes[name] for name in self.param.top]
        for blob, shape in zip(self.bottom, bottom_shapes, strict=True):
            blob.reshape(*shape)
        self._call("reshape", self.bottom, self.top)
        return [blob.shape for blob in self.top]

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run the code's reshape and forward, as Caffe does at each pass."""
        tensors = (*bottoms, *(self.blob(i) for i in range(len(self.blobs))))
        return _Call.apply(self, *tensors) if self.top else self.call_forward(tensors)

    def call_forward(self, tensors: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Show the tensors (bottoms, learnable blobs) to the code, run it, return the tops."""
        like = tensors[0] if tensors else torch.empty(0, device=self.context.device)
        for blob, tensor in zip([*self.bottom, *self.code.blobs], tensors, strict=True):
            blob.put_data((tensor.clone() if blob in self.top else tensor).detach().cpu())
        for blob in self.top:
            blob.data_memory.cast(like.dtype)
        self._call("reshape", self.bottom, self.top)
        self._call("forward", self.bottom, self.top)
        return tuple(torch.tensor(blob.data, device=like.device) for blob in self.top)

    def call_backward(self, grads: Sequence[torch.Tensor], needed: Sequence[bool]) -> list[torch.Tensor | None]:
        """Run the code's backward; return the gradients of the bottoms and learnable blobs that are needed."""
        for blob in (*self.bottom, *self.code.blobs):
            blob.diff_memory.put(torch.zeros(blob.shape, dtype=grads[0].dtype))
        for blob, grad in zip(self.top, grads, strict=True):
            blob.diff_memory.put(grad.cpu().clone())
        self._call("backward", self.top, list(needed[: len(self.bottom)]), self.bottom)
        return [
            torch.tensor(blob.diff, device=grads[0].device) if need else None
            for blob, need in zip([*self.bottom, *self.code.blobs], needed, strict=True)
        ]

    def running_state(self) -> State:
        """Return the result of the code's running_state as JSON, or "" if it has none."""
        if not hasattr(self.code, "running_state"):
            return {"code": ""}
        state = self._call("running_state")
        try:
            return {"code": json.dumps(state)}
        except (TypeError, ValueError, RecursionError) as fault:
            raise self._fault("running_state", f"returned what JSON cannot hold ({fault})") from None

    def resume(self, state: Mapping[str, Any]) -> None:
        if not (hasattr(self.code, "running_state") and hasattr(self.code, "resume")):
            remedy = "give its class running_state() and resume(state)"
            message = f"only the blobs of the Python layer are restored; if its code has other state, {remedy}"
            log.logger.warning(str(self.error(message, "python_param")))
        elif state["code"]:
            try:
                found = json.loads(state["code"])
            except ValueError as fault:
                raise self._fault("resume", f"its saved state is not JSON ({fault})") from None
            self._call("resume", found)

    @staticmethod
    def is_there(param: LayerParameter) -> bool:
        """Return whether the module of a Python layer can be found."""
        return can_import(param.python_param.module)

    def _load(self) -> Any:
        """Return an instance of the layer's class."""
        p = self.param.python_param
        try:
            with importable():
                module = importlib.import_module(p.module)
        except Exception as fault:  # the module's code may raise anything
            message = f'cannot import module "{p.module}" (looked for in the current directory and PYTHONPATH): '
            raise self.error(message + _describe(fault), "python_param", "module") from fault
        cls = getattr(module, p.layer, None)
        if cls is None:
            message = f'module "{p.module}" ({getattr(module, "__file__", "built in")}) has no class "{p.layer}"'
            raise self.error(message + did_you_mean(p.layer, dir(module)), "python_param", "layer")
        try:
            code = cls(self.param)
        except Exception as fault:
            raise self.error(f"{p.module}.{p.layer}: {_describe(fault)}", "python_param", "layer") from fault
        if not hasattr(code, "blobs"):
            raise self.error(f"{p.module}.{p.layer} is not a caffe.Layer", "python_param", "layer")
        code.param_str = code.param_str_ = p.param_str  # the second is the name in 2014
        code.phase = _Phase(self.phase)
        return code

    def _call(self, method: str, *arguments: Any) -> Any:
        """Call a method of the code; anything it raises is an error in the user's file."""
        try:
            with importable():
                return getattr(self.code, method)(*arguments)
        except SpecError:
            raise
        except Exception as fault:
            raise self._fault(method, _describe(fault)) from fault

    def _fault(self, method: str, message: str) -> SpecError:
        p = self.param.python_param
        return self.error(f"{p.module}.{p.layer}.{method}: {message}", "python_param")


def _describe(fault: Exception) -> str:
    """Return the exception's class, text and position in one line."""
    if isinstance(fault, SyntaxError):
        remedy = "if it is Python 2, convert it with `fissix -w`, then check each / between whole numbers"
        return f"{type(fault).__name__}: {fault.msg} ({fault.filename}:{fault.lineno}); {remedy}"
    frames = traceback.extract_tb(fault.__traceback__)
    of_user = [frame for frame in frames if not frame.filename.startswith(_not_of_user())]
    position = "".join(f" ({frame.filename}:{frame.lineno})" for frame in (of_user or frames)[-1:])
    return f"{type(fault).__name__}: {' '.join(str(fault).split())}{position}"


@cache
def _not_of_user() -> tuple[str, ...]:
    """Return the path prefixes of Python's own files, of installed packages, and of netspec."""
    folders = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    ours = str(Path(__file__).parents[2])
    return ("<", *(os.path.join(folder, "") for folder in (*folders, ours)))
