"""Runs a script or a module like Python itself, with netspec's ``caffe`` available."""

from __future__ import annotations

import builtins
import importlib.util
import linecache
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, NoReturn

from netspec.compat.scripts import finder, old_names, sources
from netspec.errors import SpecError


@dataclass(frozen=True)
class Options:
    """How to run a program: whether to replace a real Caffe, and whether it is always Python 2."""

    shadow: bool = False
    python2: bool = False


def run_script(path: str, arguments: Sequence[str], options: Options) -> NoReturn:
    """Run a script. The process ends like the script, with its exit status and traceback.

    Raises SpecError if the file cannot be read.
    """
    data = sources.bytes_of(path)
    reader = _prepare(os.path.dirname(os.path.realpath(path)), options)
    sys.argv = [path, *arguments]
    path = os.path.abspath(path)
    main = ModuleType("__main__")
    main.__dict__.update(__file__=path, __cached__=None, __builtins__=builtins)
    _execute(data, main, path, reader)


def run_module(name: str, arguments: Sequence[str], options: Options) -> NoReturn:
    """Run a module as ``python -m`` does; of a package, its ``__main__``. Ends as :func:`run_script` does.

    Raises SpecError where there is no such module.
    """
    reader = _prepare(os.getcwd(), options)
    sys.argv = ["-m", *arguments]
    try:
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.submodule_search_locations is not None:
            spec = importlib.util.find_spec(f"{name}.__main__")
    except ImportError as fault:
        raise SpecError(f"-m {name}: {fault}") from None
    if spec is None or spec.origin is None:
        raise SpecError(f"-m {name}: no such module, or it cannot be run")
    path = spec.origin
    sys.argv[0] = path
    main = ModuleType("__main__")
    main.__dict__.update(__file__=path, __cached__=None, __builtins__=builtins, __spec__=spec, __package__=spec.parent)
    _execute(Path(path).read_bytes(), main, path, reader)


def _prepare(folder: str, options: Options) -> sources.Reader:
    # Replace the folder of the console script; ``python -m netspec`` has already removed its own.
    of_program = [os.path.dirname(os.path.abspath(sys.argv[0]))]
    sys.path[: int(sys.path[:1] == of_program)] = [folder]
    reader = sources.Reader(folder, options.python2)
    _make_ready(reader, options.shadow)
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if callable(signal.getsignal(number)):  # netspec's own; a program's workers are ended by SIGTERM
            signal.signal(number, usual)
    return reader


def _execute(data: bytes, main: ModuleType, path: str, reader: sources.Reader) -> NoReturn:
    """Run a file's bytes as ``__main__``, and end."""
    sys.modules["__main__"] = main
    status = 0
    try:
        code = reader.main_code(data, path)
    except SyntaxError as fault:
        _show(fault, None)
        raise SystemExit(1) from None
    try:
        main.__dict__["__builtins__"] = sources.builtins_for(path)
        exec(code, main.__dict__)
    except SystemExit:
        raise
    except BaseException as fault:
        _show(fault, _from(fault.__traceback__, path))
        status = 130 if isinstance(fault, KeyboardInterrupt) else 1
    raise SystemExit(status)


def _from(trace: TracebackType | None, path: str) -> TracebackType | None:
    """Return the part of a traceback that begins in the script; None if it does not reach the script."""
    while trace is not None and trace.tb_frame.f_code.co_filename != path:
        trace = trace.tb_next
    return trace


def _show(fault: BaseException, trace: TracebackType | None) -> None:
    """Print a traceback as Python does, or as the script wants it."""
    fault = fault.with_traceback(trace)
    if sys.excepthook is not sys.__excepthook__:
        sys.excepthook(type(fault), fault, trace)
    else:
        linecache.checkcache()
        traceback.print_exception(type(fault), fault, trace)
    if remedy := old_names.remedy(fault):
        print(f"netspec run: {remedy}", file=sys.stderr)


# Processes that a program starts by spawn or forkserver: each is a new Python process that imports the program


def _make_ready(reader: sources.Reader, shadow: bool, quiet: bool = False) -> None:
    """Prepare this process, and those that it starts, for old programs."""
    old_names.install({"multiprocessing.spawn": lambda spawn: _hand_on(spawn, reader, shadow)}, quiet)
    reader.install()
    finder.install(shadow)  # the last is asked first


def _hand_on(spawn: Any, reader: sources.Reader, shadow: bool) -> None:
    own = spawn.get_preparation_data

    def get_preparation_data(name: str) -> dict[str, Any]:
        data = own(name)
        if data.get("init_main_from_path") == reader.main:
            del data["init_main_from_path"]  # as Python reads it
            data["init_main_from_name"] = sources.MAIN
        return {"netspec": _Prepared(reader, shadow), **data}

    spawn.get_preparation_data = get_preparation_data


class _Prepared:
    """Prepares the process that unpickles it, before that process imports the program."""

    def __init__(self, reader: sources.Reader, shadow: bool) -> None:
        self._arguments = reader, shadow

    def __reduce__(self) -> Any:
        return _prepare_worker, self._arguments


def _prepare_worker(reader: sources.Reader, shadow: bool) -> None:
    reader.quiet = True  # the program's own process has already printed it
    _make_ready(reader, shadow, quiet=True)
