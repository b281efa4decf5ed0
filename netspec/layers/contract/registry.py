"""The one registry: layer type, as a prototxt writes it, to class."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from netspec.errors import SpecError, Where, did_you_mean
from netspec.graph.options import BuildOptions
from netspec.layers.contract.base import Layer
from netspec.proto.dialect.files import DialectFile, announce_known, find_file, known_files, switch_on, waiting
from netspec.proto.dialect.registry import OWN_LAYER, advice_for, deactivate, dialects_with_type, known
from netspec.proto.dialect.used import dialects_in
from netspec.proto.schema import LayerParameter, NetParameter

_LAYERS: dict[str, type[Layer]] = {}
_OWNERS: dict[str, str] = {}  # layer type -> the dialect that has it; Caffe's own are not here
Wants = Callable[[LayerParameter], bool]
_REPLACING: dict[str, dict[str, tuple[type[Layer], Wants]]] = {}  # layer type of Caffe's -> dialect -> class, for which
_everywhere: set[str] = set()  # dialects that count for every net of the process: a user asked for them
_loading = ""  # the dialect whose file is run now
L = TypeVar("L", bound=type[Layer])


def register(
    type_name: str, *reads: str, replaces: type[Layer] | None = None, where: Wants = lambda param: True
) -> Callable[[L], L]:
    """Class decorator: make a layer known under the type that prototxt files use.

    ``reads`` are the fields of LayerParameter that are the layer's own, e.g. ``"pooling_param"``, and what a dialect
    adds to them, e.g. ``"pooling_param.extra"``; a net warns of all others (netspec/net/ignored_fields.py). With
    ``replaces`` a dialect's subclass takes the place of the class that has the type, to honor such an addition, in nets
    that use the dialect: of those layers ``where`` their LayerParameter asks for it.
    """

    def add(cls: L) -> L:
        assert _LAYERS.get(type_name) is replaces, f"layer type {type_name} registered twice"
        cls.type = type_name
        cls.reads = frozenset(reads)
        if replaces is None:
            _LAYERS[type_name] = cls
            _OWNERS.update({type_name: _loading} if _loading else {})
        else:
            _REPLACING.setdefault(type_name, {})[_loading or cls.__module__.rpartition(".")[2]] = cls, where
        return cls

    return add


def dialects_of(net: NetParameter) -> frozenset[str]:
    """Return the dialects that count for a net: those whose fields and layer types it has, and those for every net.

    A layer of a type that several forks have shows none of them; its class tells by its fields (whose.py).
    """
    classes = {layer.type: layer_class(layer.type) for layer in net.layer}
    shown = {name for name, cls in classes.items() if cls and not cls.forks}
    found = {*_everywhere, *(_OWNERS[each] for each in shown if each in _OWNERS)}
    return frozenset(found.union(*(dialects_in(layer) for layer in net.layer if layer.type in shown)))


def use_everywhere(dialect: str) -> None:
    """Let the layers of a dialect count for every net that this process builds from now on."""
    run_dialects()
    _everywhere.add(dialect)


def layer_class(type_name: str) -> type[Layer] | None:
    """Return the class registered for a type, or None. A type that one known dialect has switches that dialect on."""
    run_dialects()
    if type_name not in _LAYERS:
        announce_known()
        dialects = [name for name in dialects_with_type(type_name) if name in known_files()]
        if len(dialects) == 1:
            switch_on(find_file(dialects[0]))
            run_dialects()
    return _LAYERS.get(type_name)


def class_of(param: LayerParameter, options: BuildOptions | None = None) -> type[Layer] | None:
    """Return the class of a layer, or None: that of its type, where ``options.dialects`` have no other for it.

    A Python layer that a dialect knows by its module and class, ``"rpn.proposal_layer.ProposalLayer"``, is the
    dialect's, unless Python code is allowed to run and its module is there.
    """
    run_dialects()
    for dialect in options.dialects if options else ():
        cls, wants = _REPLACING.get(param.type, {}).get(dialect, (None, bool))
        if cls and wants(param):
            return cls
    if param.type != "Python":
        return layer_class(param.type)
    python: Any = layer_class("Python")
    known = layer_class(f"{param.python_param.module}.{param.python_param.layer}")
    return python if known is None or (options and options.allow_python and python.is_there(param)) else known


def run_dialects() -> None:
    """Register the layers of the dialects that were switched on. Raises SpecError for one that cannot be loaded."""
    global _loading
    while waiting:
        file, dialect = waiting.pop(0)
        module = file.module or f"netspec_dialect_{file.name}"
        if module in sys.modules:
            continue
        try:
            for layer_type in dialect.layer_types:
                if cls := _LAYERS.get(layer_type):
                    message = f'layer type "{layer_type}" already exists, from {cls.__module__}'
                    raise SpecError(message, Where(str(file.path)))
            _loading = file.name
            _run(file, module)
        except SpecError:
            deactivate(dialect.name)
            raise
        finally:
            _loading = ""


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
        place = Where(str(file.path), lines[-1] if lines else 0, 1)
        raise SpecError(f"cannot be loaded: {type(fault).__name__}: {text}", place) from fault


def layer_types() -> list[str]:
    """Return all registered types, in alphabetical order."""
    return sorted(_LAYERS)


def unknown_type(type_name: str) -> str:
    """Return the sentence that says that a type is unknown, and what may be meant or which dialect has it."""
    announce_known()
    advice = advice_for(type_name, dialects_with_type(type_name))
    types = {*layer_types(), *(each for dialect in known() for each in dialect.layer_types)}
    close = did_you_mean(type_name, sorted(types), near=True) or ";"
    hint = f"; {advice}" if advice else f"{close} `netspec layers` lists the known ones, {OWN_LAYER}"
    return f'unknown layer type "{type_name}"{hint}'
