"""How a net is built, whoever asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from netspec.exact import CHOICES, SMALL
from netspec.graph import Report, raise_fault
from netspec.layers.base import Shape


@dataclass(frozen=True)
class BuildOptions:
    """How a net is built.

    ``seed`` None draws one; ``open_data`` False opens no data (``given_shapes``: the tops of data layers, by blob);
    ``report`` gets each fault (the default raises the first); ``allow_python`` lets Python layers run code. Of
    ``ranks`` nets that train side by side this one is number ``rank``: its data layers read their share of the records,
    and draw from ``data_seed``, which all ranks must have in common (None: from ``seed``).
    ``exact`` says which sums are Caffe's to the last bit: "none", "small" or "all" (netspec/exact/__init__.py).
    ``accumulate_in_place`` makes layers add their parameters' gradients to ``grad`` themselves where they sum them up,
    as Caffe does; hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP then do not see these.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    seed: int | None = None
    data_seed: int | None = None
    open_data: bool = True
    given_shapes: Mapping[str, Shape] | None = None
    report: Report = raise_fault
    allow_python: bool = False
    rank: int = 0
    ranks: int = 1
    exact: str = SMALL
    accumulate_in_place: bool = False

    def __post_init__(self) -> None:
        if self.exact not in CHOICES:
            raise ValueError(f"found exact {self.exact!r}, expected {', '.join(map(repr, CHOICES))}")
