"""What is chosen when a net is built: one object, from the caller to the Context of each layer. It needs no torch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from netspec.errors import check_choice, several
from netspec.exact import CHOICES, SMALL

FOLD, FUSE, SKIP, PACK = PASSES = ("fold", "fuse", "skip", "pack")  # netspec/fast/steps.py says what they do


@dataclass(frozen=True)
class BuildOptions:
    """How a net is built.

    Of the layers those are built whose rules fit ``level`` and ``stages``, besides the phase; level None leaves the one
    that the prototxt has. ``device`` is torch's name of where its blobs are; on "meta" they have shapes and no values.
    ``seed`` None draws one; ``open_data`` False opens no data (``given_shapes``: the tops of data layers, by blob). No
    layer writes a file on "meta", nor without ``write_files``; ``allow_python`` lets Python layers run code. This net
    is number ``rank`` of ``ranks`` nets that train in parallel: its data layers read their share of the records, and
    draw from ``data_seed``, which must be the same for all ranks (None: from ``seed``).
    ``exact`` sets which sums equal Caffe's in every bit: "none", "small" or "all" (netspec/exact/__init__.py).
    ``accumulate_in_place`` makes layers add the gradients that they sum up to ``grad`` themselves, like Caffe
    (netspec/exact/accumulate.py); hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP then do not see
    these gradients.
    ``speed`` makes the net faster (:class:`netspec.run.speed.Speed`; None: nothing does); ``passes`` are what it may do
    to a net of phase TEST that runs without gradients (netspec/fast/steps.py).
    Weights must have every layer of the net if ``strict``. The net may need ``limit`` bytes of memory (None: what there
    is on its device). ``dialects`` are those of Caffe's forks that the net uses; what its text says is added. One text
    where several are meant is one of them. Raises SpecError for an ``exact`` or a pass that there is not.
    """

    device: str = "cpu"
    seed: int | None = None
    data_seed: int | None = None
    open_data: bool = True
    write_files: bool = True
    level: int | None = 0
    stages: Sequence[str] = ()
    given_shapes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    allow_python: bool = False
    rank: int = 0
    ranks: int = 1
    exact: str = SMALL
    accumulate_in_place: bool = False
    speed: Any = None
    passes: Collection[str] = PASSES
    strict: bool = False
    limit: int | None = None
    dialects: Collection[str] = ()

    def __post_init__(self) -> None:
        check_choice("exact", self.exact, CHOICES)
        for name in ("stages", "passes", "dialects"):
            object.__setattr__(self, name, several(getattr(self, name)))
        for name in self.passes:
            check_choice("pass", name, PASSES)
