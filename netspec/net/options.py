"""How a net is built."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from netspec.errors import SpecError, Where, did_you_mean
from netspec.exact import SMALL, check_choice
from netspec.graph import Report, raise_fault
from netspec.graph.steps import PASSES
from netspec.layers.base import Shape
from netspec.proto.schema import NetParameter


@dataclass(frozen=True)
class BuildOptions:
    """How a net is built.

    ``seed`` None draws one; ``open_data`` False opens no data (``given_shapes``: the tops of data layers, by blob);
    with ``write_files`` False, no layer writes one;
    ``report`` gets each error (the default raises the first); ``allow_python`` lets Python layers run code. This net is
    number ``rank`` of ``ranks`` nets that train in parallel: its data layers read their share of the records, and draw
    from ``data_seed``, which must be the same for all ranks (None: from ``seed``).
    ``exact`` sets which sums equal Caffe's in every bit: "none", "small" or "all" (netspec/exact/__init__.py).
    ``accumulate_in_place`` makes layers add the gradients that they sum up to ``grad`` themselves, like Caffe;
    hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP then do not see these gradients.
    With ``compiled``, torch.compile makes functions of the layers that it can (netspec/run/segments.py).
    ``passes`` are those of netspec/graph/steps.py that a net of phase TEST may use when it runs without gradients.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    seed: int | None = None
    data_seed: int | None = None
    open_data: bool = True
    write_files: bool = True
    given_shapes: Mapping[str, Shape] | None = None
    report: Report = raise_fault
    allow_python: bool = False
    rank: int = 0
    ranks: int = 1
    exact: str = SMALL
    accumulate_in_place: bool = False
    passes: Collection[str] = PASSES
    compiled: bool = False

    def __post_init__(self) -> None:
        check_choice(self.exact)


def not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return an error for each given shape whose blob is not a top of a data layer (or Python layer)."""
    makers = [layer for net in nets for layer in net.layer if not layer.bottom or layer.type == "Python"]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape: no data layer has a top "{name}"{did_you_mean(name, blobs) or ";"} their tops: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]
