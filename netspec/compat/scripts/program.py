"""Runs a script or a module like Python itself, with netspec as ``caffe``."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import runpy
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from netspec.compat.scripts import finder
from netspec.compat.scripts.python2 import fault_of_python2
from netspec.errors import SpecError
from netspec.files.kinds import unreadable

_OURS = (__file__, runpy.__file__, "<frozen runpy>")
_ALIASES = {  # which NumPy removed in version 1.24
    **{"bool": bool, "int": int, "float": float, "complex": complex, "object": object},
    **{"str": str, "unicode": str, "long": int},
}


def run_script(path: str, arguments: Sequence[str]) -> None:
    """Run a script. If it fails, the process ends as Python does, with its exit status and traceback.

    Raises SpecError if the file cannot be read, or is Python 2.
    """
    try:
        source = Path(path).read_bytes()
    except OSError as fault:
        raise SpecError(f"{path}: {unreadable(path, fault)}") from None
    _prepare_program(os.path.dirname(os.path.realpath(path)), [path, *arguments])
    main = ModuleType("__main__")
    main.__file__ = os.path.abspath(path)
    sys.modules["__main__"] = main
    _run(lambda: exec(compile(source, str(main.__file__), "exec", dont_inherit=True), main.__dict__))


def run_module(name: str, arguments: Sequence[str]) -> None:
    """Run a module as ``python -m`` does; of a package, its ``__main__``. Ends as :func:`run_script` does.

    Raises SpecError if there is no such module, or if it is Python 2.
    """
    _prepare_program(os.getcwd(), ["-m", *arguments])
    try:
        found = importlib.util.find_spec(name)
    except ImportError as fault:
        raise SpecError(f"-m {name}: {fault}") from None
    if found is None:
        raise SpecError(f"-m {name}: no such module")
    _run(lambda: runpy.run_module(name, run_name="__main__", alter_sys=True))


def _prepare_program(folder: str, arguments: list[str]) -> None:
    """Set the folder from which the program imports modules first, and its arguments; prepare for ``import caffe``."""
    # Replace the folder of the console script; ``python -m netspec`` has already removed its own.
    of_command = [os.path.dirname(os.path.abspath(sys.argv[0]))]
    sys.path[: int(sys.path[:1] == of_command)] = [folder]
    sys.argv = arguments
    _prepare()
    _let_workers_prepare()
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if callable(signal.getsignal(number)):  # netspec's own
            signal.signal(number, usual)


def _run(program: Callable[[], object]) -> None:
    try:
        program()
    except SystemExit:
        raise
    except BaseException as fault:
        if of_python2 := fault_of_python2(fault):
            raise of_python2 from None
        trace = fault.__traceback__
        while trace is not None and trace.tb_frame.f_code.co_filename in _OURS:
            trace = trace.tb_next
        sys.excepthook(type(fault), fault.with_traceback(trace), trace)
        if advice := advice_on_dialects(fault):
            print(f"netspec run: {advice}", file=sys.stderr)
        raise SystemExit(130 if isinstance(fault, KeyboardInterrupt) else 1) from None


def advice_on_dialects(fault: BaseException) -> str:
    """Return advice if a message or a field is that of a dialect that is not in use, "" otherwise."""
    unknown = re.search(r'has no (?:field named )?"(\w+)"', str(fault))
    if not unknown:
        return ""
    additions = importlib.import_module("netspec.proto.forks").forks().additions()
    return additions.advise(unknown[1], additions.with_field(unknown[1]))


def _prepare() -> None:
    """Let a program import ``caffe``, and give NumPy its removed aliases."""
    import numpy as np

    finder.install()
    for name, kind in _ALIASES.items():
        if name not in vars(np):
            setattr(np, name, kind)


class _Prepared:
    """Prepares the process that unpickles it."""

    def __reduce__(self) -> Any:
        return _prepare, ()


def _let_workers_prepare() -> None:
    """Prepare processes that the program starts by spawn or forkserver too, before they import the program."""
    from multiprocessing import spawn

    own = spawn.get_preparation_data
    spawn.get_preparation_data = lambda name: {"netspec": _Prepared(), **own(name)}
