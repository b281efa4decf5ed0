"""Sphinx directives that write the reference from the code: ``commands``, ``layers``, ``api``."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import shapes
from docutils import nodes
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "netspec" / "proto" / "caffe.proto"
BLOB = re.compile(r"((?:bottom|top|blob)s?\[[^\]]*\](?:\.\.)?|(?:bottom|top|blob)s)\s{2,}(.*)")
FIELD = re.compile(r"(optional|repeated|required) ([\w.]+) (\w+) = \d+(?: \[([^\]]*)\])?;(?:\s*// (.*))?")


class FromCode(SphinxDirective):
    """A directive that inserts Markdown written by code; its argument names what to describe."""

    required_arguments = 1

    def markdown(self, name: str) -> str:
        """Return the text."""
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        """Replace the directive by the parsed text, in every build, because the code may have changed."""
        self.env.note_reread()
        return self.parse_text_to_nodes(
            self.markdown(self.arguments[0] if self.arguments else ""), allow_section_headings=True
        )


class CommandReference(FromCode):
    """The commands of a program under some headings of its help, or all commands, in the order of its help."""

    final_argument_whitespace = True

    def markdown(self, name: str) -> str:
        """Return a section for each command: its purpose, its usage, an example from the pages, its options."""
        name, _, headings = name.partition(" ")
        parser = import_module(f"{name.replace('-', '_')}.cli").parser()
        groups = [part.partition(":\n") for part in (parser.epilog or "").split("\n\n")]
        wanted = [
            set(re.findall(r"^  (\S+)", below, re.M)) for title, _, below in groups if not headings or title in headings
        ]
        lines = []
        for command, made in _commands(parser):
            if command.split()[0] not in set().union(*wanted):
                continue
            lines += [f"## {name} {command}", "", *_paragraphs(made.description or ""), ""]
            lines += ["```text", f"{name} {command} {_usage(made)}", "```", ""]
            if example := _example(f"{name} {command}"):
                lines += ["```", example, "```", ""]
            lines += table(("argument", "meaning"), _options(made))
            if made.epilog:
                lines += ["```text", made.epilog, "```", ""]
        return "\n".join(lines)


class LayerReference(FromCode):
    """The layer types in the named packages of netspec.layers."""

    final_argument_whitespace = True

    def markdown(self, name: str) -> str:
        """Return a section for each layer type."""
        from netspec.layers import layer_class, layer_types

        lines = []
        for kind in layer_types():
            if layer_class(kind).__module__.split(".")[2] not in name.split():
                continue
            lines += [f"## {kind}", "", *_described(inspect.getdoc(layer_class(kind)) or ""), ""]
            if example := shapes.examples().get(kind):
                lines += [f'<figure class="shapes">{shapes.picture(kind, example)}</figure>', ""]
                lines += ["```prototxt", example.text.rstrip(), "```", ""]
            message = _message_of(kind)
            if message:
                lines += [f"Its fields, `{message[0]}`:"]
                lines += table(("field", "type", "default", "note"), _rows(message[1]))
        return "\n".join(lines)


class PythonReference(FromCode):
    """Public names of Python, ``module:Name`` each on a line, with their docstrings and those of their methods."""

    required_arguments = 0
    has_content = True

    def markdown(self, name: str) -> str:
        """Return a section for each name."""
        lines: list[str] = []
        for line in self.content:
            module, _, attribute = line.partition(":")
            found = getattr(import_module(module), attribute)
            lines += [f"## {attribute}", "", *_signed(f"{module}.{attribute}", found), ""]
            for method in methods(found):
                made = getattr(found, method)
                shown = f".{method}" if isinstance(made, property) else f".{method}{_arguments(made)}"
                lines += [f"**`{shown}`**", "", *docstring(made), ""]
        return "\n".join(lines)


def methods(found: Any) -> list[str]:
    """Return the public methods and properties that a class itself defines and describes, in their order."""
    if not inspect.isclass(found) or issubclass(found, Exception):
        return []
    return [
        name
        for base in reversed(found.__mro__)
        if base.__module__.startswith(("netspec", "loopclosure"))
        for name, made in vars(base).items()
        if not name.startswith("_")
        and getattr(made, "__doc__", None)
        and (callable(made) or isinstance(made, property))
    ]


def _signed(name: str, found: Any) -> list[str]:
    return ["```text", f"{name}{_arguments(found)}", "```", "", *docstring(found)]


def _arguments(found: Any) -> str:
    """Return the arguments of a function or class, without annotations; the docstrings describe the types."""
    parameters = [p.replace(annotation=inspect.Parameter.empty) for p in inspect.signature(found).parameters.values()]
    shown = [p.replace(default="...") if _is_long(p) else p for p in parameters if p.name != "self"]
    return re.sub(r"='\.\.\.'", "=...", str(inspect.Signature(shown)))


def _is_long(parameter: inspect.Parameter) -> bool:
    return parameter.default is not parameter.empty and len(repr(parameter.default)) > 20


def docstring(found: Any) -> list[str]:
    """Return a docstring as Markdown: examples become Python blocks, lines of two columns a table, roles code."""
    lines: list[str] = []
    rows: list[list[str]] = []
    for line in [*(inspect.getdoc(found) or "").splitlines(), ""]:
        if row := re.fullmatch(r"(\w+(?:, \w+)*)\s{2,}(\S.*)", line):
            rows.append([f"`{row[1]}`", _words(row[2])])
        elif rows and line.startswith("  "):
            rows[-1][1] += f" {_words(line.strip())}"
        else:
            lines += table(("name", "meaning"), rows)
            rows = []
            code = line.startswith("    ")
            lines.append(line if code or not line.strip() else _words(line))
    blocks = re.sub(
        r"((?:^    .*\n|^\n(?=    ))+)",
        lambda b: f"```pycon\n{dedented(b[0])}```\n",
        "\n".join(lines) + "\n",
        flags=re.M,
    )
    return blocks.splitlines()


def dedented(text: str) -> str:
    """Return a block without its indent."""
    return "".join(f"{line[4:]}\n" for line in text.splitlines() if line.strip())


def _words(text: str) -> str:
    return _prose(re.sub(r":\w+:`~?(?:[\w.]+\.)?([\w.]+)`", r"``\1``", text))


def _described(text: str) -> list[str]:
    """Return a layer's docstring as Markdown: the text before its blobs, a table of its blobs, the text after."""
    before: list[str] = []
    rows: list[list[str]] = []
    after: list[str] = []
    for line in text.splitlines():
        if found := BLOB.match(line):
            rows.append([f"`{found[1]}`", _prose(found[2])])
        elif rows and line.startswith("  "):
            rows[-1][1] += f" {_prose(line.strip())}"
        else:
            lines = ["", line] if line.startswith("Caffe: ") else [line]
            (after if rows else before).extend(map(_prose, lines))
    return [*before, *table(("blob", "meaning"), rows), *after]


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a table as lines of Markdown, without empty columns; no lines if there are no rows."""
    rows = list(rows)
    kept = [k for k in range(len(heads)) if any(row[k] for row in rows)]
    lines = [heads, ["---"] * len(heads), *rows] if rows else []
    cells = ([row[k].replace("|", r"\|") for k in kept] for row in lines)
    return ["", *(f"| {' | '.join(row)} |" for row in cells), ""]


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield all commands, including subcommands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command, made in action.choices.items():
                inner = list(_commands(made))
                yield from ((f"{command} {name}", parser) for name, parser in inner) if inner else [(command, made)]


@cache
def _examples() -> list[str]:
    """Return the commands in the pages, each in one line; tests run them."""
    pages = [ROOT / "README.md", *ROOT.glob("*/README.md"), *sorted((ROOT / "docs").glob("*.md"))]
    text = "\n".join(block for page in pages for block in re.findall(r"^```\n(.*?)^```", page.read_text(), re.M | re.S))
    lines = re.sub(r"\s*\\\n\s*", " ", text).splitlines()
    return [re.sub(r"\s+# .*", "", line) for line in lines]


def _example(command: str) -> str:
    """Return an example of a command: the shortest one in the pages that has options."""
    found = [line for line in _examples() if f"{line} ".startswith(f"{command} ") and "$" not in line]
    return min(found, key=lambda line: (" --" not in line, len(line)), default="")


def _paragraphs(text: str) -> list[str]:
    """Return a description as Markdown; lines with two columns become a list."""
    rows = re.sub(r"\n {6,}", " ", text)
    return [re.sub(r"^(--\S+(?: \S+)?)\s{2,}", r"- `\1`: ", _prose(line)) for line in rows.splitlines()]


SHARED = ("plugin", "limit", "verbose")  # options of every command, which come last


def _arguments_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the arguments of a command: its own in order, then those of all commands."""
    shown = [a for a in parser._actions if not isinstance(a, argparse._HelpAction) and a.help is not argparse.SUPPRESS]
    return sorted(shown, key=lambda action: action.dest in SHARED)


