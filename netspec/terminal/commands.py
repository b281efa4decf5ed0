"""How a command of any program runs: its log, its errors, its exit status, and signals.

The log goes to stderr in glog's format; glog's own flags ``-minloglevel``, ``-logtostderr`` and ``-alsologtostderr``
are accepted. Every error is one line.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext

from netspec.errors import Code, SpecError, Where, printable
from netspec.files.limits import amount, is_out_of_memory, memory
from netspec.files.paths import relative
from netspec.terminal.output import INTERRUPTED, OUT_OF_MEMORY, SEVERITIES, VARIABLE, logging_to

DONE, FAULT, WRONG_USAGE = 0, 1, 2  # exit statuses; a signal's is 128 + its number: 130, 143
SOMETHING, UNREADABLE = 1, 2  # of commands that compare or advise: something was found; a file cannot be read


class WrongUsage(Exception):
    """Arguments that contradict each other."""


def refuse(arguments: argparse.Namespace, options: Iterable[str], reason: str) -> None:
    """Raise WrongUsage if one of the options, named as in the namespace, was typed; ``reason`` ends the sentence."""
    for name in options:
        if name in arguments.given:
            raise WrongUsage(f"--{arguments.given[name]} {reason}")


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
        shown = nullcontext()
        if arguments.log_form:
            shown = logging_to(
                _level(arguments), arguments.log_form, arguments.log_dir, lambda fault: _ending(fault, arguments)[0]
            )
        with shown, interruptible():
            _check_outputs(arguments)
            if arguments.prepare:
                arguments.prepare(arguments)
            return arguments.function(arguments) or DONE
    except (Exception, KeyboardInterrupt) as fault:
        line, status = _ending(fault, arguments)
        if status is None:
            raise
        if line:
            print(line, file=sys.stderr)
        return status


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Raise SpecError if something that the command will write cannot be written: before its work, not after it."""
    for name, why in arguments.outputs.items():
        path = getattr(arguments, name)
        if path is not None and (reason := why(path)):
            raise SpecError(f"cannot be written: {reason}", Where(str(path)), Code.UNWRITABLE, (reason,))


def _ending(fault: BaseException, arguments: argparse.Namespace) -> tuple[str, int | None]:
    """Return the line with which a command ends, "" for none, and its exit status; None: Python prints a traceback."""
    match fault:
        case SpecError():
            return str(fault), arguments.fault_status
        case WrongUsage():
            return f"{arguments.prog}: error: {fault}", WRONG_USAGE
        case BrokenPipeError():
            return "", FAULT
        case OSError():
            return f"{fault.filename}: {fault.strerror}" if fault.filename else str(fault), arguments.fault_status
        case KeyboardInterrupt():
            return INTERRUPTED, 128 + int(fault.args[0] if fault.args else signal.SIGINT)
    if is_out_of_memory(fault):
        return OUT_OF_MEMORY + amount(memory()), FAULT
    if part := _missing_part(fault):
        return f"{part}: is missing from this installation; this command needs it", FAULT
    if line := _fault_of_plugin(fault, getattr(arguments, "plugin", None) or ()):
        return line, FAULT
    return printable(f"{type(fault).__name__}: {fault}"), None


def _missing_part(fault: BaseException) -> str:
    """Return the folder of netspec that a command needs and that is missing; "" for any other error."""
    missing = (fault.name or "").split(".") if isinstance(fault, ModuleNotFoundError) else []
    return "/".join(missing[:2]) if missing[:1] == ["netspec"] and len(missing) > 1 else ""


def _fault_of_plugin(fault: BaseException, plugins: Sequence[str]) -> str:
    """Return the message for an exception that a user's file of layers raised; "" for any other exception."""
    files = {os.path.abspath(plugin) for plugin in plugins}
    for frame in reversed(traceback.extract_tb(fault.__traceback__)):
        if frame.filename in files:
            text = printable(" ".join(str(fault).split()))
            return f"{relative(frame.filename)}:{frame.lineno}: in {frame.name}: {type(fault).__name__}: {text}"
    return ""


class Interrupted(KeyboardInterrupt):
    """An interrupt by a signal; its argument is the number of the signal.

    It is a subclass of KeyboardInterrupt for a reason: some modules run Python source from C code while they are
    imported. If a plain KeyboardInterrupt passes through such code, Python remembers it and ends by SIGINT, even if it
    was caught (Py_RunMain).
    """


@contextmanager
def interruptible() -> Iterator[None]:
    """Make SIGTERM interrupt the block as Ctrl-C does: an Interrupted with the signal's number.

    A second signal ends the process at once. A signal that the caller already handles or ignores is not changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in before.items() if _is_usual(handler)}
    received: list[int] = []

    def interrupt(number: int, _: object) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)
        raise Interrupted(number)

    try:
        for number in before:
            signal.signal(number, interrupt)
        yield
        if received:  # Python loses an exception that is raised in a finalizer
            raise Interrupted(*received)
    except Exception:
        if received:  # a module that was being imported may have turned the interrupt into another error
            raise Interrupted(*received) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_usual(handler: object) -> bool:
    """Return whether a handler is the system's, Python's, or ``end_at_once`` of netspec/terminal/main.py."""
    return handler in (signal.SIG_DFL, signal.default_int_handler) or getattr(handler, "__name__", "") == "end_at_once"


def _level(arguments: argparse.Namespace) -> int:
    """Return the level of the log: the command's own, or a higher one set by glog's flag or environment variable."""
    minimum = arguments.minloglevel
    if minimum is None:
        variable = os.environ.get(VARIABLE, "")
        minimum = int(variable) if variable.isdigit() else 0
    return max(arguments.log_level, SEVERITIES[min(minimum, len(SEVERITIES) - 1)])
