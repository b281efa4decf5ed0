"""Layers of HDF5 files: HDF5Data, HDF5Output."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from netspec.data.sources import Source
from netspec.errors import SpecError
from netspec.files.whole_file import why_unwritable
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register
from netspec.layers.data.files import ReadingLayer


@register("HDF5Data", "hdf5_data_param", "transform_param", "data_param.prefetch")
class HDF5Data(ReadingLayer):
    """Read the rows of HDF5 files, from the datasets named like the tops.

    top[i]  (batch_size, ...), the shape of a row of dataset i
    Caffe: src/caffe/layers/hdf5_data_layer.cpp
    """

    tops = (1, None)
    group = "hdf5_data_param"

    def wrong_settings(self) -> Iterator[SpecError]:
        """Yield what is wrong with hdf5_data_param; there is no transform_param."""
        yield from super().wrong_settings()
        if self.param.HasField("transform_param"):
            yield self.error("HDF5Data does not transform data; remove transform_param", "transform_param")

    def open(self) -> Source | None:
        from netspec.data.hdf5 import Hdf5Source

        p = self.param.hdf5_data_param
        return Hdf5Source(p.source, self.param.top, p.batch_size, p.shuffle, self.draws, self.where)

    def shapes_without_data(self) -> list[Shape]:
        """Return the shapes given by the caller; the prototxt does not contain them."""
        given = self.context.options.given_shapes
        self.refuse(self.shape_wanted(top, f"{self.batch_size},...") for top in self.param.top if top not in given)
        return [given[top] for top in self.param.top]


@register("HDF5Output", "hdf5_output_param")
class HDF5Output(Layer):
    """Append both bottoms to the datasets ``data`` and ``label`` of a new HDF5 file.

    bottom[0]  data (N, ...), up to 4 axes
    bottom[1]  label (N, ...), up to 4 axes
    Caffe: src/caffe/layers/hdf5_output_layer.cpp
    """

    bottoms = (2, 2)
    tops = (0, 0)

    def setup(self) -> None:
        name = self.param.hdf5_output_param.file_name
        field = ("hdf5_output_param", "file_name")
        if not name:
            raise self.error("file_name is missing; set it to the path of the results", *field)
        if reason := why_unwritable(name):
            raise self.error(f'HDF5 file "{name}" cannot be written: {reason}', *field)
        self._sink = None
        if self.context.options.write_files and self.context.device.type != "meta":
            from netspec.data.hdf5 import Hdf5Sink

            self._sink = Hdf5Sink(name, self.context.at(*field))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, label = bottom_shapes
        if max(len(data), len(label)) > 4:
            raise self.error(f"found shapes {data} and {label}; at most 4 axes can be saved", "bottom")
        if data[:1] != label[:1]:
            raise self.error(f"data has {data[:1]} rows and label {label[:1]}; expected the same number", "bottom")
        return ()

    def close(self) -> None:
        if self._sink is not None:
            self._sink.close()

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        if self._sink is not None:
            data, label = (bottom.detach().cpu().numpy() for bottom in bottoms)
            self._sink.append(data, label)
        return ()
