"""Layers that read records, and layers that remember something from one pass to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from netspec.errors import SpecError
from netspec.layers.contract.base import Layer

State = dict[str, int | str | tuple[torch.Tensor, ...]]


@runtime_checkable
class Remembers(Protocol):
    """A layer that has more than its blobs to go on from."""

    def running_state(self) -> State:
        """Return what the layer remembers from one pass to the next, besides its blobs."""
        ...

    def resume(self, state: Mapping[str, Any]) -> None:
        """Remember what :meth:`running_state` returned. Raises SpecError where a value is impossible."""
        ...


@runtime_checkable
class Restarts(Protocol):
    """A layer that reads records, or counts them."""

    def restart(self) -> None:
        """Return to the first record."""
        ...


@runtime_checkable
class Waits(Protocol):
    """A layer whose records are made by other threads."""

    ahead: int  # bytes of batches that it reads before they are asked for

    @property
    def waited(self) -> float:
        """How many seconds forward passes have waited for records."""
        ...


@runtime_checkable
class NeedsInput(Protocol):
    """A layer that gets its data from a program."""

    def missing_input(self) -> SpecError | None:
        """Return an error if a solver cannot run the layer, because a program must first give it data."""
        ...


@runtime_checkable
class TakesArrays(Protocol):
    """A layer whose records are arrays of a program."""

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray) -> None:
        """Take images (n, C, H, W) and labels (n,). Raises SpecError for other shapes."""
        ...


@runtime_checkable
class Constant(Protocol):
    """A layer some of whose tops are written when it is made and never again."""

    def filled_once(self) -> Sequence[torch.Tensor | None]:
        """Return these by top; an empty dict if there are none."""
        ...


@runtime_checkable
class Scores(Protocol):
    """A layer whose top, in a test, is not averaged over the batches."""

    solver_reads: frozenset[str]  # a fork's fields of the solver that ``score`` reads

    def score(self, tops: Sequence[torch.Tensor], solver: Any = None) -> list[float]:
        """Return what the tops of all batches of a test say together.

        ``solver`` is the SolverParameter, None where there is no solver.
        """
        ...


def reads_data(layer: Layer | type[Layer]) -> bool:
    """Return whether a layer's tops are records; exported nets take them as inputs."""
    return getattr(layer, "reads_data", False)


def takes_shapes(layer: type[Layer]) -> bool:
    """Return whether ``--shape`` may tell the shapes of a layer's tops although it has bottoms."""
    return getattr(layer, "takes_shapes", False)


def channels_read(param: Any, layer: type[Layer] | None) -> int:
    """Return the channels of a layer's bottoms that the filters in its LayerParameter have; 0 where it has none."""
    read = getattr(layer, "channels_read", None)
    return read(param) if read and param.blobs else 0


def changes_itself(layer: Layer) -> bool:
    """Return whether a pass changes more than a layer's tops, so that it can be neither prepared nor run on a copy."""
    return getattr(layer, "remembers", False)


def bytes_ahead(layer: Layer) -> int:
    """Return the bytes of the batches that a layer reads before they are asked for."""
    return layer.ahead if isinstance(layer, Waits) else 0


def running_state(layer: Layer) -> State:
    """Return what a layer remembers from one pass to the next, besides its blobs."""
    return layer.running_state() if isinstance(layer, Remembers) else {}


def resume(layer: Layer, state: Mapping[str, Any]) -> None:
    """Let a layer remember what :func:`running_state` returned. Raises SpecError if that does not fit."""
    found, mine = (
        ", ".join(f"{name} ({type(value).__name__})" for name, value in sorted(each.items()))
        for each in (state, running_state(layer))
    )
    if found != mine:
        raise layer.error(f"found {found} to remember, expected {mine or 'nothing'}")
    if isinstance(layer, Remembers):
        layer.resume(state)
