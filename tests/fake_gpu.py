"""A fake GPU: its tensors are in the CPU's memory, but cannot be combined with tensors of the CPU.

Code that runs on it would run on a GPU: no tensor is left on the CPU, and none is read without a copy to the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.utils.backend_registration as registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "fake"
POSSIBLE = hasattr(registration, "_setup_privateuseone_for_python_backend")  # torch 2.9 and later
#: The kinds of GPU that this machine and this torch have: tests are collected for these.
GPUS = (["fake"] if POSSIBLE else []) + (["cuda"] if torch.cuda.is_available() else [])
# Operations that may combine tensors of GPU and CPU: copies, and indices, which may be on the CPU.
_CROSSING = {"aten::copy_", "aten::_to_copy", "aten::_foreach_copy_", "aten::index", "aten::index_put_"}

if POSSIBLE:
    # Before the first backward pass of the process: autograd then counts the devices.
    registration._setup_privateuseone_for_python_backend(NAME)


class FakeTensor(torch.Tensor):
    """A tensor ``held`` in the CPU's memory, with another device."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> FakeTensor:
        """Wrap a tensor."""
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        tensor = torch.Tensor._make_wrapper_subclass(cls, held.size(), device=torch.device(NAME, 0), **layout)
        tensor.held = held
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation on the held tensors."""
        return _run(func, args, kwargs or {})

    def tolist(self) -> Any:
        """Copy the values to the CPU, like a GPU's tensor."""
        return self.detach().cpu().tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        """Raise an error, like a GPU's tensor."""
        raise TypeError(f"can't convert {self.device} device type tensor to numpy. Use Tensor.cpu() first")

    __array__ = numpy


class _Creating(TorchDispatchMode):
    """Wraps tensors that are made on the fake GPU."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        fake = kwargs.get("device") is not None and torch.device(kwargs["device"]).type == NAME
        if fake or any(isinstance(leaf, FakeTensor) for leaf in tree_leaves((args, kwargs))):
            return _run(func, args, kwargs)
        return func(*args, **kwargs)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    fake = any(isinstance(tensor, FakeTensor) for tensor in tensors)
    strangers = [tuple(tensor.shape) for tensor in tensors if not isinstance(tensor, FakeTensor) and tensor.dim()]
    if fake and strangers and func._schema.name not in _CROSSING:
        raise RuntimeError(f"{func}: expected all tensors on one device, found some of {strangers} on the CPU")
    if kwargs.get("device") is not None:
        fake = torch.device(kwargs["device"]).type == NAME
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if "pin_memory" in kwargs:
        kwargs = {**kwargs, "pin_memory": False}
    held_args, held_kwargs = tree_map(lambda a: a.held if isinstance(a, FakeTensor) else a, (args, kwargs))
    result = func(*held_args, **held_kwargs)
    returns = func._schema.returns
    if not returns:
        return None
    if len(returns) == 1 and returns[0].alias_info is not None and returns[0].alias_info.is_write:
        return kwargs["out"] if "out" in kwargs else args[0]
    return tree_map(lambda r: FakeTensor(r) if fake and isinstance(r, torch.Tensor) else r, result)


@contextmanager
def gpu(kind: str) -> Iterator[str]:
    """Yield the device of a kind, one of ``GPUS``: ``fake``, or ``cuda``, a real one."""
    if kind == "cuda":
        yield "cuda:0"
        return
    with fake_gpu():
        yield NAME


@contextmanager
def fake_gpu() -> Iterator[None]:
    """Within the block, tensors can be made on the device ``fake``."""
    with _Creating():
        yield
