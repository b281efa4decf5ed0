"""How the commands of all programs read their arguments, log, and exit.

Arguments are read as gflags reads them: one dash or two, ``-flag value`` or ``-flag=value``. A Boolean flag is
``-flag``, ``-noflag``, ``-flag=true`` or ``-flag=false``; it never takes the next argument. The log goes to stderr in
glog's format; glog's own flags ``-minloglevel``, ``-logtostderr`` and ``-alsologtostderr`` are known. Every error is
one line.
"""

from __future__ import annotations

import argparse
import inspect
import logging
import os
import re
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

from netspec import log
from netspec.errors import SpecError, did_you_mean, printable
from netspec.files.limits import amount, is_out_of_memory, memory
from netspec.terminal.output import logging_to

DONE, FAULT, WRONG_USAGE = 0, 1, 2  # exit statuses; a signal's is 128 + its number: 130, 143
SOMETHING, UNREADABLE = 1, 2  # of commands that compare or advise: there is something to say; a file cannot be read
SEVERITIES = (logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)  # glog's 0 to 3
CAFFES_LOG = logging.INFO, log.GlogFormatter()
VARIABLE = "GLOG_minloglevel"
# Flags that gflags gives every command of Caffe, and glog's: each is taken; what has no effect is said in a line.
_CAFFES_COMMANDS = ("train", "test", "time", "device_query")
_CAFFES_FLAGS = ("gpu", "solver", "model", "phase", "level", "stage", "snapshot", "weights", "iterations")
_CAFFES_FLAGS += ("sigint_effect", "sighup_effect")
_GLOGS_FLAGS = (
    "v",
    "vmodule",
    "stderrthreshold",
    "logbuflevel",
    "logbufsecs",
    "max_log_size",
    "log_link",
    "logfile_mode",
)
_GLOGS_SWITCHES = ("colorlogtostderr", "log_prefix", "stop_logging_if_full_disk", "log_backtrace_at")
TRUE, FALSE = ("true", "t", "yes", "y", "1"), ("false", "f", "no", "n", "0")
Function = Callable[[argparse.Namespace], "int | None"]  # a command
# Lines of a table of commands (Commands.read).
_COMMAND = re.compile(r"(\S+)((?: \S+)*) {2,}(.*)")
_ARGUMENT = re.compile(r"  (\[?)([\w-]+)(?:=(\S*?))?(\.\.\.|\+)?(!?)\]?(?: (\S+))?(?: {2,}(.*))?")
_SEVERAL: dict[str, dict[str, Any]] = {
    "...": {"action": "append", "default": []},
    "+": {"action": "extend", "nargs": "+", "default": []},
}


class WrongUsage(Exception):
    """Arguments that contradict each other."""


def refuse(arguments: argparse.Namespace, options: Iterable[str], reason: str) -> None:
    """Raise WrongUsage if one of the options, named as in the namespace, was typed; ``reason`` ends the sentence."""
    for name in options:
        if name in arguments.given:
            raise WrongUsage(f"--{arguments.given[name]} {reason}")


def program(name: str, description: str) -> argparse.ArgumentParser:
    """Return the parser of a program, which has ``--version``; its commands are added with :class:`Commands`."""
    made = _Parser(prog=name, description=description)
    made.add_argument("-help", action="help", help=argparse.SUPPRESS)
    made.add_argument("--version", "-version", nargs=0, action=_Version, help="show the version and exit")
    return made


