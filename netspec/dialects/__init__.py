'''Dialects: the layers of Caffe's forks, one file each, with what they add to the schema.

``--plugin NAME`` on the command line, or ``netspec.use_dialect(NAME)``, switches one on for the whole process. NAME is
one of netspec's own (the files in this folder), one that an installed package offers (an entry point of the group
``netspec.dialects``), or the path of a .py file. Errors about an unknown field or layer type also
name the dialects that have it, even if they are not active.

To write one, put this into a file, say ``doubling.py``, and pass ``--plugin doubling.py``::

    """A fork with a layer that multiplies."""

    from netspec.layers import Layer, register
    from netspec.proto.schema import value

    DECLARATIONS = """
    message TimesParameter {
      optional float factor = 1 [default = 2];
    }
    extend LayerParameter {
      optional TimesParameter times_param = 1000;
    }
    """

    @register("Times", "times_param")
    class Times(Layer):
        """Multiply by a number.

        bottom[0]  any shape
        top[0]     the same shape
        """

        def reshape(self, bottom_shapes):
            return bottom_shapes

        def forward(self, data):
            return data * value(self.param, "times_param").factor

``DECLARATIONS`` is in the language of caffe.proto (netspec/proto/dialect/registry.py): messages as they stand in the
fork, new fields of Caffe's messages in ``extend``; one plain string. A layer is as Caffe's own are
(netspec/layers/base.py);
``@register`` has its type and the fields of LayerParameter that it reads: a net warns of fields that no layer reads.
``@register("Dropout", ..., replaces=Dropout)`` puts a subclass in the place of one of Caffe's layers, to honor a
field that the fork added to it. To offer a dialect with a package, name its module in that package's pyproject.toml::

    [project.entry-points."netspec.dialects"]
    doubling = "mypackage.doubling"
'''

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path

from netspec.errors import SpecError, Where
from netspec.proto.dialect.files import DialectFile, announce_known, find_file, read_dialect
from netspec.proto.dialect.registry import activate, active, deactivate, known
from netspec.proto.lexer import NAME, STRING, Lexer
from netspec.proto.schema import caffe_names

__all__ = ["use_dialect", "use_dialects_of"]


def use_dialect(name: str | Path) -> None:
    """Add the fields and layers of a dialect, given by its name or the path of its file, for the whole process.

    Does nothing where it is there already. Raises SpecError where there is no such dialect, its file has a fault, or
    Caffe or another dialect has one of its fields or layer types.
    """
    from netspec.layers import layer_class

    file = find_file(name)
    dialect = read_dialect(file)
    module = file.module or f"netspec_dialect_{file.name}"
    for layer_type in () if module in sys.modules else dialect.layer_types:
        cls = layer_class(layer_type)
        if cls is not None:
            message = f'layer type "{layer_type}" already exists, from {cls.__module__}'
            raise SpecError(message, Where(str(file.path)))
    activate(dialect)
    try:
        _run(file, module)
    except SpecError:
        deactivate(dialect.name)
        raise


def use_dialects_of(text: str, file: str) -> list[str]:
    """Switch on the dialects whose fields or layer types a prototxt has; return their names.

    The dialect that has most of them comes first; what it has is not looked for in others. A name that Caffe has too,
    in whichever message (``bias_filler``), switches nothing on. ``file`` is what errors call the text. Raises SpecError
    for text that is no prototxt at all.
    """
    words = _words(text, file) - caffe_names()
    announce_known()
    own = {d.name: {field for _, field in d.fields()} | set(d.layer_types) for d in known()}
    for name in active():
        words -= own.pop(name, set())
    used = []
    while own:
        name = max(own, key=lambda name: len(words & own[name]))
        if not words & own[name]:
            break
        use_dialect(name)
        used.append(name)
        words -= own.pop(name)
    return used


def _words(text: str, file: str) -> set[str]:
    """Return the field names and the layer types in a prototxt."""
    lexer = Lexer(text, file)
    words, before = set(), ["", ""]
    for token in lexer:
        if token.kind == NAME:
            words.add(token.text)
        elif token.kind == STRING and before == ["type", ":"]:
            words.add(lexer.unquote(token).decode(errors="replace"))
        before = [before[1], token.text]
    return words


def _run(file: DialectFile, name: str) -> None:
    """Run a dialect's file, which registers its layers, unless that was done before."""
    if name in sys.modules:
        return
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
        frames = traceback.extract_tb(fault.__traceback__)
        lines = [frame.lineno or 0 for frame in frames if frame.filename == str(file.path)]
        text = " ".join(str(fault).split())
        place = Where(str(file.path), lines[-1] if lines else 0, 1)
        raise SpecError(f"cannot be loaded: {type(fault).__name__}: {text}", place) from fault
