"""Formats protobuf text: two spaces per level, one field per line, with its comments.

A message that was written on one line stays on one line if it fits. The spelling of values does not change. Only the
syntax is checked, so unknown fields are allowed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from netspec.errors import SpecError
from netspec.proto.lexer import END, FLOAT, INTEGER, NAME, STRING, SYMBOL, Lexer, Token

WIDTH = 120  # of a line, in characters
INDENT = "  "
DEEPEST = 100  # maximum nesting of messages in protobuf
_CLOSING = {"{": "}", "<": ">"}


def format_text(text: str, file: str) -> str:
    """Return the formatted text; ``file`` is its name in errors. Raises SpecError for text that is not protobuf text.

    Only spaces, line ends, separators, brackets and quotation marks change, but not the meaning. Formatting
    again changes nothing.
    """
    fields, rest = _Parser(text, file).read()
    lines = [*_block(fields, ""), *_comments(rest, "")]
    while lines and not lines[0]:
        del lines[0]
    return "".join(f"{line}\n" for line in lines)


@dataclass
class _Field:
    """A field. Its value is the tokens after the colon, or the fields of a message.

    ``before`` are the comment lines before it, with "" for a blank line. ``opening`` is the comment after
    the "{", ``end`` are the comment lines before the "}", and ``after`` is the comment after the field.
    """

    name: str
    words: list[str] = field(default_factory=list)
    fields: list[_Field] | None = None
    is_list: bool = False
    before: list[str] = field(default_factory=list)
    opening: str = ""
    end: list[str] = field(default_factory=list)
    after: str = ""
    one_line: bool = False


# ---- Reading ----


class _Parser:
    """A recursive descent parser; ``self.token`` is the next token, ``self.gap`` the comments before it."""

    def __init__(self, text: str, file: str) -> None:
        self.lexer = Lexer(text, file)
        self.tokens = iter(self.lexer)
        self.depth = 0
        self.last_end = 0
        self.token = Token(SYMBOL, "", 0)
        self.trailing = ""  # the comment after the last token, on its line
        self.lines: list[str] = []  # the comment and blank lines before the next token
        self._next()

    def read(self) -> tuple[list[_Field], list[str]]:
        """Return the fields of a file, and the comments at its end."""
        before, self.trailing = [self.trailing] if self.trailing else [], ""
        self.lines = before + self.lines
        fields = self._fields(None)
        return fields, self.lines

    def _next(self) -> Token:
        """Consume the next token, and record the comments after it."""
        token = self.token
        self.token = next(self.tokens)
        gap = self.lexer.text[self.last_end : self.token.start]
        self.last_end = self.token.start + len(self.token.text)
        same_line, *lines = gap.split("\n")
        self.trailing = _clean(same_line) if lines or self.token.kind == END else ""
        self.lines = []
        last = len(lines) - 1
        for k, line in enumerate(lines):
            comment = _clean(line)
            if comment:
                self.lines.append(comment)
            elif k < last and self.lines[-1:] != [""]:
                self.lines.append("")
        return token

    def _fields(self, closing: str | None) -> list[_Field]:
        found: list[_Field] = []
        while self.token.kind != END if closing is None else not self._at(closing):
            found += self._field()
        return found

    def _field(self) -> Iterator[_Field]:
        if self.token.kind != NAME:
            raise self._expected("a field name")
        before = self._take_lines()
        name = self._next()
        colon = self._at(":")
        if colon:
            before += self._odd()
            self._next()
        before += self._odd()
        if self._at("{") or self._at("<"):
            yield self._finished(self._message(name, before))
        elif not colon:
            raise self._expected('":" or "{"')
        elif self._at("["):
            yield from self._list(name, before)
        else:
            one = _Field(name.text, self._scalar(before), before=before)
            yield self._finished(one)

    def _message(self, name: Token, before: list[str]) -> _Field:
        self.depth += 1
        if self.depth > DEEPEST:
            raise SpecError(f"messages are nested more than {DEEPEST} deep", self.lexer.where(self.token.start))
        opening = self._next()
        one = _Field(name.text, before=before, opening=self.trailing)
        self.trailing = ""
        one.fields = self._fields(_CLOSING[opening.text])
        one.end = self._take_lines()
        lines = "\n" in self.lexer.text[opening.start : self.token.start]
        one.one_line = not lines
        self._next()
        self.depth -= 1
        return one

    def _list(self, name: Token, before: list[str]) -> Iterator[_Field]:
        """Read a list; messages in it become fields of their own."""
        self._next()
        values: list[str] = []
        messages: list[_Field] = []
        while not self._at("]"):
            before += self._odd()
            if self._at("{") or self._at("<"):
                messages.append(self._message(name, before))
                before = []
            else:
                values.append(" ".join(self._scalar(before)))
            before += self._odd()
            if self._at(","):
                self._next()
                if self._at("]"):
                    raise self._expected("a value")
            elif not self._at("]"):
                raise self._expected('"," or "]"')
        before += self._odd()
        self._next()
        if messages and values:
            raise SpecError("found messages and other values in one list", self.lexer.where(name.start))
        if not messages:
            yield self._finished(_Field(name.text, values, is_list=True, before=before))
            return
        messages[0].before += before
        yield from messages[:-1]
        yield self._finished(messages[-1])

    def _scalar(self, before: list[str]) -> list[str]:
        words = []
        if self.token.kind == STRING:
            words.append(_quoted(self._next().text))
            while self.token.kind == STRING:
                before += self._odd()
                words.append(_quoted(self._next().text))
            return words
        sign = ""
        if self._at("-"):
            self._next()
            before += self._odd()
            sign = "-"
        if self.token.kind not in (NAME, INTEGER, FLOAT):
            raise self._expected("a value")
        return [sign + self._next().text]

    def _finished(self, one: _Field) -> _Field:
        """Skip a separator, and record the comment after the field."""
        if self._at(",") or self._at(";"):
            kept = self._odd()
            self._next()
            one.before += kept
        if self.trailing and one.after:
            one.before.append(self.trailing)
        else:
            one.after = one.after or self.trailing
        self.trailing = ""
        return one

    def _take_lines(self) -> list[str]:
        lines, self.lines = self.lines, []
        return lines

    def _odd(self) -> list[str]:
        """Return the comments inside a field, which move above it."""
        found = [line for line in (self.trailing, *self._take_lines()) if line]
        self.trailing = ""
        return found

    def _at(self, symbol: str) -> bool:
        return self.token.kind == SYMBOL and self.token.text == symbol

    def _expected(self, what: str) -> SpecError:
        found = "the end of the file" if self.token.kind == END else f"{self.token.text.splitlines()[0][:60]!r}"
        message = f"expected {what}, found {found}{self.lexer.suspicion(self.token.start)}"
        return SpecError(message, self.lexer.where(self.token.start))


def _clean(gap: str) -> str:
    """Return the comment in a part of a line between tokens, or an empty text."""
    return gap.strip(" \t\r\v\f") if "#" in gap else ""


def _quoted(text: str) -> str:
    """Return a string in double quotes, unless it contains double quotes."""
    inner = text[1:-1]
    return f'"{inner}"' if text[0] == "'" and '"' not in inner and "\\'" not in inner else text


# ---- Writing ----


def _block(fields: list[_Field], indent: str) -> Iterator[str]:
    for k, one in enumerate(fields):
        above = one.before[1:] if k == 0 and one.before[:1] == [""] else one.before
        yield from _comments(above, indent, at_end=False)
        yield from _lines(one, indent)


def _comments(lines: list[str], indent: str, at_end: bool = True) -> Iterator[str]:
    """Return comment lines and single blank lines, but no blank lines at the end of a message."""
    kept = list(lines)
    while at_end and kept and not kept[-1]:
        kept.pop()
    previous = None
    for line in kept:
        if line or previous != "":
            yield indent + line if line else ""
        previous = line


def _lines(one: _Field, indent: str) -> Iterator[str]:
    after = f"  {one.after}" if one.after else ""
    short = _on_one_line(one)
    if one.fields is None:
        text = f"{indent}{short}"
        if one.is_list and len(text) > WIDTH:
            yield from _filled(one, indent, after)
        else:
            yield text + after
    elif short and len(indent + short) <= WIDTH:
        yield f"{indent}{short}{after}"
    else:
        yield f"{indent}{one.name} {{" + (f"  {one.opening}" if one.opening else "")
        yield from _block(one.fields, indent + INDENT)
        yield from _comments(one.end if one.fields else one.end[one.end[:1] == [""] :], indent + INDENT)
        yield f"{indent}}}{after}"


def _on_one_line(one: _Field) -> str:
    """Return a field on one line; "" for a message that needs several lines."""
    if one.fields is None:
        return f"{one.name}: [{', '.join(one.words)}]" if one.is_list else f"{one.name}: {' '.join(one.words)}"
    inner = [_on_one_line(each) for each in one.fields]
    has_comments = one.opening or one.end or any(each.before or each.after for each in one.fields)
    if not one.one_line or has_comments or not all(inner):
        return ""
    return f"{one.name} {{ {' '.join(inner)} }}" if inner else f"{one.name} {{ }}"


def _filled(one: _Field, indent: str, after: str) -> Iterator[str]:
    """Return a list, on several lines if necessary."""
    line = f"{indent}{one.name}: ["
    yield line + after
    line = indent + INDENT
    for k, word in enumerate(one.words):
        piece = word + ("," if k < len(one.words) - 1 else "")
        if line.strip() and len(line) + 1 + len(piece) > WIDTH:
            yield line
            line = indent + INDENT
        line += (" " if line.strip() else "") + piece
    yield line
    yield f"{indent}]"