class Commands:
    """The commands of a parser, each with the options that all of them share; ``quiet`` ones show only warnings.

    ``heading`` is that of the commands to come in the program's help. ``types`` reads the values of options by the word
    that stands for them in a table, ``shared`` has lines of tables by name.
    """

    types: ClassVar[Mapping[str, Callable[[str], Any]]] = {}
    shared: ClassVar[Mapping[str, str]] = {}

    def __init__(self, parser: argparse.ArgumentParser, quiet: bool = False) -> None:
        self.heading = "commands"
        self._log = (logging.WARNING, logging.Formatter("warning: %(message)s")) if quiet else CAFFES_LOG
        self._groups: dict[str, list[str]] = {}
        self._parser = parser
        self._parser.formatter_class = _Overview
        self._parsers = parser.add_subparsers(
            dest="command", required=True, metavar="COMMAND", parser_class=_GflagsParser
        )

    def group(self, name: str, summary: str) -> argparse.ArgumentParser:
        """Return the parser of a command that has commands of its own."""
        self._list(name, summary)
        return self._parsers.add_parser(name, help=summary, description=summary)

    def _list(self, name: str, summary: str) -> None:
        self._groups.setdefault(self.heading, []).append(f"  {name:25} {summary}")
        groups = ("\n".join((f"{heading}:", *lines)) for heading, lines in self._groups.items())
        self._parser.epilog = "\n\n".join([*groups, "Every command takes -q, for warnings and errors only."])

    def read(self, table: str, functions: Mapping[str, Any]) -> dict[str, argparse.ArgumentParser]:
        """Add the commands of a table, and return them: ``bug-report`` is run by the function ``_bug_report``.

        The docstring of that function, where it has one, is the command's description. A table looks like this::

            check quiet         a command: its name, words for :meth:`add`, its summary
              file FILE         an argument: its name, a word for its value, its help; ``[file]`` may be left out,
                                ``file...`` is several, ``[file...]`` any number; a line may go on like this
              --weights! FILE   an option that must be given
              --level=0 LEVEL   one with a default; ``--nan=stop {stop|warn}`` has these choices
              --shape... BLOB   one that may be repeated; ``--blob+ BLOB`` takes several values too
              --json            a Boolean flag
              @device @state    the lines of these names in ``shared``
            look:               the commands behind it are those of the group ``look``
        """
        added: dict[str, argparse.ArgumentParser] = {}
        group = self
        for line in re.sub(r"\n {8,}", " ", self._with_shared(table)).splitlines():
            if command := _COMMAND.fullmatch(line):
                name, how, summary = command.groups()
                if name.endswith(":"):
                    group = type(self)(self.group(name[:-1], summary))
                    continue
                function = functions[f"_{name.replace('-', '_')}"]
                added[name] = group.add(name, function, summary, *how.split())
                if function.__doc__:
                    added[name].description = inspect.cleandoc(function.__doc__)
                    added[name].formatter_class = argparse.RawDescriptionHelpFormatter
            else:
                self._add_argument(added[name], line)
        return added

    def _with_shared(self, table: str) -> str:
        """Return a table with the shared lines that it names."""

        def lines(match: re.Match[str]) -> str:
            return "\n".join(self._with_shared(self.shared[name[1:]]) for name in match[0].split())

        return re.sub(r"^  @.*$", lines, table.strip("\n"), flags=re.MULTILINE)

    def _add_argument(self, parser: argparse.ArgumentParser, line: str) -> None:
        match = _ARGUMENT.fullmatch(line)
        assert match, line
        optional, name, default, several, required, value, text = match.groups()
        if value is None:
            parser.add_argument(name, action="store_true", help=text)
            return
        options: dict[str, Any] = {"help": text or argparse.SUPPRESS, "type": self.types.get(value), "default": default}
        options |= {"choices": value[1:-1].split("|")} if value.startswith("{") else {"metavar": value}
        if name.startswith("-"):
            options |= {"required": bool(required), **_SEVERAL.get(several, {})}
        elif optional or several:
            options["nargs"] = ("*" if optional else "+") if several else "?"
        parser.add_argument(name, **options)

    def add(self, name: str, function: Function, summary: str, *how: str) -> argparse.ArgumentParser:
        """Return the parser of a new command that runs ``function``, to add its own arguments to; ``how`` is unused.

        An argument with ``action="store_true"`` is a Boolean flag in all spellings of gflags. A command that shows no
        log itself sets the default ``log_form`` to None, one whose faults are no FAULT sets ``fault_status``.
        ``begin`` is called before ``function``.
        """
        self._list(name, summary)
        added = self._parsers.add_parser(name, help=summary, description=summary)
        level, form = self._log
        added.set_defaults(prog=added.prog, run=function, log_level=level, log_form=form, fault_status=FAULT)
        added.set_defaults(begin=lambda arguments: None)
        added.add_argument("--minloglevel", type=int, choices=range(4), help=argparse.SUPPRESS)
        added.add_argument("-q", dest="minloglevel", action="store_const", const=1, help=argparse.SUPPRESS)
        for name in ("--logtostderr", "--alsologtostderr"):  # it always does
            added.add_argument(name, action="store_true", help=argparse.SUPPRESS)
        added.add_argument("--log_dir", help=argparse.SUPPRESS)
        return added

    def table(self, commands: Iterable[Sequence[Any]]) -> None:
        """Add commands: name, function, a line, rows of arguments (:func:`declare`), perhaps a text below its help."""
        for name, function, summary, rows, *below in commands:
            added = self.add(name, function, summary)
            declare(added, rows)
            if below:
                added.epilog, added.formatter_class = below[0], argparse.RawDescriptionHelpFormatter


