"""Parses the part of the .proto language in which dialects declare their additions, into descriptors.

It supports messages, enums inside or outside messages, optional, repeated and required fields with ``default`` and
``packed``, and ``extend``.
"""

from __future__ import annotations

import re

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)

from netspec.errors import SpecError, Where

_TOKEN = re.compile(
    r"""(?P<skip> (?: \s+ | //[^\n]* | /\*.*?\*/ )+ )
      | (?P<word> [A-Za-z_.][\w.]* | -?[0-9.][\w.+]* (?: (?<=[eE])-[0-9]+ )? | -(?:inf|nan) | "[^"\n]*" | [{}\[\]=;,] )
      | (?P<wrong> . )
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


def read_declarations(source: str, file: str, package: str) -> FileDescriptorProto:
    """Return the descriptor of declarations in a package, as additions to caffe.proto.

    Types are kept as written, for a descriptor pool to resolve. Raises SpecError for a syntax error.
    """
    return _Declarations(source, file).read(package)


class _Declarations:
    """A recursive descent parser; ``self.next`` is the index of the next word."""

    def __init__(self, source: str, file: str) -> None:
        self.source, self.file = source, file
        self.words = [match for match in _TOKEN.finditer(source) if not match["skip"]]
        self.next = 0

    def read(self, package: str) -> FileDescriptorProto:
        result = FileDescriptorProto(name=self.file, package=package, syntax="proto2", dependency=["caffe.proto"])
        while self.next < len(self.words):
            word = self._take()
            if word == "message":
                self._message(result.message_type.add())
            elif word == "enum":
                self._enum(result.enum_type.add())
            elif word == "extend":
                extendee = self._take()
                self._take("{")
                while not self._accept("}"):
                    self._field(result.extension.add(extendee=extendee), self._take())
            else:
                raise self._error(f'expected message, enum or extend, found "{word}"')
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
            raise self._error(f'expected optional, repeated or required, found "{label}"')
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
            self._option(result)
            while self._accept(","):
                self._option(result)
            self._take("]")
        self._take(";")

    def _option(self, result: FieldDescriptorProto) -> None:
        option = self._take()
        if option not in ("default", "packed"):
            raise self._error(f'unknown option "{option}"')
        self._take("=")
        value = self._take()
        if option == "packed":
            result.options.packed = value == "true"
        elif value.lower().startswith(("0x", "-0x")):
            result.default_value = str(int(value, 0))
        else:
            result.default_value = value[1:-1] if value.startswith('"') else value

    def _integer(self) -> int:
        word = self._take()
        try:
            return int(word, 0)
        except ValueError:
            raise self._error(f'expected an integer, found "{word}"') from None

    def _accept(self, text: str) -> bool:
        found = self.next < len(self.words) and self.words[self.next].group() == text
        self.next += found
        return found

    def _take(self, expected: str = "") -> str:
        if self.next == len(self.words):
            raise self._error("the declarations end too early", len(self.source))
        match = self.words[self.next]
        self.next += 1
        if match["wrong"]:
            raise self._error(f'unexpected character "{match.group()}"')
        if expected and match.group() != expected:
            raise self._error(f'expected "{expected}", found "{match.group()}"')
        return match.group()

    def _error(self, message: str, start: int | None = None) -> SpecError:
        """Return the error at a place in the source, by default that of the last word."""
        start = self.words[self.next - 1].start() if start is None else start
        line = self.source.count("\n", 0, start) + 1
        return SpecError(message, Where(self.file, line, start - self.source.rfind("\n", 0, start)))
