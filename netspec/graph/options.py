"""The options for building a net. Each layer gets them in its Context. This module does not import torch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from netspec.errors import check_choice, several
from netspec.exact import CHOICES, SMALL

TORCH, ONNXRUNTIME, OPENVINO = ENGINES = ("torch", "onnxruntime", "openvino")  # what may run a net
FP32, BF16 = PRECISIONS = ("fp32", "bf16")  # in what numbers
FOLD, FUSE, SKIP, PACK = PASSES = ("fold", "fuse", "skip", "pack")  # netspec/fast/steps.py says what they do


@dataclass(frozen=True)
class BuildOptions:
    """How a net is built.

    - ``level``, ``stages``: which layers are built, together with the phase. Level None: that of the prototxt.
    - ``device``: where the blobs are, by torch's name. On "meta" they have shapes and no values.
    - ``seed``: of random numbers. None: a random seed.
    - ``open_data``: False opens no data; ``given_shapes`` then has the shapes of the tops of data layers, by blob.
    - ``write_files``: False lets no layer write a file. On "meta" none does either.
    - ``allow_python``: whether Python layers may run code.
    - ``rank``, ``ranks``: the index and number of nets that train in parallel. Data layers read their share of records.
    - ``data_seed``: of data layers, the same for all ranks. None: ``seed`` is used.
    - ``exact``: which sums equal Caffe's in every bit: "none", "small" or "all" (netspec/exact/__init__.py).
    - ``accumulate_in_place``: layers add their gradients to ``grad`` themselves, like Caffe
      (netspec/exact/accumulate.py). Hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP do not see them.
    - ``speed``: makes the net faster (:class:`netspec.run.speed.Speed`). None: nothing does.
    - ``passes``: what ``speed`` may do to a net in phase TEST without gradients (netspec/fast/steps.py).
    - ``strict``: files of weights must have every layer of the net.
    - ``limit``: the memory in bytes that the net may need. None: the memory of its device.
    - ``dialects``: of Caffe's forks that the net uses, in addition to those that its prototxt names.

    A single string is accepted for a tuple of one. Raises SpecError for an unknown ``exact`` or pass.
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
