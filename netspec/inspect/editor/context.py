"""In which message of an unfinished text the cursor stands, and which value it is about to write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec.errors import SpecError
from netspec.proto.lexer import END, NAME, STRING, SYMBOL, Lexer, Token
from netspec.proto.schema import Field, NetParameter, SolverParameter, fields_of

LAYERS = ("caffe.LayerParameter", "caffe.V1LayerParameter")


@dataclass(frozen=True)
class Context:
    """``message`` is the descriptor of the message around the cursor, None where a field of it is not known.

    ``field`` is the field whose value is next, None where a field's name is next.
    """

    message: Any
    field: Field | None


def context_at(text: str, offset: int) -> Context:
    """Return what stands around a character of a text, whose rest does not count."""
    message: Any = root_of(text)
    above: list[Any] = []
    name, in_value, in_list = "", False, False
    for token in _tokens(text[:offset]):
        if token.kind == NAME and not in_value:
            name = token.text
        elif token.kind == SYMBOL and token.text == ":":
            in_value = True
        elif token.kind == SYMBOL and token.text in "{<":
            above.append(message)
            field = _field(message, name)
            message = field.descriptor.message_type if field and field.type == Declared.TYPE_MESSAGE else None
            name, in_value, in_list = "", False, False
        elif token.kind == SYMBOL and token.text in "}>":
            message = above.pop() if above else message
            name, in_value = "", False
        elif token.kind == SYMBOL and token.text in "[]":
            in_list = token.text == "["
            in_value = in_list
        elif token.kind != SYMBOL and not in_list:
            in_value = False
    return Context(message, _field(message, name) if in_value else None)


def root_of(text: str) -> Any:
    """Return the descriptor of a net or of a solver: whichever has more of the fields that are not in a message."""
    depth, names = 0, []
    for token in _tokens(text):
        depth += token.text in ("{", "<")
        depth -= token.text in ("}", ">")
        if token.kind == NAME and depth == 0:
            names.append(token.text)
    counts = Counter(kind for kind in (NetParameter, SolverParameter) for n in names if n in fields_of(kind.DESCRIPTOR))
    return max((NetParameter, SolverParameter), key=lambda kind: counts[kind]).DESCRIPTOR


def token_at(text: str, offset: int) -> tuple[str, Token] | None:
    """Return the word or string at a character, and the name of its field (itself, if it is one)."""
    name = ""
    tokens = _tokens(text)
    for k, token in enumerate(tokens):
        following = tokens[k + 1].text if k + 1 < len(tokens) else ""
        if token.kind == NAME and following in (":", "{", "<"):
            name = token.text
        if token.kind in (NAME, STRING) and token.start <= offset < token.start + len(token.text):
            return name, token
    return None


def _field(message: Any, name: str) -> Field | None:
    return fields_of(message).get(name) if message is not None else None


def _tokens(text: str) -> Sequence[Token]:
    """Return the tokens up to the first text that is not a token, such as a string without its closing quote."""
    tokens: list[Token] = []
    with suppress(SpecError):
        tokens.extend(token for token in Lexer(text, "") if token.kind != END)
    return tokens
