"""Layers that read records, and layers that keep state between passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer
from netspec.proto.schema import value

State = dict[str, int | str | tuple[torch.Tensor, ...]]


@runtime_checkable
class Remembers(Protocol):
    """A layer with state in addition to its blobs."""

    def running_state(self) -> State:
        """Return the state that the layer keeps between passes, without its blobs."""
        ...

    def resume(self, state: Mapping[str, Any]) -> None:
        """Restore a result of :meth:`running_state`. Raises SpecError for an impossible value."""
        ...


@runtime_checkable
class Restarts(Protocol):
    """A layer that reads records, or counts them."""

    def restart(self) -> None:
        """Return to the first record."""
        ...


@runtime_checkable
class Waits(Protocol):
    """A layer that gets its records from other threads."""

    ahead: int  # bytes of batches that are read ahead

    @property
    def waited(self) -> float:
        """The seconds that forward passes have waited for records."""
        ...


@runtime_checkable
class NeedsInput(Protocol):
    """A layer that gets its data from a program."""

    def missing_input(self) -> SpecError | None:
        """Return an error if a solver cannot run the layer, because a program must first give it data."""
        ...


@runtime_checkable
class TakesArrays(Protocol):
    """A layer that reads its records from arrays of a program."""

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray) -> None:
        """Take images (n, C, H, W) and labels (n,). Raises SpecError for other shapes."""
        ...


@runtime_checkable
class Constant(Protocol):
    """A layer with tops that are filled once, when it is built."""

    def filled_once(self) -> Sequence[torch.Tensor | None]:
        """Return for each top its constant values, or None; an empty sequence if no top is constant."""
        ...


@runtime_checkable
class Scores(Protocol):
    """A layer with its own score of a test, instead of the mean of its top over the batches."""

    solver_reads: frozenset[str]  # a fork's fields of the solver that ``score`` reads

    def score(self, tops: Sequence[torch.Tensor], solver: Any = None) -> list[float]:
        """Return the scores of a test from the tops of all its batches.

        ``solver`` is the SolverParameter, None where there is no solver.
        """
        ...


def reads_data(layer: Layer | type[Layer]) -> bool:
    """Return whether a layer's tops are records. They are inputs of an exported net."""
    return getattr(layer, "reads_data", False)


def source_of(param: Any, layer: type[Layer] | None) -> str:
    """Return the path that a LayerParameter names for its records, "" where it names none."""
    group = getattr(layer, "group", "")
    return getattr(value(param, group), "source", "") if layer and group and reads_data(layer) else ""


def takes_shapes(layer: type[Layer]) -> bool:
    """Return whether ``--shape`` may set the shapes of the tops, although the layer has bottoms."""
    return getattr(layer, "takes_shapes", False)


def channels_read(param: Any, layer: type[Layer] | None) -> int:
    """Return the number of channels of the bottoms that the filters in a LayerParameter need; 0 without filters."""
    read = getattr(layer, "channels_read", None)
    return read(param) if read and param.blobs else 0


def changes_itself(layer: Layer) -> bool:
    """Return whether a layer changes its state in a pass. Such a layer can be neither prepared nor copied."""
    return getattr(layer, "remembers", False)


def bytes_ahead(layer: Layer) -> int:
    """Return the bytes of the batches that a layer reads ahead."""
    return layer.ahead if isinstance(layer, Waits) else 0


def running_state(layer: Layer) -> State:
    """Return the state that a layer keeps between passes, without its blobs."""
    return layer.running_state() if isinstance(layer, Remembers) else {}


def resume(layer: Layer, state: Mapping[str, Any]) -> None:
    """Restore a result of :func:`running_state`. Raises SpecError if it does not fit the layer."""
    found, mine = (
        ", ".join(f"{name} ({type(value).__name__})" for name, value in sorted(each.items()))
        for each in (state, running_state(layer))
    )
    if found != mine:
        raise layer.error(f"found a saved state with {found}, expected {mine or 'nothing'}")
    if isinstance(layer, Remembers):
        layer.resume(state)
