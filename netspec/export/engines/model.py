"""A net that onnxruntime or OpenVINO runs on the CPU: exported once, kept in the cache, and opened.

The weights are in a file next to the model. Both libraries map it into memory instead of reading it.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np

from netspec import log
from netspec.errors import SpecError
from netspec.export.engines.cache import entry
from netspec.export.engines.choice import Choice
from netspec.graph.options import BF16, FP32, ONNXRUNTIME, OPENVINO

MODEL, WARNINGS = "net.onnx", "warnings.txt"  # the warnings of the export, which are logged at each opening
Arrays = Mapping[str, np.ndarray]
Export = Callable[[Path], None]  # writes the ONNX model to a path, with its weights in the same folder
Runner = Callable[[Arrays], dict[str, np.ndarray]]  # returns the outputs by name, for inputs by name


class Unable(Exception):
    """An engine cannot run a net with the given options; the text is the reason."""


def warn_unable(choice: Choice, reason: str) -> None:
    """Warn that torch runs the net instead of the chosen engine, with the reason, if any, and that it uses fp32."""
    if reason:
        log.logger.warning(f"engine {choice.engine}: {reason}; torch runs the net")
    if choice.precision != FP32:
        log.logger.warning(f"precision {choice.precision}: torch runs the net in {FP32}")


class Model:
    """A net, exported to an engine, and kept in the cache by ``key`` (cache.py), unless that is empty.

    ``export`` is called if the cache does not have the model. Its warnings are kept, and logged again each time the
    model is opened. Raises Unable for a net that the engine cannot run, and SpecError for a file that cannot be read.
    """

    def __init__(self, choice: Choice, key: str, export: Export) -> None:
        self._engine = choice.engine
        self._temporary: tempfile.TemporaryDirectory[str] | None = None  # if it is not in the cache
        self.folder = self._make_folder(choice.cache, key, export)
        for line in (self.folder / WARNINGS).read_text("utf-8").splitlines():
            log.logger.warning(line)
        self._reduced = choice.precision != FP32  # the difference from fp32 was not logged yet
        try:
            self._run = self._open(choice.precision)
        except Unable as fault:
            if not self._reduced:
                raise
            log.logger.warning(f"precision {choice.precision}: {fault}; {self._engine} runs it in {FP32}")
            self._run, self._reduced = self._open(FP32), False

    def run(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """Return the outputs, float32 by name, for inputs by name. The first pass in bf16 logs its difference.

        Raises Unable if the library fails, or if an input is empty: OpenVINO may end the process then.
        """
        with _unable():
            if not all(value.size for value in inputs.values()):
                raise Unable("an input is empty")
            found = self._run(inputs)
            if self._reduced:
                self._reduced = False
                for name, exact in self._open(FP32)(inputs).items():
                    worst = np.abs(found[name] - exact).max(initial=0) / (np.abs(exact).max(initial=0) or 1)
                    log.logger.warning(f"precision bf16: {name} differs from fp32 by {worst:.1e} of its largest value")
            return found

    def _open(self, precision: str) -> Runner:
        with _unable():
            return OPENERS[self._engine](self.folder / MODEL, precision)

    def _make_folder(self, cache: Path | None, key: str, export: Export) -> Path:
        """Return the folder with the exported model: from the cache if it is there, otherwise a new one."""

        def make(folder: Path) -> None:
            try:
                with log.held_back() as records:
                    export(folder / MODEL)
            except SpecError as fault:
                raise Unable(str(fault)) from None
            lines = [record.getMessage() for record in records if record.levelno == logging.WARNING]
            (folder / WARNINGS).write_text("\n".join(lines), "utf-8", "backslashreplace")

        if cache is not None and key:
            try:
                return entry(cache, key, make)
            except OSError as fault:
                log.logger.warning(f"{cache}: cannot be written: {fault.strerror}; the exported model will not be kept")
        self._temporary = tempfile.TemporaryDirectory(prefix="netspec-", ignore_cleanup_errors=True)
        make(Path(self._temporary.name))
        return Path(self._temporary.name)


def threads() -> int:
    """Return the number of threads for a pass: as many as torch would use."""
    if torch := sys.modules.get("torch"):
        return torch.get_num_threads()
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def onnxruntime_runner(path: Path, precision: str) -> Runner:
    """Return what runs a model by onnxruntime."""
    if precision == BF16:
        raise Unable(f"{ONNXRUNTIME} does not support bf16 here")
    with _no_telemetry():
        import onnxruntime
    options: Any = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # fatal faults; all others are raised too
    options.intra_op_num_threads = threads()
    # Threads that wait in a loop would take the cores from those of a program's other nets.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    wanted = {given.name for given in session.get_inputs()}

    def run(inputs: Arrays) -> dict[str, np.ndarray]:
        found: Any = session.run(names, {n: np.ascontiguousarray(x) for n, x in inputs.items() if n in wanted})
        return dict(zip(names, found, strict=True))

    return run


def openvino_runner(path: Path, precision: str) -> Runner:
    """Return what runs a model by OpenVINO; it is compiled for each set of input shapes."""
    with _no_telemetry():
        import openvino
    core = openvino.Core()
    if precision == BF16:
        with _signal_stack_kept():
            able = core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        if BF16.upper() not in able:
            raise Unable("this CPU has no bf16 instructions")
    settings = {
        "INFERENCE_PRECISION_HINT": "bf16" if precision == BF16 else "f32",
        "INFERENCE_NUM_THREADS": threads(),
        "PERFORMANCE_HINT": "LATENCY",
    }

    @lru_cache(4)
    def compiled(shapes: tuple[tuple[str, tuple[int, ...]], ...]) -> tuple[Any, Container[str], list[str]]:
        model = core.read_model(str(path))
        wanted = {given.any_name: given.partial_shape for given in model.inputs}
        outputs = [name for output in model.outputs for name in output.names]
        made = {name: openvino.PartialShape(list(shape)) for name, shape in shapes if name in wanted}
        for name, shape in made.items():
            if not wanted[name].compatible(shape):  # reshape would change sizes that other parts of the model are for
                raise Unable(f"input {name} has shape {shape} there, expected {wanted[name]}")
        model.reshape(made)
        with _signal_stack_kept():
            return core.compile_model(model, "CPU", settings).create_infer_request(), wanted, outputs

    def run(inputs: Arrays) -> dict[str, np.ndarray]:
        request, wanted, outputs = compiled(tuple((name, value.shape) for name, value in sorted(inputs.items())))
        given = {name: np.ascontiguousarray(value) for name, value in inputs.items() if name in wanted}
        found = request.infer(given, share_inputs=True)
        return {name: np.array(found[name]) for name in outputs}

    return run


OPENERS: dict[str, Callable[[Path, str], Runner]] = {ONNXRUNTIME: onnxruntime_runner, OPENVINO: openvino_runner}


@contextmanager
def _unable() -> Iterator[None]:
    """Raise the exceptions of the block as Unable, with their message as one short line."""
    try:
        yield
    except Unable:
        raise
    except Exception as fault:  # each library has its own
        text = " ".join(str(fault).split()) or type(fault).__name__
        raise Unable(text if len(text) <= 200 else f"{text[:197]}...") from None


@contextmanager
def _no_telemetry() -> Iterator[None]:
    """Within the block, import a library without telemetry: no network access, and no file in the home folder.

    OpenVINO uses an empty stub if its telemetry package is missing. onnxruntime reads a variable when it is imported.
    """
    module, variable = "openvino_telemetry", "ORT_DISABLE_TELEMETRY"
    before, chosen = sys.modules.get(module), os.environ.get(variable)
    sys.modules[module] = cast(ModuleType, None)
    os.environ[variable] = chosen or "1"
    try:
        yield
    finally:
        del sys.modules[module]
        if before is not None:
            sys.modules[module] = before
        if chosen is None:
            del os.environ[variable]


@contextmanager
def _signal_stack_kept() -> Iterator[None]:
    """Restore the alternate signal stack of the thread after the block, on Linux; elsewhere do nothing.

    Each ``openvino.Core`` sets such a stack when it loads its CPU plugin, and frees it when it is deleted. If it is
    still in use then, the thread gets the previous one, which may belong to a Core that was deleted earlier. That is
    freed memory, and the next signal that Python handles would end the process.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    library = ctypes.CDLL(None)
    before = ctypes.create_string_buffer(64)  # more than the structure stack_t, which has 24 bytes
    library.sigaltstack(None, before)
    try:
        yield
    finally:
        library.sigaltstack(before, None)
