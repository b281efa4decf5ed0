"""An argparse parser that reads options as gflags does, for the commands of all programs.

Options have one dash or two, ``-flag value`` or ``-flag=value``. A Boolean flag is ``-flag``, ``-noflag``,
``-flag=true`` or ``-flag=false``; it never takes the next argument. Everything else is argparse.
"""

from __future__ import annotations

import argparse
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import takewhile
from typing import Any

from netspec.errors import did_you_mean
from netspec.files.version import version
from netspec.files.whole_file import why_no_folder, why_unwritable
from netspec.terminal.commands import FAULT
from netspec.terminal.output import GlogFormatter

Command = Callable[[argparse.Namespace], int | None]
TRUE, FALSE = ("true", "t", "yes", "y", "1"), ("false", "f", "no", "n", "0")

# Defaults of a command (``parser.set_defaults``) for its log.
CAFFES_LOG = {"log_level": logging.INFO, "log_form": GlogFormatter()}
QUIET = {"log_level": logging.WARNING, "log_form": logging.Formatter("warning: %(message)s")}
NO_LOG = {"log_level": logging.WARNING, "log_form": None}


def program(name: str, description: str) -> Parser:
    """Return the parser of a program, which has ``--version``; :class:`Commands` adds its commands."""
    parser = Parser(prog=name, description=description)
    parser.add_argument("-help", action="help", help=argparse.SUPPRESS)
    parser.add_argument("--version", "-version", nargs=0, action=_Version, help="show the version and exit")
    return parser