def _usage(parser: argparse.ArgumentParser) -> str:
    """Return the positional arguments and the required options of a command."""
    positional, required, more = [], [], []
    for action in _arguments_of(parser):
        if not action.option_strings:
            positional.append(_value(action) if action.required else f"[{_value(action)}]")
        elif action.required:
            required.append(f"{action.option_strings[-1]} {_value(action)}")
        else:
            more = ["[options]"]
    return " ".join([*positional, *required, *more])


def _value(action: argparse.Action) -> str:
    """Return the placeholder of an argument's value, or its choices."""
    return str(action.metavar or (",".join(map(str, action.choices)) if action.choices else action.dest.upper()))


def _options(parser: argparse.ArgumentParser) -> Iterator[list[str]]:
    """Yield the rows of a table of a command's arguments."""
    for action in _arguments_of(parser):
        off = {f"--no{word[2:]}" for word in action.option_strings}
        words = [f"`{word}`" for word in action.option_strings if word not in off]
        if action.nargs != 0:
            words[-1:] = [f"{words[-1]} `{_value(action)}`" if words else f"`{_value(action)}`"]
        yield [", ".join(words), _prose(parser._get_formatter()._expand_help(action) if action.help else "")]


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


def _rows(message: str) -> Iterator[list[str]]:
    for label, kind, name, options, comment in _fields(message):
        default = re.search(r"default = (\S+)", options)
        many = "any number of " if label == "repeated" else ""
        yield [f"`{name}`", f"{many}{kind}", f"`{default[1].rstrip(',')}`" if default else "", _prose(comment)]


def _prose(text: str) -> str:
    """Return text of a docstring or a comment as Markdown."""
    parts = re.split(r"(`[^`]*`)", text.replace("``", "`"))  # code stays as it is
    return "".join(re.sub(r"([*_<>\[\]])", r"\\\1", part) if k % 2 == 0 else part for k, part in enumerate(parts))


def setup(app: Any) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("commands", CommandReference)
    app.add_directive("api", PythonReference)
    app.add_directive("layers", LayerReference)
    return {"parallel_read_safe": True}