def declare(to: Any, rows: Iterable[Any]) -> None:
    """Add arguments to a parser or a group of it, one for each row: words, type, default, help.

    words    as the help shows them: PLACE, [PLACE] that may be left out, PLACE... of which there are several, --flag,
             --option VALUE. Their name is that in lower case
    type     a function of the text; bool for a flag; a tuple of choices; [function] for what may be repeated
    default  ``...`` for an option that must be given

    A text among the rows is the heading of those after it; rows in a list exclude each other.
    """
    group = to
    for row in rows:
        if isinstance(row, str):
            group = to.add_argument_group(row)
        elif isinstance(row, list):
            declare(group.add_mutually_exclusive_group(), row)
        else:
            _add_argument(group, *row)


def _add_argument(group: Any, words: str, kind: Any, default: Any, text: str) -> None:
    name, _, value = words.partition(" ")
    if kind is bool:
        group.add_argument(name, action="store_true", default=bool(default), help=text)
        return
    how: dict[str, Any] = {"choices": kind} if isinstance(kind, tuple) else {"type": kind}
    if isinstance(kind, list):
        how, default = {"type": kind[0], "action": "append", "required": default is ...}, []
    elif default is ...:
        how["required"], default = True, None
    elif isinstance(default, str | int | float) and default not in ("", float("inf")):
        text += f" (default: {default:g})" if isinstance(default, float) else f" (default: {default})"
    if name.startswith("-"):
        group.add_argument(name, default=default, metavar=value or None, help=text, **how)
        return
    place = name.strip("[]").removesuffix("...")
    how["nargs"] = "?" if "[" in name else "+" if name.endswith("...") else None
    group.add_argument(
        place.lower().partition(".")[0], default=default, metavar=None if "choices" in how else place, help=text, **how
    )


def run(parser: argparse.ArgumentParser, words: Sequence[str]) -> int:
    """Parse a command line, run the command, and return its exit status.

    The command finds the line itself in ``command_line``. A SpecError or an OSError becomes one line on stderr and
    status 1. Wrong usage gives status 2, Ctrl-C status 130, SIGTERM 143.
    """
    try:
        arguments = parser.parse_args(words)
    except SystemExit as end:  # argparse has printed the error, or its help
        return int(end.code or DONE)
    arguments.command_line = shlex.join([parser.prog, *words])
    try:
        form, folder = arguments.log_form, arguments.log_dir
        shown = logging_to(_level(arguments), form, folder) if form else nullcontext()
        with interruptible(), shown:
            arguments.begin(arguments)
            return arguments.run(arguments) or DONE
    except SpecError as fault:
        print(fault, file=sys.stderr)
        return arguments.fault_status
    except WrongUsage as fault:
        print(f"{arguments.prog}: error: {fault}", file=sys.stderr)
        return WRONG_USAGE
    except BrokenPipeError:
        return FAULT  # quietly
    except OSError as fault:
        print(f"{fault.filename}: {fault.strerror}" if fault.filename else fault, file=sys.stderr)
        return arguments.fault_status
    except Exception as fault:
        if is_out_of_memory(fault):
            line = f"there is not enough memory: this machine has {amount(memory())}"
        elif not (line := _fault_of_plugin(fault, getattr(arguments, "plugin", None) or ())):
            raise
        print(line, file=sys.stderr)
        return FAULT
    except KeyboardInterrupt as end:
        print("interrupted", file=sys.stderr)
        return 128 + int(end.args[0] if end.args else signal.SIGINT)


def _fault_of_plugin(fault: Exception, plugins: Sequence[str]) -> str:
    """Return a line for a fault that a user's file of layers raised, and "" for another."""
    files = {os.path.abspath(plugin) for plugin in plugins}
    for frame in reversed(traceback.extract_tb(fault.__traceback__)):
        if frame.filename in files:
            text = printable(" ".join(str(fault).split()))
            return f"{os.path.relpath(frame.filename)}:{frame.lineno}: in {frame.name}: {type(fault).__name__}: {text}"
    return ""


class Interrupted(KeyboardInterrupt):
    """An interrupt by a signal, its number.

    Where a KeyboardInterrupt itself passes through C code that runs Python source, as some modules do when they are
    imported, Python notes it for good, and ends by SIGINT in the end though it was caught (Py_RunMain).
    """


@contextmanager
def interruptible() -> Iterator[None]:
    """Make SIGTERM interrupt the block as Ctrl-C does: an Interrupted with the signal's number.

    A second of either ends the process at once. Signals that the program around it handles or ignores are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in before.items() if _is_usual(handler)}
    came: list[int] = []

    def interrupt(number: int, _: object) -> None:
        if came:
            os._exit(128 + number)
        came.append(number)
        raise Interrupted(number)

    try:
        for number in before:
            signal.signal(number, interrupt)
        yield
    except Exception:
        if came:  # what is imported meanwhile may make another error of it
            raise Interrupted(*came) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_usual(handler: object) -> bool:
    """Say whether a signal has no handler but Python's own, or that of a program that starts (``end_at_once``)."""
    return handler in (signal.SIG_DFL, signal.default_int_handler) or getattr(handler, "__name__", "") == "end_at_once"


