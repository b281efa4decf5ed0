"""``netspec completion``: what makes a shell complete commands, options and file names."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from netspec.cli.run import Commands
from netspec.errors import SpecError

SHELLS = ("bash", "zsh", "fish")
WORDS = (None, str, Path)  # the types of values that may be names of files


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("completion", _print, "print a shell's completion")
    p.description = """Print what makes a shell complete the commands of netspec.
    bash: netspec completion bash > ~/.local/share/bash-completion/completions/netspec;
    zsh: netspec completion zsh > a file _netspec in a folder of $fpath;
    fish: netspec completion fish > ~/.config/fish/completions/netspec.fish"""
    p.add_argument("shell", choices=SHELLS, help="the shell")
    p.set_defaults(log_form=None)


def _print(arguments: argparse.Namespace) -> None:
    from netspec.cli import parser  # which makes the parser of all commands, this one among them

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
