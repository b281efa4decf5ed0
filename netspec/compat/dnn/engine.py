"""Runs a net of Caffe's files with an engine (docs/engines.md), which needs no torch if the cache has the model.

The net is exported once for its files; batch, height and width are dynamic where the net allows it. An engine may
accept shapes that Caffe refuses, so PyTorch's layers check each set of input shapes once. Those that passed are listed
in a file next to the model, for later processes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from netspec.compat.dnn.caffe_files import OPENCV_LAYERS, CaffeFiles, bytes_of
from netspec.errors import SpecError
from netspec.export.engines.cache import key_of
from netspec.export.engines.choice import Choice, fastest
from netspec.export.engines.model import Model, Unable, warn_unable
from netspec.graph.options import TORCH

if TYPE_CHECKING:
    from netspec.net.net import Net

SHAPES, MOST_SHAPES = "shapes.txt", 1000  # the shapes of the inputs that passed, one set in a line
Arrays = Mapping[str, np.ndarray]


class Engine:
    """Computes the outputs of a net of ``files``; ``build`` returns the net in PyTorch, and whether to keep its model.

    Parameters are those of the files, and of fillers with a fixed seed.
    """

    def __init__(self, files: CaffeFiles, build: Callable[[], tuple[Net, bool]]) -> None:
        self._files, self._build = files, build
        self.choose()

    def choose(self, name: str = "") -> None:
        """Let the engine of this name run the net, with a warning if it cannot, or else the fastest one, without.

        Raises SpecError for an engine that is not installed.
        """
        self._choice, self._warn = Choice.of(name or fastest()), bool(name)
        if any(layer.type in OPENCV_LAYERS for layer in self._files.net.layer):
            self._give_up("it does not run SSD's layers as OpenCV computes them")
        weights = self._files.weights
        paths = [os.fspath(weights)] if isinstance(weights, str | os.PathLike) else []
        self._key = ""  # also for a pipe, which can be read only once, and for a file with a fault
        if self._choice.engine != TORCH and all(map(os.path.isfile, paths)):
            content = "" if paths or weights is None else hashlib.sha256(bytes_of(weights)).hexdigest()
            with suppress(SpecError):
                self._key = key_of(paths, {"prototxt": self._files.digest, "weights": content})
        self._model: Model | None = None
        self._passed, self._refused = set[str](), set[str]()  # shapes; for refused ones see :meth:`run`

    @property
    def is_stored(self) -> bool:
        """Whether the cache has the model, and the files are therefore good."""
        cache = self._choice.cache
        return bool(self._key) and cache is not None and (cache / self._key).is_dir()

    def run(self, inputs: Arrays) -> dict[str, np.ndarray] | None:
        """Return the outputs of the net by name, or None if PyTorch must compute them, or report a fault."""
        shapes = repr([(blob, inputs[blob].shape) for blob in sorted(inputs)])
        if self._choice.engine == TORCH or shapes in self._refused:
            return None
        try:
            model = self._model or self._open()
            found = model.run(inputs)
            if shapes not in self._passed:
                self._check(inputs, found)
                self._passed.add(shapes)
                if len(self._passed) <= MOST_SHAPES:
                    with suppress(OSError), (model.folder / SHAPES).open("a", encoding="utf-8") as file:
                        file.write(f"{shapes}\n")
            return found
        except (Unable, ValueError) as fault:
            if self._model is None and isinstance(fault, Unable):
                self._give_up(str(fault))
            self._refused.add(shapes)
            return None

    def _open(self) -> Model:
        key = self._key if self.is_stored or self._build()[1] else ""
        if not self._warn and not (key and self._choice.cache):
            raise Unable("its model cannot be kept, and each start would take seconds to export it")
        self._model = Model(self._choice, key, self._export)
        with suppress(OSError):
            self._passed.update((self._model.folder / SHAPES).read_text("utf-8", "replace").splitlines())
        return self._model

    def _export(self, path: Path) -> None:
        from netspec.export.engines.net import write_model

        write_model(self._build()[0], path)

    def _check(self, inputs: Arrays, found: Arrays) -> None:
        """Raise SpecError if a layer refuses the shapes of the inputs, and Unable if an output has another shape."""
        from netspec.run.shapes import fitted

        net = self._build()[0]
        given = {v: tuple(value.shape) for v, value in net.input_tensors(inputs).items()}
        shapes = fitted(net.plan, net.layers, given)[1]
        for name, v in net.plan.outputs.items():
            if name in found and shapes.get(v, found[name].shape) != found[name].shape:
                raise Unable(f"{name} has shape {found[name].shape} there, expected {shapes[v]}")

    def _give_up(self, reason: str) -> None:
        """Let PyTorch run the net."""
        if self._warn:
            warn_unable(self._choice, reason)
        self._choice = Choice()
