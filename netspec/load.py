"""From a prototxt and weights to a net: the public :func:`load_net`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

import torch

from netspec.errors import several
from netspec.exact import SMALL
from netspec.export.engines.choice import TORCH, Choice
from netspec.export.engines.net import with_engine
from netspec.graph.options import BuildOptions
from netspec.graph.steps import PASSES
from netspec.net import build
from netspec.net.net import Net
from netspec.proto.schema import phase_of


def load_net(
    path: str | Path,
    phase: str | int = "TEST",
    weights: str | Path | Iterable[str | Path] | None = None,
    level: int = 0,
    stages: str | Iterable[str] = (),
    device: str | torch.device = "cpu",
    seed: int | None = None,
    allow_python: bool = False,
    exact: str = SMALL,
    strict: bool = False,
    passes: str | Collection[str] = PASSES,
    engine: str = TORCH,
    precision: str = "fp32",
    cache: str | Path | bool | None = None,
    limit: int | None = None,
) -> Net:
    """Build the net of a prototxt for a phase, level and stages; ``weights`` names one file of weights or several.

    It takes what a user may choose as keywords; from here on that is one BuildOptions (netspec/graph/options.py).
    A warning names the layers that the weights lack; with ``strict`` that is an error.
    ``passes`` are what may speed up a net of phase TEST that runs without gradients (netspec/graph/steps.py).
    ``exact`` says which sums are Caffe's to the last bit: "none", "small" or "all" (see netspec/exact/__init__.py).
    ``engine`` is "torch", "onnxruntime" or "openvino" (docs/engines.md), ``precision`` "fp32", or "bf16" where the
    engine has it, ``cache`` the folder that keeps exported models (None: the user's cache folder, False: none).
    ``limit`` is the memory, in bytes, that the net may need (None: what there is).
    Raises SpecError for every fault of the files.

        >>> net = netspec.load_net("deploy.prototxt", weights="x.caffemodel")
        >>> net(images)["prob"].shape
        torch.Size([2, 4])
    """
    choice = Choice.of(engine, precision, cache)
    options = BuildOptions(
        str(device),
        seed,
        level=level,
        stages=several(stages),
        allow_python=allow_python,
        exact=exact,
        passes=several(passes),
        strict=strict,
        limit=limit,
    )
    files = several(weights)
    return with_engine(build.load_net(path, phase_of(phase), options, files), choice, path, files)
