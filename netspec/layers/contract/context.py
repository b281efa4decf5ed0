"""The context of a layer in its net: the phase, the options of the net, and random numbers."""

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
    """Return torch's device with a name. Raises SpecError for an unknown name, and for a GPU that is missing."""
    try:
        device = torch.device(name)
        own = torch._C._get_privateuse1_backend_name()  # a device that another package adds to torch
        if device.type not in ("cpu", "cuda", "meta", *([own] if hasattr(torch, own) else [])):
            raise RuntimeError
    except RuntimeError:
        raise SpecError(f'found device "{name}", expected cpu, cuda or cuda:NUMBER') from None
    count = torch.cuda.device_count() if device.type == "cuda" else 0
    if device.type == "cuda" and (device.index or 0) >= count:
        raise SpecError(f'found device "{name}", but torch finds {count or "no"} GPU(s) on this machine; use "cpu"')
    return device


def nowhere(*path: str | int) -> Where:
    """Return the position of a layer that is not in a file."""
    return Where("<layer>")


class Random:
    """The random numbers of a net, reproducible from one seed, with one generator per device."""

    def __init__(self, seed: int) -> None:
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Restart from another seed."""
        self.seed = seed
        self._part: str | None = None
        self._generators: dict[str, torch.Generator] = {}
        self._begun: set[str] = set()  # the generators that were used in this part of a run

    def begin(self, what: str) -> None:
        """Begin a part of a run. Its numbers depend only on the seed and the name of the part."""
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

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """A block after which the same random numbers are drawn again."""
        states, begun = {key: each.get_state() for key, each in self._generators.items()}, set(self._begun)
        try:
            yield
        finally:
            self._begun = begun
            for key, state in states.items():
                self._generators[key].set_state(state)


@dataclass(frozen=True, slots=True)
class Context:
    """What a layer knows about its net: the ``phase``, the ``options``, and ``random`` numbers.

    If ``options.open_data`` is false, a layer must not open its files. The shapes of its tops are then in
    ``options.given_shapes`` (by blob name), or it raises a SpecError that asks for ``--shape``.
    ``at(*path)`` is the position in the prototxt of a field of this layer. ``report`` is called with each error that
    does not stop the building of the net; by default it raises the error.
    """

    phase: int = TEST
    options: BuildOptions = field(default_factory=BuildOptions)
    random: Random = field(default_factory=lambda: Random(0))
    at: Callable[..., Where] = nowhere
    report: Report = raise_fault
    # called after ``construct`` with the number of tops, for the order of the log
    created: Callable[[int], None] = lambda tops: None
    # whether the constructor allocates the blobs; a net does it when it knows that the memory is enough
    allocates: bool = True
    # the fork of Caffe that the layer belongs to, if several have its type (Forks.meaning)
    fork: str = ""

    @property
    def device(self) -> torch.device:
        """The device of the blobs."""
        return torch.device(self.options.device)

    @property
    def data_seed(self) -> int:
        """The seed of layers that read records; it is the same for all ranks."""
        return self.random.seed if self.options.data_seed is None else self.options.data_seed
