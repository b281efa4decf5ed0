"""``netspec completion``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from netspec.errors import SpecError
from netspec.terminal.parser import NO_LOG, Commands

WORDS = (None, str, Path)  # the types of values that may be names of files


def add_commands(commands: Commands) -> None:
    """Add the commands of this module."""
    _add_completion(commands)


COMPLETION = """Print a script that lets a shell complete netspec's commands.

bash: netspec completion bash > ~/.local/share/bash-completion/completions/netspec
zsh:  netspec completion zsh > a file _netspec in a folder of $fpath
fish: netspec completion fish > ~/.config/fish/completions/netspec.fish"""


def _add_completion(commands: Commands) -> None:
    parser = commands.add_parser(
        "completion",
        help="print a completion script for a shell",
        description=COMPLETION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(function=_completion, **NO_LOG)
    parser.add_argument("shell", choices=["bash", "zsh", "fish"], help="the shell")


def _completion(arguments: argparse.Namespace) -> None:
    from netspec.cli import parser  # imported here, since it imports this module

    try:
        import shtab
    except ImportError:
        raise SpecError("completion needs shtab: pip install shtab, or 'netspec-caffe[completion]'") from None
    made = parser()
    for action in _actions(made):
        if action.nargs != 0 and not action.choices and action.type in WORDS:
            vars(action)["complete"] = shtab.FILE
    print(shtab.complete(made, shell=arguments.shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield the arguments of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
