"""Describes a net without running it: its layers and their shapes.

OpenCV: modules/dnn/src/net_impl.cpp (4.12)
"""

from __future__ import annotations

import logging
from functools import cached_property
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from netspec import log
from netspec.compat.dnn.caffe_files import CaffeFiles
from netspec.compat.dnn.errors import BAD_ARGUMENT, NOT_FOUND, DnnError, as_dnn_error
from netspec.compat.dnn.table import INPUT, Entry, make_table, nodes_of, outputs
from netspec.data.blobs import Shape
from netspec.errors import Where, did_you_mean

if TYPE_CHECKING:
    from netspec.compat.dnn.engine import Engine
    from netspec.layers.contract.base import Layer as CaffeLayer
    from netspec.net.net import Net as CaffeNet

Array = np.ndarray
Shapes = list[Shape]


class FileNet:
    """A net read from Caffe's files: its layers by OpenCV's names and numbers, and the nets built from it.

    Without files it has no layers. ``declared`` has the shapes of its inputs, ``shown`` their names, which
    setInputsNames may change, and ``values`` the arrays that were set. ``runnable`` is false as long as parameters are
    missing. ``engine`` runs the net instead of PyTorch; it is None if parameters are missing or were changed.
    """

    def __init__(self, files: CaffeFiles | None = None) -> None:
        self.files = files
        self.table: list[Entry] = make_table(files.net) if files else []
        self.outputs = outputs(files.net) if files else {}
        self.numbers = {entry.name: number for number, entry in enumerate(self.table)}
        self.declared: dict[str, Shape | None] = files.inputs if files else {}
        self.shown = {blob: blob for blob in self.declared}
        self.values: dict[str, Array] = {}
        self.device = "cpu"  # of PyTorch; the engine runs on the CPU
        self.of_shapes: tuple[dict[str, Shape], CaffeNet] | None = None
        self.runnable = files is None or files.weights is not None or not files.learns
        self.engine: Engine | None = None
        if files is not None and self.runnable and find_spec("netspec.export"):
            from netspec.compat.dnn.engine import Engine

            self.engine = Engine(files, lambda: (self.net, self.is_silent))
        stored = self.engine is not None and self.engine.is_stored
        if files is not None and not stored and None not in self.declared.values():
            _ = self.net

    def shaped(self, given: Any, func: str) -> CaffeNet:
        """Return the net, built without values, for inputs of these shapes: one shape, or one for each input."""
        self.check_not_empty(func)
        assert self.files is not None
        rows = [given] if len(given) and np.isscalar(given[0]) else given
        if len(rows) > len(self.declared):
            message = f"found {len(rows)} shapes, expected {len(self.declared)}: {', '.join(self.shown.values())}"
            raise DnnError(message, code=BAD_ARGUMENT, func=func)
        shapes = {key: tuple(int(n) for n in row) for key, row in zip(self.declared, rows, strict=False)}
        if self.of_shapes is None or self.of_shapes[0] != shapes:
            with as_dnn_error(func):
                self.of_shapes = shapes, self.files.build(shapes, "meta")
        return self.of_shapes[1]

    def shapes(self, net: CaffeNet, entry: Entry) -> tuple[Shapes, Shapes]:
        """Return the shapes of the bottoms and of the tops of a layer."""
        if entry.name == INPUT:
            inputs = [shape for layer in net.layers if layer.is_input for shape in layer.top_shapes]
            return inputs, inputs
        layer = self.layer(net, entry)
        if layer.type == "Axpy":
            a, x, y = layer.bottom_shapes
            return ([x, a] if entry.top < 0 else [x, y]), [x]
        if entry.type == "Convolution":
            return [layer.bottom_shapes[entry.top]], [layer.top_shapes[entry.top]]
        return layer.bottom_shapes, layer.top_shapes

    # The net behind it

    @cached_property
    def net(self) -> CaffeNet:
        """The net, built when it is first needed: inputs without a shape in the prototxt get one from setInput."""
        assert self.files is not None
        given = {key: value.shape for key, value in self.values.items() if self.declared[key] is None}
        records: list[logging.LogRecord] = []
        try:
            with as_dnn_error("forward" if given else "readNetFromCaffe"), log.held_back() as records:
                return self.files.build(given, self.device)
        finally:
            log.write(records)
            self.is_silent = not records  # a net with warnings is built by each process, which gives them again

    def move(self, device: str) -> None:
        """Run the net on this device from now on."""
        self.device = device
        if "net" in self.__dict__:
            self.net.to(device)

    @cached_property
    def nodes(self) -> list[int]:
        """The node of each layer in the plan."""
        assert self.files is not None
        return nodes_of(self.net.plan, self.files.net)

    def tops(self, entry: Entry) -> int:
        """Return the number of tops of a layer."""
        assert self.files is not None
        return len(self.declared if entry.name == INPUT else self.files.net.layer[entry.layer].top)

    def layer(self, net: CaffeNet, entry: Entry) -> CaffeLayer:
        """Return netspec's layer for one of OpenCV's layers."""
        return net.layers[self.nodes[entry.layer]]

    def entry(self, layer: int | str, func: str) -> Entry:
        """Return a layer by number or name. Raises DnnError if there is none."""
        number = self.numbers.get(layer, -1) if isinstance(layer, str) else int(layer)
        if 0 <= number < len(self.table):
            return self.table[number]
        if isinstance(layer, str):
            names = list(self.numbers)
            message = (
                f'no layer "{layer}" in this net{did_you_mean(layer, names) or ";"} it has: {", ".join(names[1:])}'
            )
        else:
            message = f"no layer {layer} in this net; its layers are 0 to {len(self.table) - 1}"
        raise DnnError(message, self.where(), NOT_FOUND, func)

    def check_not_empty(self, func: str) -> None:
        """Raise DnnError for a net without layers."""
        if len(self.table) < 2:
            raise DnnError("the net is empty", code=BAD_ARGUMENT, func=func)

    def where(self) -> Where | None:
        """Return the location of the prototxt."""
        return Where(self.files.source.file) if self.files else None
