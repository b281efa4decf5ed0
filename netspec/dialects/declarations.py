"""Parses the part of the .proto language that Caffe and its forks use, into descriptors.

It supports messages, enums inside or outside messages, optional, repeated and required fields with ``default`` and
``packed``, and ``extend``. It is for the additions of forks, which are added at run time.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)

from netspec.errors import SpecError, Where

_TOKEN = re.compile(
    r"""(?P<skip> (?: \s+ | //[^\n]* | /\*.*?\*/ )+ )
      | (?P<token> [A-Za-z_.][\w.]* | -?[0-9.][\w.+]* (?: (?<=[eE])-[0-9]+ )? | -(?:inf|nan) | "[^"\n]*" | [{}\[\]=;,] )
    """,
    re.VERBOSE | re.DOTALL,
)
_LABELS = {
    "optional": FieldDescriptorProto.LABEL_OPTIONAL,
    "required": FieldDescriptorProto.LABEL_REQUIRED,
    "repeated": FieldDescriptorProto.LABEL_REPEATED,
}
_SCALARS = {
    name: FieldDescriptorProto.Type.Value(f"TYPE_{name.upper()}")
    for name in ("double", "float", "int64", "uint64", "int32", "uint32", "bool", "string", "bytes")
}
_INTEGERS = {_SCALARS[name] for name in ("int64", "uint64", "int32", "uint32")}


def read_declarations(source: str, file: str, package: str) -> FileDescriptorProto:
    """Return the descriptor of a .proto source; ``package`` is its default package.

    Types are kept as written, for a descriptor pool to resolve. Raises SpecError for a syntax error.
    """
    return _Declarations(source, file).read(package)


@dataclass(frozen=True)
class _Word:
    text: str
    start: int


class _Declarations:
    def __init__(self, source: str, file: str) -> None:
        self.source = source
        self.file = file
        self.words: list[_Word] = []
        self.next = 0
        position = 0
        while position < len(source):
            match = _TOKEN.match(source, position)
            if match is None:
                raise self._error(f'unexpected character "{source[position]}"', position)
            if match.lastgroup == "token":
                self.words.append(_Word(match.group(), position))
            position = match.end()

    def read(self, package: str) -> FileDescriptorProto:
        result = FileDescriptorProto(name=self.file, package=package, syntax="proto2")
        while self.next < len(self.words):
            word = self._take()
            if word == "syntax":
                self._take("=")
                if self._take() != '"proto2"':
                    raise self._error("expected proto2", self.words[self.next - 1].start)
                self._take(";")
            elif word == "package":
                result.package = self._take()
                self._take(";")
            elif word == "import":
                result.dependency.append(self._take().strip('"'))
                self._take(";")
            elif word == "message":
                self._message(result.message_type.add())
            elif word == "enum":
                self._enum(result.enum_type.add())
            elif word == "extend":
                extendee = self._take()
                self._take("{")
                while not self._accept("}"):
                    self._field(result.extension.add(extendee=extendee), self._take())
            else:
                raise self._error(f'expected message, enum or extend, found "{word}"', self.words[self.next - 1].start)
        return result

    def _message(self, result: DescriptorProto) -> None:
        result.name = self._take()
        self._take("{")
        while not self._accept("}"):
            word = self._take()
            if word == "enum":
                self._enum(result.enum_type.add())
            elif word == "message":
                self._message(result.nested_type.add())
            else:
                self._field(result.field.add(), word)

    def _enum(self, result: EnumDescriptorProto) -> None:
        result.name = self._take()
        self._take("{")
        while not self._accept("}"):
            name = self._take()
            self._take("=")
            result.value.add(name=name, number=self._integer())
            self._take(";")

    def _field(self, result: FieldDescriptorProto, label: str) -> None:
        if label not in _LABELS:
            raise self._error(
                f'expected optional, repeated or required, found "{label}"', self.words[self.next - 1].start
            )
        result.label = _LABELS[label]
        kind = self._take()
        if kind in _SCALARS:
            result.type = _SCALARS[kind]
        else:
            result.type_name = kind
        result.name = self._take()
        self._take("=")
        result.number = self._integer()
        if self._accept("["):
            while True:
                option = self._take()
                self._take("=")
                value = self._take()
                if option == "default":
                    result.default_value = self._default(result.type, value)
                elif option == "packed":
                    result.options.packed = value == "true"
                else:
                    raise self._error(f'unknown option "{option}"', self.words[self.next - 3].start)
                if self._accept("]"):
                    break
                self._take(",")
        self._take(";")

    def _default(self, kind: int, value: str) -> str:
        """Return a default value in the format of descriptors: strings without quotes, integers in decimal."""
        if value.startswith('"'):
            return value[1:-1]
        return str(int(value, 0)) if kind in _INTEGERS and value.lower().startswith(("0x", "-0x")) else value

    def _integer(self) -> int:
        word = self._take()
        try:
            return int(word, 0)
        except ValueError:
            raise self._error(f'expected an integer, found "{word}"', self.words[self.next - 1].start) from None

    def _accept(self, text: str) -> bool:
        if self.next < len(self.words) and self.words[self.next].text == text:
            self.next += 1
            return True
        return False

    def _take(self, expected: str = "") -> str:
        if self.next == len(self.words):
            raise self._error("the declarations end too early", len(self.source))
        word = self.words[self.next]
        if expected and word.text != expected:
            raise self._error(f'expected "{expected}", found "{word.text}"', word.start)
        self.next += 1
        return word.text

    def _error(self, message: str, start: int) -> SpecError:
        line = self.source.count("\n", 0, start) + 1
        return SpecError(message, Where(self.file, line, start - self.source.rfind("\n", 0, start)))
