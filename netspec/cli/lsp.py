"""``netspec lsp``."""

from __future__ import annotations

import argparse
import sys

from netspec.cli.run import Commands
from netspec.errors import SpecError


def add_to(commands: Commands) -> None:
    """Add the command."""
    summary = "a language server for editors, on standard input and output"
    commands.add("lsp", _serve, summary, quiet=True).set_defaults(log_form=None)


def _serve(arguments: argparse.Namespace) -> None:
    try:
        from netspec.editor.server import make_server
    except ImportError as fault:
        if not (fault.name or "").startswith(("pygls", "lsprotocol")):
            raise
        raise SpecError("the language server needs pygls: pip install pygls, or 'netspec-caffe[lsp]'") from None
    from importlib.metadata import version

    from netspec.editor.messages import Messages

    make_server(version("netspec-caffe")).start_io(Messages(sys.stdin.buffer))  # type: ignore[arg-type]
