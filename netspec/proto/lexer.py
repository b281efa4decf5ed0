"""Splits protobuf's text format into tokens with their line and column.

Tokens: https://protobuf.dev/reference/protobuf/textformat-spec/. Where the specification is stricter than Caffe's C++
parser (strings over several lines, a number directly before a name), the parser's rules apply.
"""

from __future__ import annotations

import re
import unicodedata
from bisect import bisect_right
from collections.abc import Iterator
from typing import NamedTuple

from netspec.errors import SpecError, Where

NAME, INTEGER, FLOAT, STRING, SYMBOL, END = "name", "integer", "float", "string", "symbol", "end"

_TOKEN = re.compile(
    r"""
    (?P<skip>   (?: [\ \t\r\n\v\f]+ | \#[^\n]* )+ )
  | (?P<name>   [A-Za-z_][A-Za-z0-9_]* )
  | (?P<float>  (?: [0-9]+\.[0-9]* | \.[0-9]+ ) (?: [eE][+-]?[0-9]+ )? [fF]?
              | [0-9]+ [eE][+-]?[0-9]+ [fF]?
              | [0-9]+ [fF] )
  | (?P<integer> 0[xX][0-9a-fA-F]+ | [0-9]+ )
  | (?P<string> " [^"\\]* (?: \\. [^"\\]* )* " | ' [^'\\]* (?: \\. [^'\\]* )* ' )
  | (?P<symbol> [{}<>\[\]:;,\-] )
    """,
    re.VERBOSE | re.DOTALL,
)
_ESCAPE = re.compile(r"\\(?:([0-7]{1,3})|[xX]([0-9a-fA-F]{1,2})|u([0-9a-fA-F]{4})|U([0-9a-fA-F]{8})|(.))", re.DOTALL)
_PLACEHOLDER = re.compile(r"\$?\{+ *[A-Za-z_][\w.]* *\}+|\$[A-Za-z_]\w*|@[A-Za-z_]\w*@|%(?:\([A-Za-z_]\w*\))?[dfrs]\b")
_COMMENT = re.compile(r"//|/\*|\*/|<!--|--|%")  # as other languages write it
_SIMPLE_ESCAPES = {"a": 7, "b": 8, "f": 12, "n": 10, "r": 13, "t": 9, "v": 11, "\\": 92, "?": 63, "'": 39, '"': 34}


class Token(NamedTuple):
    """A token: its kind, its spelling, and the position of its first character in the text."""

    kind: str
    text: str
    start: int


class Lexer:
    """The tokens of a text, one after the other, ending with one of kind END.

    Bytes that are not UTF-8 must be decoded with ``surrogateescape``; in comments they are allowed.
    """

    def __init__(self, text: str, file: str) -> None:
        """``file`` is the file name for the positions of tokens and for errors."""
        self.text = text
        self.file = file
        self._long_strings: list[Token] = []
        self._lines = [0, *(m.end() for m in re.finditer("\n", text))]

    def __iter__(self) -> Iterator[Token]:
        """Yield the tokens. Raises SpecError for text that is not a token."""
        position, text = 0, self.text
        while position < len(text):
            match = _TOKEN.match(text, position)
            if match is None:
                raise self._unexpected(position)
            kind = match.lastgroup or ""
            if kind != "skip":
                token = Token(kind, match.group(), position)
                if kind == STRING and "\n" in token.text:
                    self._long_strings.append(token)
                yield token
            position = match.end()
        yield Token(END, "", position)

    def where(self, start: int) -> Where:
        """Return the position of a character."""
        line = bisect_right(self._lines, start)
        return Where(self.file, line, start - self._lines[line - 1] + 1)

    def suspicion(self, start: int) -> str:
        """Return a hint for an error at a placeholder, at a comment, or after a string over several lines; else "".

        If a closing quote is missing, the string continues to the next opening quote, and the error appears there.
        """
        if found := _PLACEHOLDER.match(self.text, start):
            return f"; is this file a template? replace {found[0]} with a value"
        if _COMMENT.match(self.text, start):
            return "; a comment begins with #"
        for token in reversed(self._long_strings):
            end = token.start + len(token.text)
            if token.start < start and self.where(start).line <= self.where(end).line + 1:
                line = self.where(token.start).line
                return f"; is the closing quote of the string in line {line} missing?"
        return ""

    def unquote(self, token: Token) -> bytes:
        """Return the value of a STRING token, with escapes resolved."""
        inner = token.text[1:-1]
        offset = token.start + 1
        pieces: list[bytes] = []
        done = 0
        for match in _ESCAPE.finditer(inner):
            pieces.append(self._utf8(inner[done : match.start()], offset + done))
            pieces.append(self._escape(match, offset + match.start()))
            done = match.end()
        pieces.append(self._utf8(inner[done:], offset + done))
        return b"".join(pieces)

    def _escape(self, match: re.Match[str], start: int) -> bytes:
        octal, hexadecimal, short, long, simple = match.groups()
        if octal or hexadecimal:
            return bytes([int(octal, 8) & 255 if octal else int(hexadecimal, 16)])
        if short or long:
            code = int(short or long, 16)
            if code > 0x10FFFF or 0xD800 <= code <= 0xDFFF:
                raise SpecError(f"{match.group()} is not a Unicode character", self.where(start))
            return chr(code).encode()
        if simple not in _SIMPLE_ESCAPES:
            raise SpecError(
                f"unknown escape {match.group()!r} in a string; write a backslash as \\\\", self.where(start)
            )
        return bytes([_SIMPLE_ESCAPES[simple]])

    def _utf8(self, piece: str, start: int) -> bytes:
        try:
            return piece.encode()
        except UnicodeEncodeError as fault:
            raise self._not_utf8(start + fault.start) from None

    def _not_utf8(self, position: int) -> SpecError:
        byte = ord(self.text[position]) & 255
        return SpecError(f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8 text", self.where(position))

    def _unexpected(self, position: int) -> SpecError:
        character = self.text[position]
        if character in "\"'":
            fault = f"string without a closing quote{self.suspicion(position)}"
            return SpecError(fault, self.where(position))
        if "\udc80" <= character <= "\udcff":
            return self._not_utf8(position)
        if character.isspace() or unicodedata.category(character) == "Cf":  # of zero width
            name = unicodedata.name(character, "character").lower()
            fault = f"unexpected {name} (0x{ord(character):02x}); replace it with an ordinary space"
            return SpecError(fault, self.where(position))
        if character in "“”„«»‘’‚":
            fault = f'unexpected quotation mark {character}; write strings in straight quotes: "text"'
            return SpecError(fault, self.where(position))
        if not character.isprintable():
            return SpecError(f"unexpected character 0x{ord(character):02x}; is this a text file?", self.where(position))
        fault = f'unexpected character "{character}"{self.suspicion(position)}'
        return SpecError(fault, self.where(position))