class _Parser(argparse.ArgumentParser):
    """A parser that knows no abbreviations, and says what a mistyped command was meant to be."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, allow_abbrev=False, **options)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            hint = did_you_mean(value, list(action.choices)) or f"; see {self.prog} --help"
            self.error(f'there is no command "{value}"{hint}')
        super()._check_value(action, value)


class _GflagsParser(_Parser):
    """The parser of a command: it accepts the spellings of gflags, and keeps in ``given`` which options were typed."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.register("action", "store_true", _Switch)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = [self._translated(word) for word in self._without_effect(list(args or ()))]
        found, unknown = super().parse_known_args(words, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}{self._meant(unknown)}")
        if hasattr(found, "given"):  # it was the parser of a group: that of the command has noted them
            return found, unknown
        found.given = {
            action.dest: word.partition("=")[0].lstrip("-")
            for word in takewhile(lambda word: word != "--", words)
            if (action := self._option_string_actions.get(word.partition("=")[0]))
        }
        return found, unknown

    def _without_effect(self, words: list[str]) -> Iterator[str]:
        """Give the words, and those of a ``-flagfile``, but for the flags of Caffe and glog that mean nothing here."""
        caffes = _CAFFES_FLAGS if self.prog.split()[-1] in _CAFFES_COMMANDS else ()
        own = {name.lstrip("-") for name in self._option_string_actions}
        while words:
            word = words.pop(0)
            name, equals, value = word.lstrip("-").partition("=")
            if not word.startswith("-") or word == "--" or name in own:
                yield word
                if word == "--":
                    yield from words
                    return
            elif name == "flagfile":
                path = value if equals else words.pop(0) if words else ""
                try:
                    lines = Path(path).read_text("utf-8", "replace").splitlines()
                except OSError as fault:
                    self.error(f"-flagfile {path}: {fault.strerror}")
                words = [line.strip() for line in lines if line.strip().startswith("-")] + words
            elif name in _GLOGS_FLAGS + caffes or name.removeprefix("no") in _GLOGS_SWITCHES:
                if not equals and name in _GLOGS_FLAGS + caffes and words:
                    words.pop(0)
                print(f"{self.prog}: -{name} is a flag of Caffe's or glog's that has no effect here", file=sys.stderr)
            else:
                yield word

    def _meant(self, unknown: Sequence[str]) -> str:
        """Return a hint at the option that is most like the first unknown one."""
        wrong = next((word for word in unknown if word.startswith("-")), "").partition("=")[0].lstrip("-")
        names = [name[2:] for name in self._option_string_actions if name.startswith("--")]
        meant = did_you_mean(wrong, names)
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


class _Overview(argparse.RawDescriptionHelpFormatter):
    """The help of a program: its commands stand in groups, at the end."""

    def _iter_indented_subactions(self, action: argparse.Action) -> Iterator[argparse.Action]:
        return iter(())


class _Version(argparse.Action):
    """Show the version."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        print(f"{parser.prog} {version()}")
        parser.exit()


class _Switch(argparse.Action):
    """A Boolean flag: ``--flag`` and ``--noflag``; ``--no-flag`` and ``--flag``."""

    def __init__(
        self, option_strings: Sequence[str], dest: str, default: bool = False, help: str | None = None
    ) -> None:
        (self.on,) = option_strings
        self.name = self.on[2:]
        self.off = f"--{self.name[3:]}" if self.name.startswith("no-") else f"--no{self.name}"
        super().__init__([self.on, self.off], dest, nargs=0, default=default, help=help)

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        setattr(namespace, self.dest, option_string == self.on)


def _level(arguments: argparse.Namespace) -> int:
    """Return the level of the log: the command's own, or a higher one set by glog's flag or variable."""
    minimum = arguments.minloglevel
    if minimum is None:
        variable = os.environ.get(VARIABLE, "")
        minimum = int(variable) if variable.isdigit() else 0
    return max(arguments.log_level, SEVERITIES[min(minimum, len(SEVERITIES) - 1)])


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


DISTRIBUTION = "netspec-caffe"
UNKNOWN = "unknown"


def version(distribution: str = DISTRIBUTION) -> str:
    """Return the version of an installed distribution, "unknown" where it is not installed."""
    from importlib import metadata  # which takes a while

    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:  # the source is used without being installed
        return UNKNOWN
