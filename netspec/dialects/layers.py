"""The layers of the dialects: which dialect defines a type, and which classes replace layers of Caffe."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import threading
import traceback
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

from google.protobuf.message import Message

from netspec.dialects.files import OF_FILES
from netspec.dialects.known import dialect, dialect_of_module, known
from netspec.dialects.registry import Dialect, declare
from netspec.dialects.signatures import chosen, has_several
from netspec.errors import SpecError, Where
from netspec.layers.contract.base import Layer
from netspec.layers.contract.registry import calling_module, registered
from netspec.proto.schema import PACKAGE, LayerParameter, NetParameter

Condition = Callable[[LayerParameter], bool]
CLASSES: dict[str, dict[str, type[Layer]]] = {}  # type -> dialect -> class, of types that Caffe lacks
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
        cls.reads, cls.takes_empty = frozenset(reads), False
        _replacing.setdefault(type_name, {})[owner] = cls, where
        return cls

    return add


def class_of(layer: LayerParameter, shown: Sequence[Collection[str]], runs_python: bool = False) -> type[Layer] | None:
    """Return the class of a layer in a net that shows these dialects; None if it is Caffe's, or not clear.

    ``shown``: the strongest first, and all that the net uses last. If a dialect implements the module and class of a
    Python layer, such as ``"rpn.proposal_layer.ProposalLayer"``, its class is used, unless Python code is allowed to
    run and the module exists. Raises SpecError if the net shows several dialects that replace or define the layer.
    """
    for name in shown[-1]:
        load(dialect(name))
    replacing = {name: cls for name, (cls, where) in _replacing.get(layer.type, {}).items() if where(layer)}
    if found := chosen(layer.type, [(name,) for name in sorted(replacing) if name in shown[-1]], shown):
        return replacing[found[0]]
    kind = layer.type
    if kind == "Python":
        python: Any = registered("Python")
        if runs_python and python.is_there(layer):
            return None
        kind = f"{layer.python_param.module}.{layer.python_param.layer}"
    elif registered(kind):
        return None
    if not (found := chosen(kind, [(name,) for name in known().types.get(kind, ())], shown)):
        return None
    load(dialect(found[0]))
    return CLASSES.get(kind, {}).get(found[0])


def dialects_of(net: NetParameter) -> set[str]:
    """Return the dialects of a net's fields, and of its layer types that only one of them has.

    Layers whose type several forks have show none: the fields of one may be declared by another.
    """
    found: set[str] = set()
    for layer in net.layer:
        having = () if registered(layer.type) else known().types.get(layer.type, ())
        if not has_several(layer.type):
            found.update(having if len(having) == 1 else (), _dialects_in(layer))
    return found


def _dialects_in(message: Message) -> set[str]:
    """Return the dialects that define a field of a message, or of a message inside it."""
    found: set[str] = set()
    fields: Any = message.ListFields()
    for field, value in fields:
        if field.is_extension:
            found.add(field.file.package.removeprefix(f"{PACKAGE}."))
        if field.message_type is not None:
            found.update(*map(_dialects_in, [value] if isinstance(value, Message) else value))
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
        spec: Any = importlib.util.spec_from_file_location(dialect.module, path)
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
