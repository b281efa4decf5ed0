"""netspec, the living Caffe: runs Caffe's prototxt in PyTorch, unmodified, with Caffe's numbers.

The public names are loaded when they are first used, so that ``import netspec.proto.text`` needs no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from netspec.errors import SpecError

if TYPE_CHECKING:
    from netspec.dialects import use_dialect
    from netspec.net import Net, load_net
    from netspec.solver.solver import Solver, load_solver
    from netspec.weights import load_weights, save_weights

_HOMES = {
    "use_dialect": "netspec.dialects",
    "Net": "netspec.net",
    "load_net": "netspec.net",
    "Solver": "netspec.solver.solver",
    "load_solver": "netspec.solver.solver",
    "load_weights": "netspec.weights",
    "save_weights": "netspec.weights",
}

__all__ = ["Net", "Solver", "SpecError", "load_net", "load_solver", "load_weights", "save_weights", "use_dialect"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in ("proto", "net", "data", "layers", "graph", "solver", "weights"):
        return importlib.import_module(f"netspec.{name}")
    raise AttributeError(f"module 'netspec' has no attribute {name!r}")
