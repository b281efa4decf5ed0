"""netspec, the living Caffe: runs Caffe's prototxt in PyTorch, unmodified, with Caffe's numbers.

The public names are loaded when they are first used, so that ``import netspec.proto.text`` does not import torch. This
file imports only modules without imports of their own: until it has run, a program cannot handle signals
(netspec/terminal/main.py), and ``python -m netspec`` still searches the working directory for modules first
(netspec/__main__.py).
"""

from netspec.graph import speed as _speed
from netspec.proto import forks as _forks

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from netspec.errors import SpecError
    from netspec.load import load_net, load_solver
    from netspec.net.net import Net
    from netspec.net.one_layer import layer
    from netspec.net.weights import load_weights, save_weights
    from netspec.proto.forks import use_dialect
    from netspec.solver.solver import Solver

_HOMES = {
    "SpecError": "netspec.errors",
    "use_dialect": "netspec.proto.forks",
    "Net": "netspec.net.net",
    "layer": "netspec.net.one_layer",
    "load_net": "netspec.load",
    "Solver": "netspec.solver.solver",
    "load_solver": "netspec.load",
    "load_weights": "netspec.net.weights",
    "save_weights": "netspec.net.weights",
}

__all__ = [
    "Net",
    "Solver",
    "SpecError",
    "layer",
    "load_net",
    "load_solver",
    "load_weights",
    "save_weights",
    "use_dialect",
]


def _find_forks() -> "_forks.Forks | None":
    """Return the object that knows Caffe's forks, or None if netspec/dialects is not installed."""
    import importlib.util

    if importlib.util.find_spec("netspec.dialects") is None:
        return None
    from netspec.dialects.forks import Dialects

    return Dialects()


def _find_speed() -> "_speed.Speed | None":
    """Return the object that makes nets faster, or None if netspec/fast is not installed."""
    import importlib.util

    if importlib.util.find_spec("netspec.fast") is None:
        return None
    from netspec.fast.speed import Fast

    return Fast()


_forks.find = _find_forks
_speed.find = _find_speed


def load_ipython_extension(ipython: object) -> None:
    """Let ``import caffe`` find netspec in a notebook: ``%load_ext netspec``."""
    from netspec.compat.scripts import finder

    finder.install()


def unload_ipython_extension(ipython: object) -> None:
    """Undo :func:`load_ipython_extension`."""
    from netspec.compat.scripts import finder

    finder.uninstall()


def __getattr__(name: str) -> "Any":
    import importlib.util

    if name == "__version__":
        from netspec.files.version import version

        return version()
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if importlib.util.find_spec(f"netspec.{name}"):
        return importlib.import_module(f"netspec.{name}")
    raise AttributeError(f"module 'netspec' has no attribute {name!r}")
