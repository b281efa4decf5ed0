"""Sphinx directives that write the reference from the code: ``commands``, ``layers``, ``fields``."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shapes
from docutils import nodes
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "netspec" / "proto" / "caffe.proto"
BLOB = re.compile(r"((?:bottom|top|blob)s?\[[^\]]*\](?:\.\.)?|(?:bottom|top|blob)s)\s{2,}(.*)")
CELL = r"\|"  # a bar within a cell of a table
FIELD = re.compile(r"(optional|repeated|required) ([\w.]+) (\w+) = \d+(?: \[([^\]]*)\])?;(?:\s*// (.*))?")


class FromCode(SphinxDirective):
    """A directive whose argument names what is shown, and whose text is Markdown that code writes."""

    required_arguments = 1

    def markdown(self, name: str) -> str:
        """Return the text."""
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        """Parse the text in place of the directive, at each build anew, since code may have changed."""
        self.env.note_reread()
        return self.parse_text_to_nodes(self.markdown(self.arguments[0]), allow_section_headings=True)


class CommandReference(FromCode):
    """All commands of a program, with what ``--help`` says of their arguments."""

    def markdown(self, name: str) -> str:
        """Return a section for each command."""
        from importlib import import_module

        parser = import_module(f"{name.replace('-', '_')}.cli").parser()
        lines = []
        for command, made in _commands(parser):
            lines += [f"## {name} {command}", "", _prose(made.description or ""), ""]
            lines += ["| | |", "|---|---|", *_options(made), ""]
        return "\n".join(lines)


class LayerReference(FromCode):
    """All layer types, or those of a dialect, with their docstrings."""

    def markdown(self, name: str) -> str:
        """Return a section for each layer type."""
        from netspec.layers import layer_class, layer_types

        lines = []
        for kind in layer_types():
            lines += [f"## {kind}", "", *_described(inspect.getdoc(layer_class(kind)) or ""), ""]
            if example := shapes.examples().get(kind):
                lines += [f'<figure class="shapes">{shapes.picture(kind, example)}</figure>', ""]
                lines += ["```prototxt", example.text.rstrip(), "```", ""]
            message = _message_of(kind)
            if message:
                lines += [f"Its fields, `{message[0]}`:", "", _table(message[1]), ""]
        return "\n".join(lines)


class FieldReference(FromCode):
    """The fields of a message of Caffe's schema."""

    def markdown(self, name: str) -> str:
        """Return a table."""
        return _table(name)


def _described(text: str) -> list[str]:
    """Return a layer's docstring as Markdown: what comes before its blobs, a table of its blobs, what comes after."""
    lines, rows = [], []
    for line in text.splitlines():
        if found := BLOB.match(line):
            rows.append([found[1], found[2]])
            if len(rows) == 1:
                lines.append(rows)
        elif rows and line.startswith("  "):
            rows[-1][1] += f" {line.strip()}"
        elif line.startswith("Caffe: "):
            lines += ["", f"Caffe: {line.removeprefix('Caffe: ')}"]
        else:
            lines.append(line)
    done = []
    for line in lines:
        if isinstance(line, list):
            cells = (f"| `{name}` | {_prose(words).replace('|', CELL)} |" for name, words in line)
            done += ["", "| blob | |", "|---|---|", *cells, ""]
        else:
            done.append(_prose(line))
    return done


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield all commands, those of commands too."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command, made in action.choices.items():
                inner = list(_commands(made))
                yield from ((f"{command} {name}", parser) for name, parser in inner) if inner else [(command, made)]


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the rows of a table of a command's arguments."""
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction) or action.help is argparse.SUPPRESS:
            continue
        words = [f"`{word}`" for word in action.option_strings if not word.startswith("--no")]
        if action.nargs != 0 and not isinstance(action, argparse.BooleanOptionalAction):
            shown = action.metavar or (",".join(map(str, action.choices)) if action.choices else action.dest.upper())
            words[-1:] = [f"{words[-1]} `{shown}`" if words else f"`{shown}`"]
        text = parser._get_formatter()._expand_help(action) if action.help else ""
        yield f"| {', '.join(words)} | {_prose(text).replace('|', CELL)} |".replace("NAME|FILE", f"NAME{CELL}FILE")


def _message_of(kind: str) -> tuple[str, str] | None:
    """Return the field of LayerParameter that holds a layer type's parameters, and its message."""
    wanted = f"{kind}Parameter".lower()
    for _, message, name, _, _ in _fields("LayerParameter"):
        if message.lower() == wanted:
            return name, message
    return None


def _fields(message: str) -> list[tuple[str, ...]]:
    found = re.search(rf"^message {message} \{{$(.*?)^\}}$", SCHEMA.read_text(), re.M | re.S)
    if found is None:
        raise LookupError(f"{SCHEMA.name} has no message {message}")
    return [match.groups(default="") for match in FIELD.finditer(found[1])]


def _table(message: str) -> str:
    rows = ["| field | type | default | |", "|---|---|---|---|"]
    for label, kind, name, options, comment in _fields(message):
        default = re.search(r"default = (\S+)", options)
        many = "any number of " if label == "repeated" else ""
        value = f"`{default[1].rstrip(',')}`" if default else ""
        rows.append(f"| `{name}` | {many}{kind} | {value} | {_prose(comment).replace('|', CELL)} |")
    return "\n".join(rows)


def _prose(text: str) -> str:
    """Return text of a docstring or a comment as Markdown."""
    return re.sub(r"([*_<>\[\]])", r"\\\1", text.replace("``", "`")) if "`" not in text else text.replace("``", "`")


def setup(app: Any) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("commands", CommandReference)
    app.add_directive("layers", LayerReference)
    app.add_directive("fields", FieldReference)
    return {"parallel_read_safe": True}
