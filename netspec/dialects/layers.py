"""The layers of the dialects: which dialect defines a type, and which classes replace layers of Caffe."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import threading
import traceback
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, TypeVar

from google.protobuf.message import Message

from netspec.dialects.files import OF_FILES
from netspec.dialects.known import added, dialect, dialect_of_module, known
from netspec.dialects.registry import Dialect, declare
from netspec.dialects.signatures import has_several
from netspec.errors import SpecError, Where
from netspec.layers.contract.base import Layer
from netspec.layers.contract.registry import calling_module, registered
from netspec.proto.schema import PACKAGE, LayerParameter, NetParameter

Condition = Callable[[LayerParameter], bool]
_classes: dict[str, dict[str, type[Layer]]] = {}  # type -> dialect -> class, of types that Caffe lacks
_replacing: dict[str, dict[str, tuple[type[Layer], Condition]]] = {}  # type -> dialect -> class, condition
_lock = threading.RLock()
L = TypeVar("L", bound=type[Layer])


def replace(type_name: str, *reads: str, where: Condition = lambda param: True) -> Callable[[L], L]:
    """Class decorator: let a subclass of one of Caffe's layers replace it in nets that use the dialect.

    It replaces only the layers for which ``where(LayerParameter)`` is true. ``reads`` are as for
    :func:`netspec.layers.register`, with the fields that the dialect adds: ``"pooling_param.extra"``.
    """

    owner = dialect_of_module(calling_module())

    def add(cls: L) -> L:
        cls.type = type_name
        cls.reads = frozenset(reads)
        _replacing.setdefault(type_name, {})[owner] = cls, where
        return cls

    return add


def adopt(cls: type[Layer], owner: str) -> None:
    """Keep a class that the module of a dialect registers."""
    _classes.setdefault(cls.type, {})[owner] = cls


def class_of(param: LayerParameter, dialects: Collection[str], runs_python: bool) -> type[Layer] | None:
    """Return the class of a layer that Caffe lacks, or with which one of the dialects replaces Caffe's; or None.

    If a dialect implements the module and class of a Python layer, such as ``"rpn.proposal_layer.ProposalLayer"``, its
    class is used, unless Python code is allowed to run and the module exists.
    """
    used = sorted({*dialects, *added()})
    for name in used:
        load(dialect(name))
        cls, condition = _replacing.get(param.type, {}).get(name, (None, bool))
        if cls and condition(param):
            return cls
    if param.type == "Python":
        python: Any = registered("Python")
        if runs_python and python.is_there(param):
            return None
        return _class_of_type(f"{param.python_param.module}.{param.python_param.layer}", used)
    return None if registered(param.type) else _class_of_type(param.type, used)


def _class_of_type(layer_type: str, used: Collection[str]) -> type[Layer] | None:
    """Return the class that a dialect defines for a type: one that is used, or else the only one; a user's own first.

    None if there is no such dialect, or if it is not clear which one is meant.
    """
    name = owner_of(layer_type, used)
    if not name:
        return None
    load(dialect(name))
    return _classes.get(layer_type, {}).get(name)


def owner_of(layer_type: str, used: Collection[str] = ()) -> str:
    """Return the dialect that defines a layer type, "" if none does, or if it is not clear which one is meant."""
    having = known().types.get(layer_type, ())
    meant = [name for name in having if name in used] or list(having)
    own = [name for name in meant if name in added()] if len(meant) > 1 else meant
    return own[0] if len(own) == 1 else ""


def dialects_of(net: NetParameter) -> set[str]:
    """Return the dialects that a net uses: those of its fields and layer types, and those added for every net.

    A layer type of several forks does not determine the dialect (netspec/dialects/signatures.py).
    """
    found = set(added())
    for layer in net.layer:
        if registered(layer.type) is None:
            if has_several(layer.type) or not known().types.get(layer.type):
                continue
            found.update(filter(None, [owner_of(layer.type, found)]))
        found |= _dialects_in(layer)
    return found


def _dialects_in(message: Message) -> set[str]:
    """Return the dialects that define a field of a message, or of a message inside it."""
    found: set[str] = set()
    fields: Any = message.ListFields()
    for field, value in fields:
        if field.is_extension:
            found.add(field.file.package.removeprefix(f"{PACKAGE}."))
        if field.message_type is not None:
            values = [value] if isinstance(value, Message) else value
            found.update(*(_dialects_in(each) for each in values))
    return found


def load(dialect: Dialect) -> None:
    """Make the fields and layers of a dialect known. Raises SpecError if they cannot be."""
    declare(dialect)
    with _lock:
        if dialect.module not in sys.modules:
            for layer_type in dialect.layer_types:
                if cls := registered(layer_type):
                    message = f'layer type "{layer_type}" already exists, from {cls.__module__}'
                    raise SpecError(message, Where(dialect.file))
            _run(dialect)


def _run(dialect: Dialect) -> None:
    """Run a dialect's file, which registers its layers."""
    path = Path(dialect.file)
    try:
        if not dialect.module.startswith(OF_FILES):
            importlib.import_module(dialect.module)
            return
        spec = importlib.util.spec_from_file_location(dialect.module, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[dialect.module] = module
        spec.loader.exec_module(module)
    except Exception as fault:
        sys.modules.pop(dialect.module, None)
        frames, own = traceback.extract_tb(fault.__traceback__), str(path.absolute())
        lines = [frame.lineno or 0 for frame in frames if frame.filename == own]
        text = " ".join(str(fault).split())
        where = Where(str(path), lines[-1] if lines else 0, 1)
        raise SpecError(f"cannot be loaded: {type(fault).__name__}: {text}", where) from fault
