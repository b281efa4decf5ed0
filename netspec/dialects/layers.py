"""The layers of the dialects: which dialect defines a type, and which classes replace layers of Caffe."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from google.protobuf.message import Message

from netspec.dialects.files import DialectFile, activate_file, announce_known, find_file, known_files, waiting
from netspec.dialects.registry import active, deactivate, dialects_with_type
from netspec.dialects.signatures import has_several
from netspec.errors import SpecError, Where
from netspec.graph.options import BuildOptions
from netspec.layers.contract.base import Layer
from netspec.layers.contract.registry import layer_class, registered
from netspec.proto.schema import PACKAGE, LayerParameter, NetParameter

_owners: dict[str, str] = {}  # layer type -> the dialect that defines it, without Caffe's types
Condition = Callable[[LayerParameter], bool]
_replacing: dict[str, dict[str, tuple[type[Layer], Condition]]] = {}  # type -> dialect -> class, condition
_everywhere: set[str] = set()  # dialects that a user requested for every net of the process
_loading = ""  # the dialect being loaded
L = TypeVar("L", bound=type[Layer])


def replace(type_name: str, *reads: str, where: Condition = lambda param: True) -> Callable[[L], L]:
    """Class decorator: let a subclass of one of Caffe's layers replace it in nets that use the dialect.

    It replaces only the layers for which ``where(LayerParameter)`` is true. ``reads`` are as for
    :func:`netspec.layers.register`, with the fields that the dialect adds: ``"pooling_param.extra"``.
    """

    def add(cls: L) -> L:
        cls.type = type_name
        cls.reads = frozenset(reads)
        _replacing.setdefault(type_name, {})[_loading or cls.__module__.rpartition(".")[2]] = cls, where
        return cls

    return add


def dialects_of(net: NetParameter) -> set[str]:
    """Return the dialects that a net uses: those of its fields and layer types, and those activated for every net.

    A layer type of several forks does not determine the dialect (netspec/dialects/signatures.py).
    """
    types = {layer.type for layer in net.layer}
    shown = {each for each in types if layer_class(each) and not has_several(each)}
    found = {*_everywhere, *(_owners[each] for each in shown if each in _owners)}
    if not active():
        return found
    return found.union(*(_dialects_in(layer) for layer in net.layer if layer.type in shown))


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


def use_everywhere(dialect: str) -> None:
    """Use the layers of a dialect in every net that this process builds from now on."""
    run_dialects()
    _everywhere.add(dialect)


def register_type(layer_type: str) -> None:
    """Register the layers of the active dialects, and of a dialect that is the only one to define a layer type."""
    run_dialects()
    if registered(layer_type) is None:
        announce_known()
        dialects = [name for name in dialects_with_type(layer_type) if name in known_files()]
        if len(dialects) == 1:
            activate_file(find_file(dialects[0]))
            run_dialects()


def class_of(param: LayerParameter, options: BuildOptions | None = None) -> type[Layer] | None:
    """Return the class with which the dialects in ``options`` replace that of a layer's type, or None.

    If a dialect implements the module and class of a Python layer, such as ``"rpn.proposal_layer.ProposalLayer"``, its
    class is used, unless Python code is allowed to run and the module exists.
    """
    run_dialects()
    for dialect in options.dialects if options else ():
        cls, condition = _replacing.get(param.type, {}).get(dialect, (None, bool))
        if cls and condition(param):
            return cls
    if param.type != "Python":
        return None
    python: Any = registered("Python")
    if options and options.allow_python and python.is_there(param):
        return None
    return layer_class(f"{param.python_param.module}.{param.python_param.layer}")


def run_dialects() -> None:
    """Register the layers of the active dialects. Raises SpecError for one that cannot be loaded."""
    global _loading
    while waiting:
        file, dialect = waiting.pop(0)
        module = file.module or f"netspec_dialect_{file.name}"
        if module in sys.modules:
            continue
        try:
            for layer_type in dialect.layer_types:
                if cls := registered(layer_type):
                    message = f'layer type "{layer_type}" already exists, from {cls.__module__}'
                    raise SpecError(message, Where(str(file.path)))
            _loading = file.name
            _run(file, module)
        except SpecError:
            deactivate(dialect.name)
            raise
        finally:
            _loading = ""
        _owners.update(dict.fromkeys(dialect.layer_types, file.name))


def _run(file: DialectFile, name: str) -> None:
    """Run a dialect's file, which registers its layers."""
    try:
        if file.module:
            importlib.import_module(name)
            return
        spec = importlib.util.spec_from_file_location(name, file.path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    except Exception as fault:
        sys.modules.pop(name, None)
        frames, own = traceback.extract_tb(fault.__traceback__), str(Path(file.path).absolute())
        lines = [frame.lineno or 0 for frame in frames if frame.filename == own]
        text = " ".join(str(fault).split())
        where = Where(str(file.path), lines[-1] if lines else 0, 1)
        raise SpecError(f"cannot be loaded: {type(fault).__name__}: {text}", where) from fault
