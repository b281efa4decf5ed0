"""Learned blobs that count how often an alias of their memory was handed out; :class:`Seen` detects changes.

Torch counts the writes to a tensor, but not the writes through ``data``, ``detach`` or numpy. A net that keeps copies
of its weights in another form, folded or in the layout of a kernel, must notice all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from operator import is_
from typing import Any

import torch
from typing_extensions import override


class Learned(torch.nn.Parameter):
    """A learnable blob that counts how often its memory was handed out."""

    handed_out = 0

    @override
    @classmethod
    def __torch_function__(
        cls, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Count the views that a program makes of blobs: it can write through them, and through their ``data``."""
        with uncounted():
            found = func(*args, **(kwargs or {}))
            for view in found if isinstance(found, (tuple, list)) else (found,):
                if isinstance(view, torch.Tensor) and isinstance(view._base, Learned):
                    view._base.handed_out += 1
        return found

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


#: A block in which views are not counted: in a pass, layers make views of their own blobs.
uncounted = torch._C.DisableTorchFunctionSubclass


def values_of(blob: torch.Tensor) -> torch.Tensor:
    """Return a blob's values without gradients, for reading only. This does not count as handing out an alias."""
    return torch.Tensor.detach(blob)


def blobs_of(layers: Iterable[torch.nn.Module]) -> Callable[[], list[Any]]:
    """Return a function that lists the present learned blobs of the layers.

    It is fast: iterating over ParameterLists takes longer than a run of a small net.
    """
    owners = [layer.blobs._parameters for layer in layers]  # pyright: ignore[reportAttributeAccessIssue]
    places = [(owner, name) for owner in owners for name in owner]
    return lambda: [owner[name] for owner, name in places]


class Seen:
    """The state of learned blobs at the time when kernels were made for them.

    The kernels use the memory of the blobs and of their gradients, so a blob with other memory counts as changed. With
    ``values``, the kernels hold copies of the values: a write to a blob, or a new alias of its memory, is then a change
    too.
    """

    __slots__ = ("_addresses", "_blobs", "_counts", "_gradients", "_values")

    def __init__(self, blobs: Iterable[torch.Tensor], values: bool = False) -> None:
        self._blobs, self._values = list(blobs), values
        self._addresses = [blob.data_ptr() for blob in self._blobs]
        self._gradients = [] if values else [blob.grad for blob in self._blobs]
        self._counts = _counts(self._blobs) if values else []

    def are(self, blobs: Sequence[torch.Tensor]) -> bool:
        """Return whether these are the same blobs, without a change."""
        if len(blobs) != len(self._blobs) or not all(map(is_, blobs, self._blobs)):
            return False
        if [blob.data_ptr() for blob in blobs] != self._addresses:
            return False
        if self._values:
            return _counts(blobs) == self._counts
        return all(map(is_, [blob.grad for blob in blobs], self._gradients))


def _counts(blobs: Sequence[Any]) -> list[tuple[int, int]]:
    """Return how often each blob was written to, and how often its memory was handed out."""
    try:
        return [(blob._version, blob.handed_out) for blob in blobs]
    except (AttributeError, RuntimeError):  # other classes, or inference mode, in which torch counts no writes
        return [(0 if b.is_inference() else b._version, getattr(b, "handed_out", 0)) for b in blobs]


def may_have_alias(blob: torch.Tensor) -> bool:
    """Return whether a blob could be changed through an alias of its memory that is, or may be, alive."""
    if not isinstance(blob, Learned):
        return True
    if blob.handed_out == 0:
        return False
    return _uses is None or _uses(blob.untyped_storage()._cdata) > _uses_of_one()


# Returns how many tensors and arrays share a storage. Torch has no public function for this. If this one is missing, a
# blob that was ever handed out counts as aliased.
_uses = getattr(torch._C, "_storage_Use_Count", None)


@cache
def _uses_of_one() -> int:
    """Return the result of ``_uses`` for a storage with a single tensor."""
    tensor = torch.empty(1)
    return _uses(tensor.untyped_storage()._cdata) if _uses else 0
