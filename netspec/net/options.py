"""How a net is built, whoever asks for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from netspec.errors import SpecError, Where, did_you_mean
from netspec.exact import SMALL, check_choice
from netspec.graph import Report, raise_fault
from netspec.layers.base import Shape
from netspec.proto.schema import NetParameter


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
        check_choice(self.exact)


def not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return a fault for each given shape of a blob that no data layer (or Python layer) makes."""
    makers = [layer for net in nets for layer in net.layer if not layer.bottom or layer.type == "Python"]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape names "{name}"{did_you_mean(name, blobs) or ";"} the blobs of data layers: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]
