"""``netspec fmt``."""

from __future__ import annotations

import argparse
import sys

from netspec.cli.run import Commands
from netspec.errors import SpecError
from netspec.terminal.commands import DONE, FAULT, SOMETHING, UNREADABLE

STDIN = "-"


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("fmt", _fmt, "write prototxt files in one form; comments are kept", quiet=True)
    p.add_argument("files", nargs="+", metavar="FILE", help="a net's or a solver's prototxt; - is standard input")
    p.add_argument("--check", action="store_true", help="write nothing; name the files that would change")


def _fmt(arguments: argparse.Namespace) -> int:
    from netspec.proto.format import format_text
    from netspec.proto.text import text_of

    status = DONE
    for path in arguments.files:
        try:
            text = sys.stdin.read() if path == STDIN else text_of(path)
            formatted = format_text(text, path)
        except SpecError as fault:  # the other files are formatted all the same
            print(fault, file=sys.stderr)
            status = UNREADABLE if arguments.check else max(status, FAULT)
            continue
        if arguments.check:
            status = max(status, _differs(path, text, formatted))
        elif path == STDIN:
            print(formatted, end="")
        elif formatted == text:
            print(f"{path}: was in this form already")
        else:
            _write(path, formatted)
    return status


def _differs(path: str, text: str, formatted: str) -> int:
    """Say where a file would change; return the status."""
    if text == formatted:
        return DONE
    lines = zip(text.split("\n"), formatted.split("\n"), strict=False)
    first = next((k for k, (a, b) in enumerate(lines, 1) if a != b), 1)
    print(f"{path}:{first}:1: netspec fmt would change this line, the first of them")
    return SOMETHING


def _write(path: str, text: str) -> None:
    from netspec.files.whole_file import write_whole

    write_whole(path, text, "surrogateescape")
    print(f"{path}: formatted")
