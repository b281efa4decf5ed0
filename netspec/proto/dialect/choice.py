"""Which dialects a prototxt is written in: those whose fields, values and layer types it has."""

from __future__ import annotations

from netspec.proto.dialect.files import announce_known, find_file, known_files, switch_on
from netspec.proto.dialect.registry import Dialect, active, known
from netspec.proto.lexer import NAME, STRING, Lexer
from netspec.proto.schema import caffe_names
from netspec.terminal import log


def use_dialects_of(text: str, file: str) -> list[str]:
    """Switch on the dialects whose fields, values of enums or layer types a prototxt has; return their names.

    The dialect that has most of them comes first, of equal ones that whose messages have more of the fields; what it
    has is not looked for in others. Where two have the same all the same, neither is switched on. A name that Caffe has
    too, in whichever message (``bias_filler``), switches nothing on. ``file`` is what errors call the text. Raises
    SpecError for text that is no prototxt at all.
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


def _own_words(dialect: Dialect) -> set[str]:
    """Return the names of a dialect's fields, of the values that it adds to Caffe's enums, and of its layer types."""
    values = {value for names in dialect.values().values() for value in names}
    return {field for _, field in dialect.fields()} | values | set(dialect.layer_types)


def _words(text: str, file: str) -> set[str]:
    """Return the names of fields and of values, and the layer types, in a prototxt."""
    lexer = Lexer(text, file)
    words, before = set(), ["", ""]
    for token in lexer:
        if token.kind == NAME:
            words.add(token.text)
        elif token.kind == STRING and before == ["type", ":"]:
            words.add(lexer.unquote(token).decode(errors="replace"))
        before = [before[1], token.text]
    return words
