"""Reads protobuf's text format into a message, by reflection, with the position of every part.

It accepts the files that Caffe's C++ parser accepts, and refuses others with one line that gives the position and the
reason. It also accepts ``ceil_mode: true`` in a pooling_param, which many forks use for ``round_mode: CEIL``. A field
or value that Caffe lacks is that of the one known fork that can be meant (netspec/proto/forks.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import tee
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared
from google.protobuf.message import Message

from netspec import log
from netspec.errors import ForkFault, SpecError, Where, did_you_mean
from netspec.proto.forks import forks
from netspec.proto.lexer import END, FLOAT, INTEGER, NAME, STRING, SYMBOL, Lexer, Token
from netspec.proto.schema import Field, NetParameter, SolverParameter, V1LayerParameter, fields_of
from netspec.proto.source_map import Position

_RANGES: dict[int, tuple[int, int]] = {
    Declared.TYPE_INT32: (-(1 << 31), (1 << 31) - 1),
    Declared.TYPE_INT64: (-(1 << 63), (1 << 63) - 1),
    Declared.TYPE_UINT32: (0, (1 << 32) - 1),
    Declared.TYPE_UINT64: (0, (1 << 64) - 1),
}
_LONGEST = 100  # digits: more than any valid number has, and few enough for Python to print
_BOOLEANS = {"true": True, "True": True, "t": True, "false": False, "False": False, "f": False}
_V1_TYPES = V1LayerParameter.LayerType.keys()
_LAYERS = ("caffe.LayerParameter", "caffe.V1LayerParameter")

_DEVICES = ("caffe.SolverParameter", "device_id")  # in yjxiong/caffe this is a list, the GPUs of its processes
_ALIASES = {("caffe.PoolingParameter", "ceil_mode"): ("round_mode", {True: "CEIL", False: "FLOOR"})}

# Other kinds of files, to suggest if a field is unknown in the outermost message.
_OTHER_FILE: dict[str, tuple[Any, str]] = {
    "caffe.NetParameter": (SolverParameter, "solver"),
    "caffe.SolverParameter": (NetParameter, "net"),
}

_LABEL_MAP = "item"  # the only field of SSD's LabelMap

_CLOSING = {"{": "}", "<": ">", "[": "]"}

Children = dict[str, list[Position]]


def read_text(text: str, file: str, message: Message, report: Callable[[SpecError], None] | None = None) -> Position:
    """Read a text into an empty ``message``; return the positions of its parts.

    ``report``, if given, gets a ForkFault for each unknown field, which is then left out with its contents. A field of
    several forks is that of the one that a comment names or that the text uses, or else of the only one whose message
    has the fields inside.

    Raises SpecError for unknown fields, values of the wrong type or out of range, singular fields given twice, missing
    required fields, and text that is not protobuf's text format.
    """
    return _Reader(text, file, report).read(message)


class _Reader:
    """A recursive descent parser; ``self.token`` is the next token."""

    def __init__(self, text: str, file: str, report: Callable[[SpecError], None] | None) -> None:
        self._report = report
        self._named = forks().named_in(text, file)
        self._dialects = [*self._named, *forks().everywhere]  # those that are used
        self.lexer = Lexer(text, file)
        self._tokens = iter(self.lexer)
        self._open: list[tuple[Message, Token]] = []  # the messages being read, each with the token that named it
        self.token = next(self._tokens)

    def read(self, message: Message) -> Position:
        children: Children = {}
        self._open.append((message, self.token))
        while self.token.kind != END:
            self._field(message, children)
        self._check_required(message)
        return Position(Where(self.lexer.file), _frozen(children), self._named)

    # ---- Grammar ----

    def _field(self, message: Message, children: Children) -> None:
        if self.token.kind != NAME:
            advice = '; is there an extra "}"?' if self._at("}") and len(self._open) == 1 else ""
            raise self._expected("a field name", advice=advice)
        name = self._next()
        key = (message.DESCRIPTOR.full_name, name.text)
        alias, meaning = _ALIASES.get(key, (name.text, None))
        field = fields_of(message.DESCRIPTOR).get(alias)
        if field is None:
            field = self._of_fork(*key, forks().additions().fields.get(key, ()))
        if field is None:
            fault = self._unknown_field(message, name)
            if self._report is None or not isinstance(fault, ForkFault):
                raise fault
            self._report(fault)
            self._skip(name)
            return
        if not field.repeated and children.get(alias):
            first = children[alias][0].where.line
            raise self._error(f'"{alias}" was already given in line {first}; it can be given only once', name)
        nodes = children.setdefault(field.name, [])
        if self._at(":"):
            self._next()
        elif field.type != Declared.TYPE_MESSAGE:
            raise self._expected('":"', f'after "{name.text}"')
        if field.type == Declared.TYPE_ENUM and meaning is None and self.token.kind == NAME:
            field = self._with_value(message, field, self.token.text)
        if meaning is not None:
            field.set(message, field.descriptor.enum_type.values_by_name[meaning[self._boolean()]].number)
            nodes.append(Position(self.lexer.where(name.start)))
        elif self._at("[") and (field.repeated or key == _DEVICES):
            self._list(field, message, nodes)
            if key == _DEVICES:
                advice = "only the first is used; for several GPUs, use train --gpu 0,1"
                log.logger.warning(f"{self.lexer.where(name.start)}: device_id is a list: {advice}")
        else:
            nodes.append(self._value(field, message, name))
        if self._at(",") or self._at(";"):
            self._next()

    def _with_value(self, message: Message, field: Field, value: str) -> Field:
        """Return the enum field that has a value: ``field``, or the one for values that forks add to it."""
        if value in field.descriptor.enum_type.values_by_name:
            return field
        owner = message.DESCRIPTOR.full_name
        dialects = forks().additions().values.get((owner, field.name, value), ())
        return self._of_fork(owner, field.name, dialects) or field

    def _of_fork(self, message: str, name: str, dialects: Sequence[str]) -> Field | None:
        """Return the field of a message that one of these dialects adds, or None if it is not clear which one."""
        found = {dialect: forks().field(dialect, message, name) for dialect in dialects}
        if len(found) > 1:
            inside, types = self._names_inside(), {d: f.descriptor.message_type for d, f in found.items()}
            found = {d: found[d] for d, of in types.items() if of is None or inside <= fields_of(of).keys()} or found
        for shown in (self._named, self._dialects):
            if len(found) > 1:
                found = {d: field for d, field in found.items() if d in shown} or found
        if len(found) != 1:
            return None
        ((dialect, field),) = found.items()
        if dialect not in self._dialects:
            self._dialects.append(dialect)
            log.logger.info(f"{self.lexer.file}: uses the dialect {dialect}")
        return field

    def _added_values(self, message: str, field: str) -> list[str]:
        """Return the values that the dialects in use add to the enum of one of Caffe's fields."""
        added = forks().additions().values.items()
        return [value for (*key, value), owners in added if key == [message, field] and {*owners} & {*self._dialects}]

    def _names_inside(self) -> set[str]:
        """Return the names of the fields inside the message that begins at the next token."""
        self._tokens, ahead = tee(self._tokens)
        names, depth, token = set[str](), 0, self.token
        while token.kind != END:
            before, token = token, next(ahead)
            depth += (before.text in _CLOSING) - (before.text in _CLOSING.values())
            if depth == 0 and before.kind == SYMBOL and before.text != ":":
                break
            if depth == 1 and token.kind == NAME and before.text != ":":
                names.add(token.text)
        return names

    def _skip(self, name: Token) -> None:
        """Skip the value of an unknown field: a scalar, a list or a message with any contents."""
        has_colon = self._at(":")
        if has_colon:
            self._next()
        if self.token.kind == SYMBOL and self.token.text in _CLOSING:
            awaited = [_CLOSING[self._next().text]]
            while awaited:
                if self.token.kind == END:
                    raise self._unclosed(name.text, name, awaited[0])
                token = self._next()
                if token.kind != SYMBOL:
                    continue
                if token.text in _CLOSING:
                    awaited.append(_CLOSING[token.text])
                elif token.text == awaited[-1]:
                    awaited.pop()
        elif not has_colon:
            raise self._expected('":" or "{"', f'after "{name.text}"')
        elif self.token.kind == STRING:
            while self.token.kind == STRING:
                self._next()
        else:
            self._minus()
            if self.token.kind not in (NAME, INTEGER, FLOAT):
                raise self._expected("a value", f'for "{name.text}"')
            self._next()
        if self._at(",") or self._at(";"):
            self._next()

    def _list(self, field: Field, message: Message, nodes: list[Position]) -> None:
        self._next()
        if self._at("]"):
            self._next()
            return
        while True:
            first = field.repeated or not nodes
            nodes.append(self._value(field, message if first else type(message)(), self.token))
            if self._at("]"):
                self._next()
                return
            if not self._at(","):
                raise self._expected('"," or "]"', f'in the list of "{field.name}"')
            self._next()

    def _value(self, field: Field, message: Message, token: Token) -> Position:
        where = self.lexer.where(token.start)
        if field.type == Declared.TYPE_MESSAGE:
            inner = field.get(message)
            inner = inner.add() if field.repeated else inner
            inner.SetInParent()
            return Position(where, self._message(inner, token, field.name))
        value = self._scalar(field)
        if field.repeated:
            field.get(message).append(value)
        else:
            field.set(message, value)
        return Position(where)

    def _message(self, message: Message, token: Token, name: str) -> dict[str, tuple[Position, ...]]:
        if not (self._at("{") or self._at("<")):
            raise self._expected('"{"', f'after "{name}"')
        closing = "}" if self._next().text == "{" else ">"
        children: Children = {}
        self._open.append((message, token))
        while not self._at(closing):
            if self.token.kind == END:
                raise self._unclosed(name, token, closing)
            self._field(message, children)
        self._check_required(message)
        self._open.pop()
        self._next()
        return _frozen(children)

    # ---- Scalars ----

    def _scalar(self, field: Field) -> Any:
        if field.type in _RANGES:
            return self._integer(field)
        if field.type in (Declared.TYPE_FLOAT, Declared.TYPE_DOUBLE):
            return self._float(field)
        if field.type == Declared.TYPE_BOOL:
            return self._boolean()
        if field.type == Declared.TYPE_ENUM:
            return self._enum(field)
        return self._string(field)

    def _integer(self, field: Field) -> int:
        start = self.token
        negative = self._minus()
        if self.token.kind != INTEGER:
            raise self._expected("an integer", f'for "{field.name}"', start)
        value = self._natural(self._next())
        value = -value if negative else value
        least, most = _RANGES[field.type]
        if not least <= value <= most:
            raise self._error(f'{value} is out of range for "{field.name}", which takes {least} to {most}', start)
        return value

    def _float(self, field: Field) -> float:
        start = self.token
        negative = self._minus()
        token = self.token
        if token.kind == FLOAT or (token.kind == INTEGER and (token.text == "0" or token.text[0] != "0")):
            value = float(self._next().text.rstrip("fF"))
        elif token.kind == INTEGER:
            raise self._error(f'expected a decimal number for "{field.name}", found "{token.text}"', start)
        elif token.kind == NAME and token.text.lower() in ("inf", "infinity", "nan"):
            value = float(self._next().text)
        else:
            raise self._expected("a number", f'for "{field.name}"', start)
        return -value if negative else value

    def _boolean(self) -> bool:
        token = self.token
        if token.kind == NAME and token.text in _BOOLEANS:
            return _BOOLEANS[self._next().text]
        if token.kind == INTEGER and self._natural(token) in (0, 1):
            return bool(self._natural(self._next()))
        raise self._expected("true or false")

    def _enum(self, field: Field) -> int:
        values = field.descriptor.enum_type.values_by_name
        start = self.token
        if self.token.kind == NAME:
            word = self._next().text
            if word in values:
                return values[word].number
            owner, additions = self._open[-1][0].DESCRIPTOR, forks().additions()
            dialects = additions.values.get((owner.full_name, field.name, word), ())
            names = [*values, *self._added_values(owner.full_name, field.name)]
            known = did_you_mean(word, names) or f"; it is one of {', '.join(names)}"
            hint = f"; {advice}" if (advice := additions.advise(word, dialects)) else known
            error = self._error(f'"{field.name}" has no value "{word}"{hint}', start)
            raise ForkFault(error.message, error.where, "value", word, dialects, owner.name) if dialects else error
        negative = self._minus()
        if self.token.kind != INTEGER:
            advice = ""
            if self.token.kind == STRING and self.token.text[1:-1] in values:
                advice = "; leave out the quotes"
            elif self.token.kind == STRING and field.descriptor.full_name == "caffe.V1LayerParameter.type":
                advice = '; a quoted layer type belongs in "layer", not "layers"'
            raise self._expected(f"a name such as {list(values)[-1]}", f'for "{field.name}"', start, advice)
        number = self._natural(self._next())
        number = -number if negative else number
        if number not in field.descriptor.enum_type.values_by_number:
            raise self._error(f'"{field.name}" has no value of number {number}', start)
        return number

    def _string(self, field: Field) -> str | bytes:
        start = self.token
        if start.kind != STRING:
            advice = "; put it in quotes" if start.kind in (NAME, INTEGER, FLOAT) else ""
            if field.descriptor.full_name == "caffe.LayerParameter.type" and start.text in _V1_TYPES:
                advice = '; an unquoted layer type belongs in "layers", the older format'
            raise self._expected("a string", f'for "{field.name}"', start, advice)
        value = b""
        while self.token.kind == STRING:
            value += self.lexer.unquote(self._next())
        if field.type == Declared.TYPE_BYTES:
            return value
        try:
            return value.decode()
        except UnicodeDecodeError:
            raise self._error(f'the string for "{field.name}" is not UTF-8', start) from None

    def _natural(self, token: Token) -> int:
        text = token.text
        if len(text) > _LONGEST:
            raise self._error(f"a number of {len(text):,} digits is out of range", token)
        if text[:2] in ("0x", "0X"):
            return int(text, 16)
        if text[0] != "0":
            return int(text)
        try:
            return int(text, 8)
        except ValueError:
            raise self._error(f'"{text}": a number that begins with 0 is octal', token) from None

    def _minus(self) -> bool:
        if self._at("-"):
            self._next()
            return True
        return False

    # ---- Tokens ----

    def _at(self, symbol: str) -> bool:
        return self.token.kind == SYMBOL and self.token.text == symbol

    def _next(self) -> Token:
        token = self.token
        self.token = next(self._tokens)
        return token

    # ---- Errors ----

    def _check_required(self, message: Message) -> None:
        if message.IsInitialized():
            return
        for field in fields_of(message.DESCRIPTOR).values():
            if field.required and not field.present(message):
                token = self._open[-1][1]
                raise self._error(f'{message.DESCRIPTOR.name} lacks the required field "{field.name}"', token)

    def _unclosed(self, name: str, token: Token, closing: str) -> SpecError:
        line = self.lexer.where(token.start).line
        return self._error(f'the file ends inside "{name}" of line {line}; is a "{closing}" missing?')

    def _expected(self, what: str, where: str = "", token: Token | None = None, advice: str = "") -> SpecError:
        token = token or self.token
        if token.kind == END:
            found = "the end of the file"
        elif token.kind == STRING:
            line = token.text.splitlines()[0]
            found = f"the string {token.text if len(line) == len(token.text) < 60 else line[:56] + '...'}"
        else:
            found = f'"{token.text}"'
        return self._error(f"expected {what}{' ' + where if where else ''}, found {found}{advice}", token)

    def _error(self, message: str, token: Token | None = None) -> SpecError:
        position = self.lexer.where((token or self.token).start)
        message += self.lexer.suspicion((token or self.token).start)
        for open_message, _ in reversed(self._open):
            if open_message.DESCRIPTOR.full_name in _LAYERS:
                layer: Any = open_message
                name, kind = layer.name, layer.type if isinstance(layer.type, str) else ""
                if (name + kind).isprintable():  # with a missing quote, they extend over several lines
                    position = replace(position, layer=name, type=kind)
                break
        return SpecError(message, position)

    def _unknown_field(self, message: Message, token: Token) -> SpecError:
        """Return the error for an unknown field, with a suggestion if possible.

        It is a ForkFault, unless the cause seems to be a bracket, a quotation mark or the kind of file.
        """
        descriptor, name = message.DESCRIPTOR, token.text
        additions = forks().additions()
        dialects = additions.fields.get((descriptor.full_name, name), ())
        fault = f'{descriptor.name} has no field "{name}"'
        elsewhere = "" if dialects else self._elsewhere(message, name)
        hint = f"; {additions.advise(name, dialects)}" if dialects else self._meant(message, name)
        error = self._error(fault + (elsewhere or hint), token)
        if elsewhere or self.lexer.suspicion(token.start):
            return error
        new = forks().new
        own = f"{'' if hint else ';'} {new}" if new else ""
        if hint[-1:] not in ("", "?") or all(outer.DESCRIPTOR.full_name not in _LAYERS for outer, _ in self._open):
            own = ""
        return ForkFault(error.message + own, error.where, "field", name, dialects, descriptor.name)

    def _elsewhere(self, message: Message, name: str) -> str:
        """Return a message that a field belongs to another message or file; else ""."""
        inner = self._open[-1][1]
        for outer, _ in reversed(self._open[:-1]):
            if name in fields_of(outer.DESCRIPTOR):
                line = self.lexer.where(inner.start).line
                return f', but {outer.DESCRIPTOR.name} has; is a "}}" missing for "{inner.text}" of line {line}?'
        other, kind = _OTHER_FILE.get(message.DESCRIPTOR.full_name, (message, ""))
        if kind and name in fields_of(other.DESCRIPTOR):
            return f", but {other.DESCRIPTOR.name} has; is this file a {kind}?"
        if kind and name == _LABEL_MAP:
            return ": this file is a label map, a list of classes; name the net's own file"
        return ""

    def _meant(self, message: Message, name: str) -> str:
        """Return a suggestion: a similar field, or the message that this field belongs to; else ""."""
        known = fields_of(message.DESCRIPTOR)
        if close := did_you_mean(name, known):
            return close
        messages = {n: f.descriptor.message_type for n, f in known.items() if f.type == Declared.TYPE_MESSAGE}
        inside = [n for n, message_type in messages.items() if name in fields_of(message_type)]
        if inside:
            return f"; it belongs in {' or '.join(inside)}"
        return ""


def _frozen(children: Children) -> dict[str, tuple[Position, ...]]:
    return {name: tuple(nodes) for name, nodes in children.items()}
