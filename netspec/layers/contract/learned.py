"""A layer's learned blobs, which record when their memory was handed out.

Torch counts the writes to a tensor, but not those to what ``data`` and ``detach`` hand out, nor those of numpy. What a
net keeps of its weights in another form, folded or laid out for a kernel, must follow all of them.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from typing_extensions import override

Stamp = tuple[int, int, int]


class Learned(torch.nn.Parameter):
    """A learnable blob that counts how often its memory was handed out."""

    handed_out = 0

    @property
    def data(self) -> torch.Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The values, without gradients."""
        self.handed_out += 1
        return torch.Tensor.data.__get__(self)  # pyright: ignore[reportAttributeAccessIssue]

    @data.setter
    def data(self, values: torch.Tensor) -> None:
        self.handed_out += 1
        torch.Tensor.data.__set__(self, values)  # pyright: ignore[reportAttributeAccessIssue]

    @override
    def detach(self) -> torch.Tensor:
        """Return the values, without gradients."""
        self.handed_out += 1
        return super().detach()

    @override
    def numpy(self, *, force: bool = False) -> Any:
        """Return the values as an array that shares their memory."""
        self.handed_out += 1
        return super().numpy(force=force)

    @override
    def __array__(self, *arguments: Any, **named: Any) -> Any:
        self.handed_out += 1
        return super().__array__(*arguments, **named)


def values_of(blob: torch.Tensor) -> torch.Tensor:
    """Return a blob's values without gradients, for reading: this does not count as handing them out."""
    return torch.Tensor.detach(blob)


def stamp(blob: torch.Tensor) -> Stamp:
    """Return what changes when a blob is written to, replaced or handed out."""
    version = 0 if blob.is_inference() else blob._version
    return version, getattr(blob, "handed_out", 0), blob.data_ptr()


def is_lent(blob: torch.Tensor) -> bool:
    """Return whether an alias of a blob's memory is alive, or might be, through which it could be changed."""
    if not isinstance(blob, Learned):
        return True
    if blob.handed_out == 0:
        return False
    return _uses is None or _uses(blob.untyped_storage()._cdata) > _uses_of_one()


_uses = getattr(torch._C, "_storage_Use_Count", None)  # how many tensors and arrays share a storage


@cache
def _uses_of_one() -> int:
    """Return the uses of a storage that one tensor alone holds."""
    tensor = torch.empty(1)
    return _uses(tensor.untyped_storage()._cdata) if _uses else 0
