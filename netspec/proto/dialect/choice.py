"""Which dialects a prototxt is written in: those whose fields and layer types it has."""

from __future__ import annotations

from netspec.proto.dialect.files import announce_known, find_file, known_files, switch_on
from netspec.proto.dialect.registry import active, known
from netspec.proto.lexer import NAME, STRING, Lexer
from netspec.proto.schema import caffe_names
from netspec.terminal import log


def use_dialects_of(text: str, file: str) -> list[str]:
    """Switch on the dialects whose fields or layer types a prototxt has; return their names.

    The dialect that has most of them comes first; what it has is not looked for in others. A name that Caffe has too,
    in whichever message (``bias_filler``), switches nothing on. ``file`` is what errors call the text. Raises SpecError
    for text that is no prototxt at all.
    """
    words = _words(text, file) - caffe_names()
    announce_known()
    own = {d.name: {field for _, field in d.fields()} | set(d.layer_types) for d in known() if d.name in known_files()}
    for name in active():
        words -= own.pop(name, set())
    used = []
    while own:
        name = max(own, key=lambda name: len(words & own[name]))
        if not words & own[name]:
            break
        switch_on(find_file(name))
        used.append(name)
        words -= own.pop(name)
    if used:
        log.logger.info(f"{file}: switched on the layers and fields of {' and '.join(used)}")
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
