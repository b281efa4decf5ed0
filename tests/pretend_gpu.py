"""A GPU that is none: its tensors lie in the CPU's memory, and refuse to meet those of the CPU.

What computes with it would compute on a GPU: nothing is left on the CPU, nothing is read without being fetched.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.utils.backend_registration as registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "pretend"
POSSIBLE = hasattr(registration, "_setup_privateuseone_for_python_backend")  # torch 2.9 and later
# Operations in which a GPU's tensor may meet others: copies, and indices, which may lie on the CPU.
_CROSSING = {"aten::copy_", "aten::_to_copy", "aten::_foreach_copy_", "aten::index", "aten::index_put_"}

if POSSIBLE:
    # Before the first backward pass of the process: by then autograd counts the devices.
    registration._setup_privateuseone_for_python_backend(NAME)


class PretendTensor(torch.Tensor):
    """A tensor ``held`` in the CPU's memory that says it lies elsewhere."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> PretendTensor:
        """Wrap a tensor."""
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        tensor = torch.Tensor._make_wrapper_subclass(cls, held.size(), device=torch.device(NAME, 0), **layout)
        tensor.held = held
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation on what is held."""
        return _run(func, args, kwargs or {})

    def tolist(self) -> Any:
        """Fetch the values, as a GPU's tensor does."""
        return self.detach().cpu().tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        """Refuse, as a GPU's tensor does."""
        raise TypeError(f"can't convert {self.device} device type tensor to numpy. Use Tensor.cpu() first")

    __array__ = numpy


class _Creating(TorchDispatchMode):
    """Sees to tensors that are made on the pretended GPU."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        pretended = kwargs.get("device") is not None and torch.device(kwargs["device"]).type == NAME
        if pretended or any(isinstance(leaf, PretendTensor) for leaf in tree_leaves((args, kwargs))):
            return _run(func, args, kwargs)
        return func(*args, **kwargs)


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    pretended = any(isinstance(tensor, PretendTensor) for tensor in tensors)
    strangers = [tuple(tensor.shape) for tensor in tensors if not isinstance(tensor, PretendTensor) and tensor.dim()]
    if pretended and strangers and func._schema.name not in _CROSSING:
        raise RuntimeError(f"{func}: expected all tensors on one device, found some of {strangers} on the CPU")
    if kwargs.get("device") is not None:
        pretended = torch.device(kwargs["device"]).type == NAME
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if "pin_memory" in kwargs:
        kwargs = {**kwargs, "pin_memory": False}
    held_args, held_kwargs = tree_map(lambda a: a.held if isinstance(a, PretendTensor) else a, (args, kwargs))
    result = func(*held_args, **held_kwargs)
    returns = func._schema.returns
    if not returns:
        return None
    if len(returns) == 1 and returns[0].alias_info is not None and returns[0].alias_info.is_write:
        return kwargs["out"] if "out" in kwargs else args[0]
    return tree_map(lambda r: PretendTensor(r) if pretended and isinstance(r, torch.Tensor) else r, result)


@contextmanager
def pretended_gpu() -> Iterator[None]:
    """Within, tensors can be made on the device ``pretend``."""
    with _Creating():
        yield
