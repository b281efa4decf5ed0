"""Data layers without files: blobs that the program gives, and blobs that fillers make."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from typing_extensions import override

from netspec import log
from netspec.errors import SpecError
from netspec.layers.contract import fillers
from netspec.layers.contract.base import Layer, Shape, State
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.registry import register
from netspec.proto.schema import FillerParameter

T = TypeVar("T")


@register("Input", "input_param")
class Input(Layer):
    """Name blobs that the caller fills: ``net(data=array)``.

    top[i]  the shape given for it; one shape may be used for all tops; ``check --shape`` overrides it
    Caffe: src/caffe/layers/input_layer.cpp
    """

    bottoms = (0, 0)
    tops = (1, None)
    is_input = True

    def setup(self) -> None:
        shapes: list[Shape] = [tuple(shape.dim) for shape in self.param.input_param.shape]
        given = self.context.options.given_shapes
        if not shapes and all(top in given for top in self.param.top):
            shapes = [given[top] for top in self.param.top]
        if len(shapes) not in (1, self.num_tops):
            raise self.error(f"found {len(shapes)} shapes, expected 1 or one per top ({self.num_tops})", "input_param")
        shapes = shapes * self.num_tops if len(shapes) == 1 else shapes
        self.shapes = [given.get(top, shape) for top, shape in zip(self.param.top, shapes, strict=True)]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self.shapes

    def missing_input(self) -> SpecError:
        blobs = " and ".join(f'"{top}"' for top in self.param.top)
        advice = "use a layer that reads data (Data, ImageData, HDF5Data, ...)"
        return self.error(f"nothing fills {blobs} during training; {advice}")

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(torch.zeros(shape, device=self.context.device) for shape in self.shapes)


@register("DummyData", "dummy_data_param")
class DummyData(Layer):
    """Make blobs with fillers: constant ones once, random ones at each forward pass.

    top[i]  shape i, or num x channels x height x width; one shape and one filler may stand for all tops
    Caffe: src/caffe/layers/dummy_data_layer.cpp
    """

    bottoms = (0, 0)
    tops = (1, None)
    OLD_AXES = ("num", "channels", "height", "width")

    def setup(self) -> None:
        self.shapes = [self.possible(shape) for shape in self._read_shapes()]
        given = list(self.param.dummy_data_param.data_filler)
        self._fillers = self._one_a_top(given or [FillerParameter()], "data_filler")
        self.refuse(self._wrong_fillers())
        self._constants: list[torch.Tensor | None] = [None] * self.num_tops

    @override
    def allocate(self) -> None:
        """Fill the constant tops."""
        if self.context.device.type != "meta":
            constant = [filler.type == "constant" for filler in self._fillers]
            self._constants = [self._fill(i, torch.Generator()) if kept else None for i, kept in enumerate(constant)]

    def _wrong_fillers(self) -> Iterator[SpecError]:
        for i, (filler, shape) in enumerate(zip(self._fillers, self.shapes, strict=True)):
            try:
                fillers.check(filler, shape)
            except ValueError as fault:
                yield self.error(str(fault), "dummy_data_param", "data_filler", i)

    def filled_once(self) -> Sequence[torch.Tensor | None]:
        return self._constants

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self.shapes

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        generator = self.context.random.on("cpu")
        return tuple(self._fill(i, generator) if kept is None else kept for i, kept in enumerate(self._constants))

    def _fill(self, i: int, generator: torch.Generator) -> torch.Tensor:
        return fillers.draw(self._fillers[i], self.shapes[i], generator).to(self.context.device)

    def _read_shapes(self) -> list[Shape]:
        p = self.param.dummy_data_param
        old = [list(getattr(p, axis)) for axis in self.OLD_AXES]
        if not any(old):
            return self._one_a_top([tuple(shape.dim) for shape in p.shape], "shape")
        if p.shape:
            message = "both shape and the old num, channels, height, width are given"
            raise self.error(message, "dummy_data_param", "shape")
        columns = [self._one_a_top(values, axis) for axis, values in zip(self.OLD_AXES, old, strict=True)]
        return list(zip(*columns, strict=True))

    def _one_a_top(self, values: list[T], field: str) -> list[T]:
        if len(values) not in (1, self.num_tops):
            message = f"found {len(values)} {field}, expected 1 or one per top ({self.num_tops})"
            raise self.error(message, "dummy_data_param", field)
        return values * self.num_tops if len(values) == 1 else values


@register("MemoryData", "memory_data_param", "transform_param")
class MemoryData(DataLayer):
    """Return arrays that the program gives with ``set_input_arrays``, batch after batch, over and over.

    top[0]  images (batch_size, channels, height, width)
    top[1]  labels (batch_size, 1, 1, 1)
    Caffe: src/caffe/layers/memory_data_layer.cpp (Reset), python/caffe/_caffe.cpp (Net_SetInputArrays)
    """

    takes_arrays = True

    def setup(self) -> None:
        p = self.param.memory_data_param
        self.shape: Shape = (p.batch_size, p.channels, p.height, p.width)
        if min(self.shape) <= 0:
            message = "batch_size, channels, height and width must all be given and above 0"
            raise self.error(message, "memory_data_param")
        self._arrays: tuple[torch.Tensor, torch.Tensor] | None = None
        self._next = 0

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self.shape, (self.shape[0], 1, 1, 1)

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray) -> None:
        """Take images (n, C, H, W) and labels (n,), n a multiple of the batch size; they are not transformed."""
        data, labels = (np.ascontiguousarray(array, np.float32) for array in (data, np.reshape(labels, -1)))
        batch, *image = self.shape
        if data.shape[1:] != tuple(image) or len(data) != len(labels) or not len(data) or len(data) % batch:
            expected = f"images (n, {', '.join(map(str, image))}) and n labels, n a multiple of batch_size {batch}"
            message = f"found images {data.shape} and {len(labels)} labels, expected {expected}"
            raise self.error(message, "memory_data_param")
        if self.param.HasField("transform_param"):
            log.warning("memory_data_layer.cpp:88", "MemoryData does not transform array data on Reset()")
        self._arrays = torch.from_numpy(data), torch.from_numpy(labels).view(-1, 1, 1, 1)
        self._next = 0

    def missing_input(self) -> SpecError | None:
        message = "has no data yet; call set_input_arrays(data, labels) on the net first"
        return self.error(message) if self._arrays is None else None

    def restart(self) -> None:
        self._next = 0

    def running_state(self) -> State:
        return {"next": self._next}

    def resume(self, state: Mapping[str, Any]) -> None:
        following = state["next"]
        if following % self.shape[0] or (self._arrays is not None and not 0 <= following < len(self._arrays[0])):
            raise self.error(f"found row {following} to resume from, but no batch starts there")
        self._next = following

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if fault := self.missing_input():
            raise fault
        assert self._arrays is not None
        here = slice(self._next, self._next + self.shape[0])
        self._next = here.stop % len(self._arrays[0])
        return tuple([array[here].to(self.context.device) for array in self._arrays])
