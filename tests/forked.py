"""Runs programs in processes in which torch and our modules are imported already. That saves most of the start."""

import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from multiprocessing.process import BaseProcess
from pathlib import Path
from subprocess import CompletedProcess

import pytest

PRELOADED = [
    "torch",
    "cv2",
    "scipy.optimize",
    "scipy.stats",
    "matplotlib.pyplot",
    "torch.distributed.run",
    "netspec",
    "netspec.cli",
    "netspec.cli.caffe",
    "lmdb_build.cli",
    "loopclosure.cli",
]


def start(
    function: Callable[..., None],
    *arguments: object,
    folder: Path | str = ".",
    out: Path | str,
    err: Path | str = "",
    environment: Mapping[str, str] | None = None,
) -> BaseProcess:
    """Start ``function(*arguments)``, one of the functions below, in a folder.

    Standard output goes to the file ``out``, and standard error too, or to ``err``.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    files = [Path(out).absolute(), Path(err or out).absolute()]
    usual = multiprocessing.get_start_method()
    process = context.Process(target=_begin, args=(function, arguments, str(folder), files, environment or {}, usual))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")  # before the first one starts, with which the imports are done
        process.start()
    return process


def wait(process: BaseProcess, limit_s: float = 900) -> int | None:
    """Return the exit status of a process, below 0 for a signal; None, and it is ended, if it does not end."""
    process.join(limit_s)
    if process.exitcode is None:
        process.kill()
    return process.exitcode


def run(function: Callable[..., None], *arguments: object, folder: Path, **environment: str) -> CompletedProcess[str]:
    """Run one of the functions below to its end; return its status and what it said."""
    out, err = folder / "out.log", folder / "err.log"
    status = wait(start(function, *arguments, folder=folder, out=out, err=err, environment=environment))
    assert status is not None, f"it does not end: {err.read_text()}"
    return CompletedProcess(str(arguments), status, out.read_text(), err.read_text())


def _begin(
    function: Callable[..., None],
    arguments: Sequence[object],
    folder: str,
    files: Sequence[Path],
    environment: Mapping[str, str],
    usual: str,
) -> None:
    multiprocessing.set_start_method(usual, force=True)  # of processes of its own, as where it is typed
    os.chdir(folder)
    os.environ |= environment
    os.environ["XDG_CACHE_HOME"] = str(Path(".cache").absolute())
    written = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    streams = [os.open(os.devnull, os.O_RDONLY), *(os.open(file, written) for file in files)]
    for descriptor, stream in enumerate(streams):
        os.dup2(stream, descriptor)
    function(*arguments)


def main(module: str, words: Sequence[str]) -> None:
    """Run the main() of a module with the words of a command."""
    sys.argv = list(words)
    sys.exit(import_module(module).main(list(words[1:])))


def program(words: Sequence[str]) -> None:
    """Run netspec as it is started by the name ``words[0]``."""
    from netspec.terminal.main import program as begin

    sys.argv = list(words)
    sys.exit(begin("netspec.cli"))


def script(path: Path, words: Sequence[str]) -> None:
    """Run a Python file with the words behind its name."""
    sys.argv = [str(path), *words]
    sys.path.insert(0, str(path.parent))
    runpy.run_path(str(path), run_name="__main__")


def snippet(text: str) -> None:
    """Run Python source."""
    exec(compile(text, "snippet", "exec"), {"__name__": "__main__"})
