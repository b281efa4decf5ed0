"""The interfaces that layers use to export themselves. netspec/export implements them.

Layers use only these two protocols, and no library of the target.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    import torch  # a stored model of another engine runs without torch

Sizes = tuple[int | None, ...]  # a shape; None where the size is known only when the exported net runs


class OnnxGraph(Protocol):
    """The ONNX graph that is being written, as one layer sees it. Values are known by name.

    Bottoms and tops are known by their index in the layer. Sizes that the caller of the exported net may choose are
    None; a layer that needs such a size as a number asks for it with :meth:`size`, which fixes it.
    """

    def node(self, op: str, *inputs: str, **attributes: Any) -> str:
        """Add a node of one output and return the output. An empty input is one that is left out."""
        ...

    def nodes(self, op: str, *inputs: str, outputs: int, **attributes: Any) -> tuple[str, ...]:
        """Add a node of several outputs and return them."""
        ...

    def constant(self, values: Any) -> str:
        """Return a constant: numbers, lists or arrays. Whole numbers become int64, other numbers float32."""
        ...

    def blob(self, index: int, shape: Sequence[int] | None = None) -> str:
        """Return a learned blob of the layer, in its own shape or in another of as many elements."""
        ...

    def input(self, top: int) -> str:
        """Return a new input of the whole net, for a top that its caller gives."""
        ...

    def sizes(self, bottom: int) -> Sizes:
        """Return the shape of a bottom."""
        ...

    def size(self, bottom: int, axis: int, why: str) -> int:
        """Return the size of an axis of a bottom; if it was free, it is fixed, and the user sees ``why``."""
        ...

    def shape_of(self, value: str, start: int = 0, end: int | None = None) -> str:
        """Return the sizes of the axes from ``start`` to ``end`` of a value, as they are when the net runs."""
        ...

    def reshape(self, value: str, sizes: Sequence[int]) -> str:
        """Return the value in another shape; 0 copies the size of the same axis, one -1 is inferred."""
        ...

    def reshape_to_top(self, value: str, top: int = 0) -> str:
        """Return the value in the shape of a top of the layer, whatever the free sizes are."""
        ...

    def cast(self, value: str, dtype: str) -> str:
        """Return the value as ``float32``, ``int64`` or ``bool``."""
        ...


class TorchCode(Protocol):
    """The PyTorch module that is being written, as one layer sees it. Values are expressions.

    A layer returns one expression for each top, or one for all of them, a tuple. In a template ``{name}`` stands for
    what is given by that keyword: expressions that came from here, and numbers.
    """

    def call(self, template: str, **values: Any) -> str:
        """Return an expression, e.g. ``call("F.elu({x}, alpha={alpha})", x=bottom, alpha=0.5)``."""
        ...

    def module(
        self, template: str, state: Mapping[str, torch.Tensor], usual: Mapping[str, Any] | None = None, **values: Any
    ) -> str:
        """Add a submodule, named after the layer, and return the expression that stands for it.

        ``template`` is its constructor's call; ``state`` has its parameters and buffers by their names in it. Keywords
        of the call that have their ``usual`` value are not written.
        """
        ...

    def parameter(self, index: int, shape: Sequence[int] | None = None, name: str = "") -> str:
        """Add a learned blob as a parameter of the module itself, in this shape, and return its expression.

        It is named after the layer, and ``name`` where the layer has several.
        """
        ...

    def buffer(self, values: torch.Tensor) -> str:
        """Add constants that are stored with the weights, and return their expression."""
        ...

    def function(self, function: Callable[..., Any]) -> str:
        """Copy a function's source into the file, and return its name; it may use torch, F, math and nothing else."""
        ...

    def affine(self, value: str, scale: torch.Tensor, shift: torch.Tensor) -> bool:
        """Let the normalization module that made ``value`` scale and shift the channels too; say whether it can."""
        ...

    def sizes(self, bottom: int) -> Sizes:
        """Return the shape of a bottom."""
        ...

    def size(self, bottom: int, axis: int, why: str) -> int:
        """Return the size of an axis of a bottom; if it was free, it is fixed, and the user sees ``why``."""
        ...

    def reshape_to_top(self, value: str, bottom: int = 0, top: int = 0) -> str:
        """Return the expression of a bottom's value in the shape of a top of the layer, whatever the free sizes are."""
        ...

    def input(self, top: int) -> str:
        """Return a new argument of ``forward``, for a top that its caller gives."""
        ...


def rounded(value: float) -> float:
    """Return a number of a float32 field as it was written: the shortest that float32 rounds to it."""
    return float(str(np.float32(value)))
