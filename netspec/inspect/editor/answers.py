"""The answers to an editor's questions, without its protocol. Offsets count characters of the text, from 0."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from string import ascii_letters, digits
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec.errors import SpecError, Where
from netspec.inspect.check.lint import lint_file
from netspec.inspect.editor.context import LAYERS, context_at, root_of, token_at
from netspec.layers import layer_class, layer_types
from netspec.layers.contract.base import Shape
from netspec.proto.lexer import NAME, STRING
from netspec.proto.schema import NetParameter, fields_of
from netspec.proto.source_map import SourceMap
from netspec.proto.text import parse_net_text, parse_solver_text
from netspec.proto.writer import scalar_text

ERROR, WARNING, HINT = "error", "warning", "hint"
BLOBS = ("bottom", "top")
WORD = f"{ascii_letters}{digits}_"  # the characters of names
Shapes = Mapping[str, tuple[Shape, ...]]


@dataclass(frozen=True)
class Diagnostic:
    """A fault or a finding: its place, its text, how bad it is, and the rule that found it."""

    where: Where
    message: str
    severity: str
    rule: str = ""


def text_faults(text: str, file: str) -> list[Diagnostic]:
    """Return what is wrong with a text itself: while it is being written."""
    parse = parse_net_text if root_of(text) is NetParameter.DESCRIPTOR else parse_solver_text
    faults: list[SpecError] = []
    try:
        parse(text, file, report=faults.append)
    except SpecError as fault:
        faults.append(fault)
    return [_diagnostic(fault, ERROR) for fault in faults]


def file_faults(path: str) -> tuple[list[Diagnostic], Shapes]:
    """Return what is wrong or likely wrong with a saved file, and the shapes of its blobs by name, in each phase."""
    linted = lint_file(path)
    found = [_diagnostic(fault, ERROR) for fault in linted.faults]
    found += [_diagnostic(fault, HINT) for fault in linted.unknown]
    found += [Diagnostic(each.where, each.message, WARNING, each.rule) for each in linted.found]
    shapes: dict[str, tuple[Shape, ...]] = {}
    for net in linted.nets:
        for name, shape in net.shapes.items():
            shapes[name] = tuple(dict.fromkeys((*shapes.get(name, ()), tuple(shape))))
    return found, shapes


def _diagnostic(fault: SpecError, severity: str) -> Diagnostic:
    return Diagnostic(fault.where or Where(""), fault.message, severity)


def hover(text: str, offset: int, shapes: Shapes) -> str:
    """Return in Markdown what stands at a place: a layer type, a blob with its shape, a field; else an empty text."""
    found = token_at(text, offset)
    if found is None:
        return ""
    name, token = found
    context = context_at(text, token.start)
    if context.message is None:
        return ""
    if token.kind == NAME and token.text == name and context.field is None:
        field = fields_of(context.message).get(name)
        return _field_text(context.message.name, field) if field else ""
    word = token.text[1:-1] if token.kind == STRING else token.text
    if context.message.full_name in LAYERS and name == "type":
        cls = layer_class(word)
        return f"**{word}**\n```text\n{inspect.cleandoc(cls.__doc__)}\n```" if cls and cls.__doc__ else ""
    if context.message.full_name in LAYERS and name in BLOBS:
        told = " or ".join("×".join(map(str, shape)) or "scalar" for shape in shapes.get(word, ()))
        return f"blob **{word}**: {told or 'shape not known'}"
    return ""


def _field_text(message: str, field: Any) -> str:
    kind = _type_name(field)
    label = "repeated " if field.repeated else ""
    text = f"**{field.name}** ({label}{kind}), field of {message}"
    if field.type == Declared.TYPE_ENUM:
        text += f"\n\none of {', '.join(field.descriptor.enum_type.values_by_name)}"
    if not field.repeated and field.type != Declared.TYPE_MESSAGE:
        text += f"\n\ndefault: {scalar_text(field, field.descriptor.default_value)}"
    return text


def _type_name(field: Any) -> str:
    if field.type == Declared.TYPE_MESSAGE:
        return field.descriptor.message_type.name
    if field.type == Declared.TYPE_ENUM:
        return field.descriptor.enum_type.name
    return Declared.Type.Name(field.type).removeprefix("TYPE_").lower()


def definition(text: str, offset: int) -> Where | None:
    """Return the place of the layer that makes the blob at a place, or that first has the parameter of this name."""
    found = token_at(text, offset)
    if found is None or found[1].kind != STRING:
        return None
    name, token = found
    word, message = token.text[1:-1], context_at(text, token.start).message
    net, source = _readable_net(text)
    if net is None or source is None or message is None:
        return None
    if message.full_name in LAYERS and name in BLOBS:
        place = text.count("\n", 0, token.start) + 1, token.start - text.rfind("\n", 0, token.start)
        here = sum((layer.where.line, layer.where.column) <= place for layer in source.layers) - 1
        makers = [i for i, layer in enumerate(net.layer) if word in layer.top]
        if name == "top" and word not in net.layer[here].bottom:
            makers = [here]
        chosen = [i for i in makers if i < here][-1:] or makers[:1]  # in place, a layer changes what one before made
        return source.layers[chosen[0]].where if chosen else None
    if message.name == "ParamSpec" and name == "name":
        owners = (i for i, layer in enumerate(net.layer) if any(spec.name == word for spec in layer.param))
        return next((source.layers[i].where for i in owners), None)
    return None


def _readable_net(text: str) -> tuple[Any, SourceMap | None]:
    try:
        return parse_net_text(text, "", upgrade=False, report=lambda fault: None)
    except SpecError:
        return None, None


@dataclass(frozen=True)
class Choice:
    """What may be written at a place; ``kind`` is field, type, value or blob."""

    text: str
    kind: str
    detail: str = ""


def completion(text: str, offset: int) -> list[Choice]:
    """Return what may stand at a place: fields of the message, values of an enum, layer types, names of blobs."""
    line = text[text.rfind("\n", 0, offset) + 1 : offset]
    in_string = line.partition("#")[0].count('"') % 2 == 1
    if "#" in line and not in_string:
        return []
    start = text.rfind('"', 0, offset) if in_string else offset - len(line) + len(line.rstrip(WORD))
    context = context_at(text, start)
    if context.message is None:
        return []
    if context.field is None:
        return [] if in_string else [_as_choice(field) for field in fields_of(context.message).values()]
    return list(_values(text, context.field, in_string))


def _values(text: str, field: Any, in_string: bool) -> Iterator[Choice]:
    def quoted(word: str) -> str:
        return word if in_string else f'"{word}"'

    if field.descriptor.containing_type.full_name == LAYERS[0] and field.name == "type":
        for name in layer_types():
            first = ((layer_class(name) or object).__doc__ or "").strip().splitlines()[:1]
            yield Choice(quoted(name), "type", "".join(first))
    elif field.name in BLOBS and field.descriptor.containing_type.full_name in LAYERS:
        for name in dict.fromkeys(_blobs(text)):
            yield Choice(quoted(name), "blob")
    elif field.type == Declared.TYPE_ENUM and not in_string:
        yield from (Choice(name, "value") for name in field.descriptor.enum_type.values_by_name)
    elif field.type == Declared.TYPE_BOOL and not in_string:
        yield from (Choice(word, "value") for word in ("true", "false"))


def _blobs(text: str) -> Iterator[str]:
    """Yield the names of tops, however unfinished the text is."""
    for part in text.split("top:")[1:]:
        words = part.lstrip().split('"', 2)
        if len(words) == 3 and not words[0] and "\n" not in words[1]:
            yield words[1]


def _as_choice(field: Any) -> Choice:
    return Choice(field.name, "field", ("repeated " if field.repeated else "") + _type_name(field))
