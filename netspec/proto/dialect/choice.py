"""Which dialects a prototxt is written in: those whose fields, values and layer types it has."""

from __future__ import annotations

import re

from netspec import log
from netspec.errors import SpecError, Where
from netspec.proto.dialect.files import announce_known, find_file, known_files, switch_on
from netspec.proto.dialect.registry import Dialect, active, known
from netspec.proto.lexer import NAME, STRING, SYMBOL, Lexer
from netspec.proto.schema import caffe_names, fields_with

NAMED = re.compile(r"^[ \t]*#[ \t]*dialect:[ \t]*(\w+)[ \t]*\r?$", re.MULTILINE)


def use_dialects_of(text: str, file: str) -> list[str]:
    """Switch on the dialects whose fields, values of enums or layer types a prototxt has; return their names.

    The dialect that has most of them comes first, of equal ones that whose messages have more of the fields; what it
    has is not looked for in others. Where two have the same all the same, neither is switched on. A field whose name
    Caffe has too, in another message, is known by the message around it (``data_param { shuffle: true }``). ``file`` is
    what errors call the text. Raises SpecError for text that is no prototxt at all.
    """
    words = _words(text, file) - caffe_names()
    announce_known()
    own = {d.name: _own_words(d) for d in known() if d.name in known_files()}
    for name in active():
        words -= own.pop(name, set())
    used = []
    inner = {d.name: d.inner_fields() for d in known()}
    while own:
        found = {name: (len(words & names), len(words & inner[name])) for name, names in own.items()}
        name = max(own, key=lambda name: found[name])
        if not words & own[name]:
            break
        alike = [other for other in own if found[other] == found[name] and words & own[other] == words & own[name]]
        if len(alike) > 1:  # the layer that is built asks which is meant
            words -= own[name]
            continue
        switch_on(find_file(name))
        used.append(name)
        words -= own.pop(name)
    if used:
        log.logger.info(f"{file}: switched on the layers and fields of {' and '.join(used)}")
    return used


def named_dialects(text: str, file: str) -> tuple[str, ...]:
    """Switch on the dialects that comments of a prototxt name, ``# dialect: hed``; return their names.

    Raises SpecError for one that there is not.
    """
    names = []
    for found in NAMED.finditer(text):
        line = text.count("\n", 0, found.start(1)) + 1
        try:
            dialect = find_file(found[1])
        except SpecError as fault:
            raise SpecError(fault.message, Where(file, line, 1)) from None
        switch_on(dialect)
        names.append(dialect.name)
    return tuple(names)


def _own_words(dialect: Dialect) -> set[str]:
    """Return the names of a dialect's fields, of the values that it adds to Caffe's enums, and of its layer types.

    A field is there with the message around it too, ``data_param.shuffle``.
    """
    values = {value for names in dialect.values().values() for value in names}
    fields = {field for _, field in dialect.fields()}
    inside = {f"{outer}.{field}" for message, field in dialect.fields() for outer in fields_with(message)}
    return fields | inside | values | set(dialect.layer_types)


def _words(text: str, file: str) -> set[str]:
    """Return the names of fields, alone and with that of the message around them, of values, and of layer types."""
    lexer = Lexer(text, file)
    words, before, last, around = set(), ["", ""], "", [""]
    for token in lexer:
        if token.kind == NAME:
            last = token.text
            words.update((last, f"{around[-1]}.{last}"))
        elif token.kind == SYMBOL and token.text in "{<":
            around.append(last)
        elif token.kind == SYMBOL and token.text in "}>" and len(around) > 1:
            around.pop()
        elif token.kind == STRING and before == ["type", ":"]:
            words.add(lexer.unquote(token).decode(errors="replace"))
        before = [before[1], token.text]
    return words
