"""The options for building a net. Each layer gets them in its Context. This module does not import torch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from netspec.errors import check_choice, several
from netspec.exact import CHOICES as EXACT
from netspec.exact import SMALL

if TYPE_CHECKING:
    from netspec.graph.speed import Speed

TORCH, ONNXRUNTIME, OPENVINO = ENGINES = ("torch", "onnxruntime", "openvino")  # engines
OPSET = 18  # of exported ONNX models: that of ONNX 1.13 (2022); torch.onnx writes no older one
FP32, BF16 = PRECISIONS = ("fp32", "bf16")  # number formats
FOLD, FUSE, SKIP, PACK = PASSES = ("fold", "fuse", "skip", "pack")  # see netspec/fast/steps.py


@dataclass(frozen=True)
class BuildOptions:
    """How a net is built.

    - ``level``, ``stages``: with the phase, they determine which layers are built. Level None: the prototxt's.
    - ``device``: torch's name of the device of the blobs. On "meta", blobs have shapes but no values.
    - ``seed``: the seed of random numbers. None: a random seed.
    - ``open_data``: if False, no data is opened; ``given_shapes`` then has the shapes of data layers' tops, by blob.
    - ``write_files``: if False, or on "meta", no layer writes a file.
    - ``allow_python``: whether Python layers are allowed to run code.
    - ``rank``, ``ranks``: the index and number of nets that train in parallel. Data layers read their share of records.
    - ``data_seed``: the seed of data layers, the same for all ranks. None: ``seed``.
    - ``exact``: which sums are bit-identical to Caffe's: "none", "small" or "all" (netspec/exact/__init__.py).
    - ``accumulate_in_place``: layers add their gradients to ``grad`` themselves, like Caffe, also of frozen blobs
      whose gradients Caffe computes
      (netspec/exact/accumulate.py). Hooks on parameters, ``torch.autograd.grad`` and wrappers like DDP do not see them.
    - ``speed``: the code that makes the net faster (:class:`netspec.graph.speed.Speed`), or None.
    - ``passes``: the optimizations of ``speed`` for a net of phase TEST without gradients (netspec/fast/steps.py).
    - ``strict``: whether weights files must contain every layer of the net.
    - ``limit``: the maximum memory of the net, in bytes. None: the memory of its device.
    - ``dialects``: forks of Caffe that the net uses, in addition to those that its prototxt names.

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
    speed: Speed | None = None
    passes: Collection[str] = PASSES
    strict: bool = False
    limit: int | None = None
    dialects: Collection[str] = ()

    def __post_init__(self) -> None:
        check_choice("exact", self.exact, EXACT)
        for name in ("stages", "passes", "dialects"):
            object.__setattr__(self, name, several(getattr(self, name)))
        for name in self.passes:
            check_choice("pass", name, PASSES)
