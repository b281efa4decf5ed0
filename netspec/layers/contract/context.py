"""What a layer knows of the net around it: its phase, how the net is built, its random draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from netspec.data.random_words import derived
from netspec.errors import Report, SpecError, Where, raise_fault
from netspec.graph.options import BuildOptions
from netspec.proto.schema import TEST


def device_of(name: str | torch.device) -> torch.device:
    """Return torch's device of a name. Raises SpecError for a name that is none, and for a GPU that is not here."""
    try:
        device = torch.device(name)
        own = torch._C._get_privateuse1_backend_name()  # a device that another package adds to torch
        if device.type not in ("cpu", "cuda", "meta", *([own] if hasattr(torch, own) else [])):
            raise RuntimeError
    except RuntimeError:
        raise SpecError(f'found device "{name}", expected cpu, cuda or cuda:NUMBER') from None
    count = torch.cuda.device_count() if device.type == "cuda" else 0
    if device.type == "cuda" and (device.index or 0) >= count:
        raise SpecError(f'found device "{name}", but torch finds {count or "no"} GPU(s) on this machine; "cpu" is here')
    return device


def nowhere(*path: str | int) -> Where:
    """Return the place of a layer that no file has."""
    return Where("<layer>")


class Random:
    """The net's random draws, reproducible from one seed; one generator a device."""

    def __init__(self, seed: int) -> None:
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Begin again, from another seed."""
        self.seed = seed
        self._part: str | None = None
        self._generators: dict[str, torch.Generator] = {}
        self._begun: set[str] = set()  # the generators that draw for this part

    def begin(self, what: str) -> None:
        """Go on with draws that follow from the seed and the name of a part of a run, whatever was drawn before."""
        self._part = what
        self._begun.clear()

    def on(self, device: torch.device | str = "cpu") -> torch.Generator:
        """Return the generator of ``device`` (made at its first use)."""
        key = str(device)
        if key not in self._begun:
            if key not in self._generators:
                self._generators[key] = torch.Generator(device)
            self._generators[key].manual_seed(self.seed if self._part is None else derived(self.seed, self._part))
            self._begun.add(key)
        return self._generators[key]

    @property
    def has_drawn(self) -> bool:
        """Whether something was drawn for this part."""
        return bool(self._begun)

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Let draws within the block be drawn again after it."""
        states, begun = {key: each.get_state() for key, each in self._generators.items()}, set(self._begun)
        try:
            yield
        finally:
            self._begun = begun
            for key, state in states.items():
                self._generators[key].set_state(state)


@dataclass(frozen=True, slots=True)
class Context:
    """What a layer may know of the net around it: ``phase``, how it is built, ``random`` draws of its own.

    Where ``options.open_data`` is false, a layer that reads files must not: its tops' shapes are in
    ``options.given_shapes`` (by blob name), or it raises a SpecError that asks for ``--shape``.
    ``at(*path)`` is the place in the prototxt of a field of this layer; ``report`` gets the faults after which building
    can go on (the default raises the first).
    """

    phase: int = TEST
    options: BuildOptions = field(default_factory=BuildOptions)
    random: Random = field(default_factory=lambda: Random(0))
    at: Callable[..., Where] = nowhere
    report: Report = raise_fault
    created: Callable[[int], None] = lambda tops: None  # called when ``construct`` has run: for the order of the log
    take: Callable[[int], None] = lambda size: None  # called before memory is taken, in bytes: it may refuse

    @property
    def device(self) -> torch.device:
        """Where blobs are made."""
        return torch.device(self.options.device)

    @property
    def data_seed(self) -> int:
        """The seed of layers that read records; it is the same for all ranks."""
        return self.random.seed if self.options.data_seed is None else self.options.data_seed
