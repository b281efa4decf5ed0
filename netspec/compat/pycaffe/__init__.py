"""Caffe's Python interface: ``import netspec.pycaffe as caffe``.

Messages, ``caffe.io`` and NetSpec are there without torch; every other name loads :mod:`netspec.pycaffe.interface`.
"""

import importlib
import importlib.util
import sys
from typing import TYPE_CHECKING, Any

from netspec.compat.pycaffe import logs
from netspec.compat.pycaffe.version import __version__ as __version__

if TYPE_CHECKING:
    from netspec.compat.pycaffe.interface import *  # noqa: F403

TRAIN, TEST = 0, 1

_WITHOUT_TORCH = {"NetSpec": "net_spec", "layers": "net_spec", "params": "net_spec", "to_proto": "net_spec"}
_INTERFACE = f"{__name__}.interface"

logs.start()


def __getattr__(name: str) -> Any:
    if not name.startswith("__") and importlib.util.find_spec(f"{__name__}.{name}"):
        return importlib.import_module(f"{__name__}.{name}")
    if name in _WITHOUT_TORCH:
        return getattr(importlib.import_module(f"{__name__}.{_WITHOUT_TORCH[name]}"), name)
    dunder = name.startswith("__") and name != "__all__"
    if not dunder and _INTERFACE not in sys.modules:  # otherwise the name does not exist, or is being loaded
        names = vars(importlib.import_module(_INTERFACE))
        globals().update({given: value for given, value in names.items() if not given.startswith("__")})
        globals()["__all__"] = [given for given in names if not given.startswith("_")]
    if name in globals():
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
