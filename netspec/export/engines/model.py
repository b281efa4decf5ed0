"""A net that an engine runs: exported once, kept in the cache, and opened."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from netspec import log
from netspec.errors import SpecError
from netspec.export.engines.cache import entry, key_of
from netspec.export.engines.choice import Choice
from netspec.export.engines.runners import MODEL, RUNNERS, Arrays, Runner, Unable, open_runner, reason
from netspec.files.paths import inside
from netspec.files.whole_file import write_whole
from netspec.graph.options import FP32

WARNINGS, DIFFERENCE = "warnings.txt", "bf16.txt"  # lines that are logged each time the model is opened
Export = Callable[[Path], None]  # writes the ONNX model to a path, with its weights in the same folder


@dataclass(frozen=True)
class Origin:
    """The origin of a net: its prototxt and weights, and the options that determine what is exported."""

    files: Sequence[str | Path]
    options: Mapping[str, Any] = field(default_factory=dict)


class Model:
    """A net, exported to an engine. If ``origin`` is None, the exported model is not kept in the cache.

    ``export`` is called if the cache does not have the model. Its warnings are kept, and logged again each time the
    model is opened. Raises Unable for a net that the engine cannot run, and SpecError for a file that cannot be read.
    """

    def __init__(self, choice: Choice, origin: Origin | None, export: Export) -> None:
        self.choice = choice
        self._temporary: tempfile.TemporaryDirectory[str] | None = None  # if it is not in the cache
        self.folder = self._make_folder(origin, export)
        self._runner, precision = self._open(choice.precision)
        self._difference_shown = precision == FP32

    def run(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """Return the outputs, float32 by name, for inputs by name.

        Raises Unable if the library fails. In bf16, the first pass measures the difference from fp32.
        """
        found = _run(self._runner, inputs)
        if not self._difference_shown:
            self._difference_shown = True
            self._show_difference(inputs, found)
        return found

    def _make_folder(self, origin: Origin | None, export: Export) -> Path:
        """Return the folder with the exported model: from the cache if it is there, otherwise a new one."""
        runner = RUNNERS[self.choice.engine]
        given = {"engine": self.choice.engine, **runner.identity()}

        def make(folder: Path) -> None:
            with _warnings() as warnings:
                _export(export, folder / MODEL)
            try:
                runner.prepare(folder)
            except Exception as fault:  # each library has its own exceptions
                raise Unable(reason(fault)) from None
            (folder / WARNINGS).write_text("\n".join(warnings), "utf-8", "backslashreplace")

        if self.choice.cache is not None and origin is not None:
            key = key_of(origin.files, {**origin.options, **given})
            try:
                folder, made = entry(self.choice.cache, key, make)
            except OSError as fault:
                where = self.choice.cache
                log.logger.warning(f"{where}: cannot be written: {fault.strerror}; the exported model will not be kept")
            else:
                if not made:
                    _warn_again(folder / WARNINGS)
                return folder
        self._temporary = tempfile.TemporaryDirectory(prefix="netspec-", ignore_cleanup_errors=True)
        folder = Path(self._temporary.name)
        make(folder)
        return folder

    def _open(self, precision: str) -> tuple[Runner, str]:
        try:
            return open_runner(self.choice.engine, self.folder, precision), precision
        except Unable as fault:
            if precision == FP32:
                raise
            log.logger.warning(f"precision {precision}: {fault}; {self.choice.engine} runs it in {FP32}")
            return open_runner(self.choice.engine, self.folder, FP32), FP32

    def _show_difference(self, inputs: Arrays, found: Arrays) -> None:
        """Log the difference of bf16 from fp32. It is measured once, on the first inputs, and kept with the model."""
        path = self.folder / DIFFERENCE
        if path.exists():
            return _warn_again(path)
        exact = _run(open_runner(self.choice.engine, self.folder, FP32), inputs)
        lines = [
            f"precision bf16: {name} differs from fp32 by {_difference(found[name], value):.1e} of its largest value"
            for name, value in exact.items()
        ]
        for line in lines:
            log.logger.warning(line)
        with suppress(SpecError):  # measure it again
            write_whole(inside(self.folder, DIFFERENCE), "\n".join(lines), "backslashreplace")


def _warn_again(path: Path) -> None:
    """Log the lines of a file, which the cache of an older netspec does not have."""
    with suppress(OSError):
        for line in path.read_text("utf-8", "replace").splitlines():
            log.logger.warning(line)


def _run(runner: Runner, inputs: Arrays) -> dict[str, np.ndarray]:
    try:
        return runner.run(inputs)
    except Exception as fault:  # each library has its own exceptions
        raise Unable(reason(fault)) from None


def _export(export: Export, path: Path) -> None:
    try:
        export(path)
    except SpecError as fault:
        raise Unable(str(fault)) from None


def _difference(found: np.ndarray, exact: np.ndarray) -> float:
    if found.shape != exact.shape:
        return float("inf")
    return float(np.abs(found - exact).max(initial=0) / (np.abs(exact).max(initial=0) or 1))


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Yield a list that gets the warnings of the block."""
    warnings: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: warnings.append(record.getMessage()) if record.levelno == logging.WARNING else None
    log.logger.addHandler(handler)
    try:
        yield warnings
    finally:
        log.logger.removeHandler(handler)
