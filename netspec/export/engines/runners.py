"""Runs exported models with onnxruntime and OpenVINO.

The weights are in a file next to the model. Both libraries map it into memory instead of reading it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, cast

import numpy as np

from netspec import log
from netspec.export.engines.cache import processor
from netspec.export.engines.choice import Choice
from netspec.graph.options import BF16, FP32, ONNXRUNTIME, OPENVINO

_STACK_T_BYTES = 64  # at least the size of the structure stack_t, which is 24


@contextmanager
def signal_stack_kept() -> Iterator[None]:
    """Restore the alternate signal stack of the thread after the block, on Linux; elsewhere do nothing.

    Each ``openvino.Core`` sets such a stack when it loads its CPU plugin, and frees it when it is deleted. If it is
    still in use then, the thread gets the previous one, which may belong to a Core that was deleted earlier. That is
    freed memory, and the next signal that Python handles would end the process.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    library = ctypes.CDLL(None)
    before = ctypes.create_string_buffer(_STACK_T_BYTES)
    library.sigaltstack(None, before)
    try:
        yield
    finally:
        library.sigaltstack(before, None)


MODEL, OPTIMIZED = "net.onnx", "optimized.onnx"
MOST_SHAPES = 4  # the number of input shapes for which a model stays compiled
Arrays = Mapping[str, np.ndarray]


class Unable(Exception):
    """An engine cannot run a net with the given options; the text is the reason."""


def warn_unable(choice: Choice, reason: str) -> None:
    """Warn that torch runs the net instead of the chosen engine, with the reason, if any, and that it uses fp32."""
    if reason:
        log.logger.warning(f"engine {choice.engine}: {reason}; torch runs the net")
    if choice.precision != FP32:
        log.logger.warning(f"precision {choice.precision}: torch runs the net in {FP32}")


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


class Runner(Protocol):
    """An open model."""

    def run(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """Return the outputs by name, for inputs by name."""
        ...


def threads() -> int:
    """Return the number of threads for a pass: as many as torch would use."""
    if torch := sys.modules.get("torch"):
        return torch.get_num_threads()
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class OnnxRuntime:
    """onnxruntime on the CPU. It optimizes a model once for each version and processor."""

    def __init__(self, folder: Path) -> None:
        with _no_telemetry():
            import onnxruntime

        options = self._options(onnxruntime)
        options.intra_op_num_threads = threads()
        options.graph_optimization_level = (
            onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        )  # prepare has already done this
        self._session = onnxruntime.InferenceSession(
            str(folder / OPTIMIZED), options, providers=["CPUExecutionProvider"]
        )
        self._names = [output.name for output in self._session.get_outputs()]
        self._inputs = {given.name for given in self._session.get_inputs()}

    @staticmethod
    def identity() -> dict[str, str]:
        """Return the properties that a prepared model depends on."""
        with _no_telemetry():
            import onnxruntime

        return {"onnxruntime": onnxruntime.__version__, "processor": processor()}

    @classmethod
    def prepare(cls, folder: Path) -> None:
        """Replace the model in a folder by an optimized one."""
        with _no_telemetry():
            import onnxruntime

        options = cls._options(onnxruntime)
        options.optimized_model_filepath = str(folder / OPTIMIZED)
        for key, value in (("file_name", f"{OPTIMIZED}.data"), ("min_size_in_bytes", "1024")):
            options.add_session_config_entry(f"session.optimized_model_external_initializers_{key}", value)
        onnxruntime.InferenceSession(str(folder / MODEL), options, providers=["CPUExecutionProvider"])
        for path in folder.glob(f"{MODEL}*"):
            path.unlink()

    def run(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """See :class:`Runner`."""
        given = {name: np.ascontiguousarray(value) for name, value in inputs.items() if name in self._inputs}
        found: Any = self._session.run(self._names, given)
        return dict(zip(self._names, found, strict=True))

    @staticmethod
    def _options(library: Any) -> Any:
        options = library.SessionOptions()
        options.log_severity_level = 3  # errors
        return options


class OpenVino:
    """OpenVINO on the CPU; a model is compiled for each set of input shapes."""

    def __init__(self, folder: Path, precision: str) -> None:
        with _no_telemetry():
            import openvino
        self._core = openvino.Core()
        if precision == BF16:
            with signal_stack_kept():
                able = self._core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
            if BF16.upper() not in able:
                raise Unable("this CPU has no bf16 instructions")
        self._path, self._precision = folder / MODEL, "bf16" if precision == BF16 else "f32"
        self._compiled: OrderedDict[tuple[Any, ...], Any] = OrderedDict()

    @staticmethod
    def identity() -> dict[str, str]:
        """Return the properties that a prepared model depends on."""
        with _no_telemetry():
            import openvino
        return {"openvino": openvino.__version__}

    @staticmethod
    def prepare(folder: Path) -> None:
        """Do nothing: OpenVINO reads the exported model."""

    def run(self, inputs: Arrays) -> dict[str, np.ndarray]:
        """See :class:`Runner`."""
        key = tuple((name, value.shape) for name, value in sorted(inputs.items()))
        if key not in self._compiled:
            self._compiled[key] = self._compile(inputs)
            if len(self._compiled) > MOST_SHAPES:
                self._compiled.popitem(last=False)
        self._compiled.move_to_end(key)
        request, wanted, outputs = self._compiled[key]
        given = {name: np.ascontiguousarray(value) for name, value in inputs.items() if name in wanted}
        found = request.infer(given, share_inputs=True)
        return {name: np.array(found[name]) for name in outputs}

    def _compile(self, inputs: Arrays) -> tuple[Any, set[str], list[str]]:
        model = self._core.read_model(str(self._path))
        wanted = {given.any_name for given in model.inputs}
        outputs = [name for output in model.outputs for name in output.names]
        model.reshape({name: list(value.shape) for name, value in inputs.items() if name in wanted})
        settings = {
            "INFERENCE_PRECISION_HINT": self._precision,
            "INFERENCE_NUM_THREADS": threads(),
            "PERFORMANCE_HINT": "LATENCY",
        }
        with signal_stack_kept():
            compiled = self._core.compile_model(model, "CPU", settings)
        return compiled.create_infer_request(), wanted, outputs


RUNNERS: dict[str, type[OnnxRuntime] | type[OpenVino]] = {ONNXRUNTIME: OnnxRuntime, OPENVINO: OpenVino}


def open_runner(engine: str, folder: Path, precision: str) -> Runner:
    """Return a runner for the model in a folder. Raises Unable if its library cannot run it."""
    try:
        if engine == OPENVINO:
            return OpenVino(folder, precision)
        if precision == BF16:
            raise Unable(f"{engine} does not support bf16 here")
        return OnnxRuntime(folder)
    except Unable:
        raise
    except Exception as fault:  # each library has its own
        raise Unable(reason(fault)) from None


def reason(fault: Exception) -> str:
    """Return the message of a library's exception as one short line."""
    text = " ".join(str(fault).split()) or type(fault).__name__
    return text if len(text) <= 200 else f"{text[:197]}..."
