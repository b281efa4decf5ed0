"""The choice of the engine for a net, its precision, and the folder of its model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from netspec.errors import SpecError, check_choice
from netspec.graph.options import ENGINES, FP32, ONNXRUNTIME, OPENVINO, PRECISIONS, TORCH

_NEEDS = {ONNXRUNTIME: ("onnx", "onnxscript", "onnxruntime"), OPENVINO: ("onnx", "onnxscript", "openvino")}  # modules


@dataclass(frozen=True)
class Choice:
    """An engine. ``cache`` is the folder for exported models, or None to keep none."""

    engine: str = TORCH
    precision: str = FP32
    cache: Path | None = None

    @staticmethod
    def of(engine: str, precision: str = FP32, cache: str | Path | bool | None = None) -> Choice:
        """Return a checked choice. ``cache``: None for the user's cache folder, False for none, or a folder.

        Raises SpecError for an unknown engine or precision, and for an engine that is not installed.
        """
        for what, found, known in (("engine", engine, ENGINES), ("precision", precision, PRECISIONS)):
            check_choice(what, found, known)
        for module in _NEEDS.get(engine, ()):
            if find_spec(module) is None:
                raise SpecError(f"engine {engine} needs the {module} library: pip install 'netspec-caffe[{engine}]'")
        if cache is None or cache is True:
            return Choice(engine, precision, user_folder())
        return Choice(engine, precision, None if cache is False or cache == "" else Path(cache))


def fastest() -> str:
    """Return the fastest installed engine for small nets on a CPU."""
    return ONNXRUNTIME if all(find_spec(module) for module in _NEEDS[ONNXRUNTIME]) else TORCH


def user_folder() -> Path | None:
    """Return the default folder of the models: ``netspec`` in XDG_CACHE_HOME, or in ``~/.cache``.

    None for a user without a home, as in a container with ``--user 1234``.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.expanduser("~/.cache")
    return Path(base) / "netspec" if os.path.isabs(base) else None