class Parser(argparse.ArgumentParser):
    """A parser with gflags' spellings and without abbreviations; it suggests corrections for mistyped words.

    An argument with ``action="store_true"`` is a Boolean flag in all of gflags' spellings. The namespace of a command
    has ``given``: a dict from the names of the typed options in the namespace to their spelling.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, allow_abbrev=False, **options)
        self.register("action", "store_true", _Switch)
        self._has_commands = False

    def add_output(self, *names: str, folder: bool = False, ends: Sequence[str] = ("",), **options: Any) -> None:
        """Add an argument that names a file to write, or a ``folder`` to write into, which is made where it is missing.

        Whether it can be written is checked before the command begins; with ``ends``, the files with these endings.
        """
        action = self.add_argument(*names, **options)

        def check(path: Any) -> str:
            reasons = [why_no_folder(path)] if folder else [why_unwritable(f"{path}{end}") for end in ends]
            return next(filter(None, reasons), "")

        self.set_defaults(outputs={**(self.get_default("outputs") or {}), action.dest: check})

    def add_subparsers(self, **options: Any) -> Any:
        """Add subparsers; from then on they, and not this parser, read gflags' spellings."""
        self._has_commands = True
        return super().add_subparsers(**options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Translate gflags' spellings, then parse as argparse does; an unknown option is an error with a suggestion."""
        if self._has_commands:
            return super().parse_known_args(args, namespace)
        words = [self._translated(word) for word in args or ()]
        found, unknown = super().parse_known_args(words, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}{self._suggestion(unknown)}")
        found.given = {
            action.dest: word.partition("=")[0].lstrip("-")
            for word in takewhile(lambda word: word != "--", words)
            if (action := self._option_string_actions.get(word.partition("=")[0]))
        }
        return found, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            hint = did_you_mean(value, list(action.choices)) or f"; see {self.prog} --help"
            self.error(f'there is no command "{value}"{hint}')
        super()._check_value(action, value)

    def _suggestion(self, unknown: Sequence[str]) -> str:
        """Return a suggestion for the first unknown option."""
        wrong = next((word for word in unknown if word.startswith("-")), "").partition("=")[0].lstrip("-")
        names = [name[2:] for name in self._option_string_actions if name.startswith("--")]
        meant = did_you_mean(wrong, [name for name in names if name[:1] == wrong[:1]])
        return meant.replace('mean "', 'mean "--') if wrong else ""

    def _translated(self, word: str) -> str:
        """Return ``-flag`` as ``--flag``, and a Boolean flag as ``--flag`` or ``--noflag``."""
        if not re.match(r"--?[A-Za-z_]\w", word):  # argparse knows options of one letter; -1 is a number
            return word
        word = word.lstrip("-")
        name, equals, value = word.partition("=")
        switches = {action.name: action for action in self._actions if isinstance(action, _Switch)}
        if name in switches:
            truth = value.lower() if equals else "true"
            if truth not in TRUE + FALSE:
                self.error(f"argument --{name}: found {value!r}, expected true or false")
            return switches[name].on if truth in TRUE else switches[name].off
        if name.startswith("no-") and name[3:] in switches and not equals:
            return switches[name[3:]].off
        return "--" + word


class Commands:
    """The commands of a parser, whose help lists them under headings.

    ``heading`` is the heading for the commands that are added next, and ``defaults`` are their defaults, as for
    ``parser.set_defaults``, for example ``**QUIET``.
    """

    def __init__(self, parser: Parser, **defaults: Any) -> None:
        self.heading = "commands"
        self._parser = parser
        self.defaults = {**CAFFES_LOG, **defaults}
        self._listed: dict[str, list[str]] = {}
        self._subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
        parser.formatter_class = _Overview

    def add_parser(self, name: str, function: Command, *, help: str, **options: Any) -> Parser:
        """Add a command as argparse's ``add_parser`` does, with glog's flags; ``help`` is its description too.

        ``function`` is called with the namespace and returns the exit status, or None for 0. The default ``prepare``,
        if it is set, is called first. ``fault_status`` is the exit status for a fault in the user's files.
        """
        parser = self._add(name, help=help, **options)
        own = {"function": function, "prog": parser.prog}
        parser.set_defaults(**{"prepare": None, "outputs": {}, "fault_status": FAULT, **self.defaults, **own})
        parser.add_argument("--minloglevel", type=int, choices=range(4), help=argparse.SUPPRESS)
        parser.add_argument("-q", dest="minloglevel", action="store_const", const=1, help=argparse.SUPPRESS)
        for flag in ("--logtostderr", "--alsologtostderr"):  # it always does
            parser.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
        parser.add_argument("--log_dir", help=argparse.SUPPRESS)
        return parser

    def add_group(self, name: str, *, help: str) -> Commands:
        """Add a command that has commands of its own; return them."""
        return Commands(self._add(name, help=help), **self.defaults)

    def _add(self, name: str, *, help: str, **options: Any) -> Parser:
        self._listed.setdefault(self.heading, []).append(f"  {name:25} {help}")
        lists = ("\n".join((f"{heading}:", *lines)) for heading, lines in self._listed.items())
        self._parser.epilog = "\n\n".join([*lists, "Every command has -q: log warnings and errors only."])
        return self._subparsers.add_parser(name, help=help, **{"description": help, **options})


class _Overview(argparse.RawDescriptionHelpFormatter):
    """The help of a program, whose epilog lists the commands."""

    def _iter_indented_subactions(self, action: argparse.Action) -> Iterator[argparse.Action]:
        return iter(())


class _Version(argparse.Action):
    """Show the version."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        print(f"{parser.prog} {version()}")
        parser.exit()


class _Switch(argparse.Action):
    """A Boolean flag ``--flag`` with the opposite ``--noflag``; the opposite of ``--no-flag`` is ``--flag``.

    A flag of one letter, such as ``-v``, has no opposite.
    """

    def __init__(
        self, option_strings: Sequence[str], dest: str, default: bool = False, help: str | None = None
    ) -> None:
        (self.on,) = option_strings
        self.name, self.off = self.on.lstrip("-"), self.on
        if self.on.startswith("--"):
            self.off = f"--{self.name[3:]}" if self.name.startswith("no-") else f"--no{self.name}"
        super().__init__(list(dict.fromkeys([self.on, self.off])), dest, nargs=0, default=default, help=help)

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        setattr(namespace, self.dest, option_string == self.on)


def seed(text: str) -> int:
    """Read a seed of random numbers, from 0."""
    value = int(text)
    if not 0 <= value < 2**31:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number from 0 to {2**31 - 1}")
    return value


def above_zero(text: str) -> float:
    """Read a number above 0."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"found {text}, expected a number above 0")
    return value
