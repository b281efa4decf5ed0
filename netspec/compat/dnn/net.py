"""Net and Layer with the methods of OpenCV 4's cv2.dnn.Net and cv2.dnn.Layer, for Caffe's files.

OpenCV: modules/dnn/src/net_impl.cpp (4.12)
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch

from netspec.compat.dnn.caffe_files import CaffeFiles
from netspec.compat.dnn.described import Described
from netspec.compat.dnn.errors import BAD_ARGUMENT, NOT_FOUND, DnnError, as_dnn_error
from netspec.compat.dnn.table import INPUT, Entry
from netspec.files.opencv import cv2
from netspec.net.net import Net as CaffeNet
from netspec.run.walk import Step, walk

Array = np.ndarray


class Layer:
    """One layer: ``name``, ``type``, ``blobs`` (copies of its learnable blobs) and ``preferableTarget``."""

    def __init__(self, name: str, type: str, blobs: Sequence[Array], tops: Sequence[str]) -> None:
        self.name, self.type, self.blobs = name, type, tuple(blobs)
        self.preferableTarget = 0
        self._tops = list(tops)

    def outputNameToIndex(self, outputName: str) -> int:
        """Return the number of an input, for the input layer (-1: there is none of that name); 0 for other layers."""
        if self.name != INPUT:
            return 0
        return self._tops.index(outputName) if outputName in self._tops else -1


class Net(Described):
    """A net that was read from Caffe's files; without files, an empty one.

    Names and numbers of layers are OpenCV's (netspec/compat/dnn/table.py), arrays are float32 in Caffe's axes.
    Faults raise :class:`netspec.dnn.DnnError`, which is a cv2.error.
    """

    def __init__(self, files: CaffeFiles | None = None) -> None:
        super().__init__(files)
        self._runnable = files is None or files.weights is not None or not any(_learns(files))

    # Its parameters

    def getLayer(self, layerId: int | str) -> Layer:
        """Return a layer, by number or name."""
        entry = self._entry(layerId, "getLayer")
        if entry.name == INPUT:
            return Layer(INPUT, "", (), list(self._shown.values()))
        count = len(self._layer(self._net, entry).blobs)
        return Layer(entry.name, entry.type, [self._parameter(entry, j) for j in range(count)], ())

    def getParam(self, layer: int | str, numParam: int = 0) -> Array:
        """Return a copy of a learnable blob of a layer."""
        entry = self._entry(layer, "getParam")
        self._blob(entry, numParam, "getParam")
        return self._parameter(entry, numParam)

    def setParam(self, layer: int | str, numParam: int, blob: Array | Sequence[float]) -> None:
        """Write a learnable blob of a layer; the array must have as many numbers."""
        target = self._blob(self._entry(layer, "setParam"), numParam, "setParam")
        values = np.asarray(blob, np.float32)
        if values.size != target.numel():
            message = f"found an array of shape {values.shape}, expected {tuple(target.shape)}"
            raise DnnError(message, code=BAD_ARGUMENT, func="setParam")
        with torch.no_grad():
            target.copy_(torch.tensor(values).reshape(target.shape))
        self._runnable = True

    def _parameter(self, entry: Entry, index: int) -> Array:
        """Return a copy of a learnable blob; vectors are columns, but the bias of an InnerProduct is a row."""
        array = _array(self._layer(self._net, entry).blobs[index])
        return array.reshape(1, -1) if entry.type == "InnerProduct" and index == 1 else array

    def _blob(self, entry: Entry, index: int, func: str) -> torch.Tensor:
        blobs = () if entry.name == INPUT else self._layer(self._net, entry).blobs
        if not 0 <= index < len(blobs):
            message = f'layer "{entry.name}" has {len(blobs)} learnable blobs, there is no number {index}'
            raise DnnError(message, code=BAD_ARGUMENT, func=func)
        return blobs[index]

    # Settings

    def setInputsNames(self, inputBlobNames: Sequence[str]) -> None:
        """Give the inputs other names, in their order."""
        self._shown = dict(zip(self._declared, inputBlobNames, strict=False))

    def setInputShape(self, inputName: str, shape: Sequence[int]) -> None:
        """Declare the shape of an input."""
        self._declared[self._input(inputName, "setInputShape")] = tuple(int(size) for size in shape)

    # Running

    def setInput(self, blob: Any, name: str = "", scalefactor: float = 1.0, mean: Any = ()) -> None:
        """Give an input, the first where it has no name: (blob - mean) scalefactor, ``mean`` one number a channel.

        The shape may differ from the prototxt's wherever the layers can follow. None takes the input away.
        """
        if self._files is None:
            return
        key = self._input(name, "setInput")
        if blob is None:
            self._values.pop(key, None)
            return
        blob = blob.get() if isinstance(blob, cv2.UMat) else blob
        try:
            values = np.array(blob, np.float32)
        except (TypeError, ValueError):
            message = f'found {type(blob).__name__} for input "{self._shown[key]}", expected an array of numbers'
            raise DnnError(message, code=BAD_ARGUMENT, func="setInput") from None
        self._values[key] = _normalized(values, float(scalefactor), np.atleast_1d(np.asarray(mean, np.float32)))

    def forward(self, outputName: Any = "", *more: Any, outputBlobs: Any = None, outBlobNames: Any = None) -> Any:
        """Run the net; return the first top of a layer, by default the last one's, or of a list of layers: a tuple.

        A layer is run only where it is needed. The top is what that layer gave, before others wrote over it in place.
        """
        asked = outBlobNames if outBlobNames is not None else outputName
        for word in more:  # forward(outputBlobs, outputName)
            asked = word if isinstance(word, str) else asked
        if isinstance(asked, str):
            return self._forward([asked or self._last()])[0]
        if isinstance(asked, list | tuple) and asked and all(isinstance(name, str) for name in asked):
            return self._forward(list(asked))
        return self._forward([self._last()]) if isinstance(asked, list | tuple) else self._forward([self._last()])[0]

    def forwardAndRetrieve(self, outBlobNames: Sequence[str]) -> tuple[tuple[Array, ...], ...]:
        """Run the net; return all tops of each of these layers."""
        entries = [self._entry(name, "forwardAndRetrieve") for name in outBlobNames]
        net = self._net
        pins = [[(entry, top) for top in range(self._tops(net, entry))] for entry in entries]
        found = iter(self._run([pin for row in pins for pin in row], "forwardAndRetrieve"))
        return tuple(tuple(_array(next(found)) for _ in row) for row in pins)

    def getPerfProfile(self) -> tuple[int, Array]:
        """Return ticks (cv2.getTickFrequency) in all and by layer, (n,): of one more run, on the inputs given last."""
        ticks = np.zeros(len(self._table) - 1)
        self._check_inputs("getPerfProfile")
        with as_dnn_error("getPerfProfile"), torch.inference_mode():
            seconds = dict[int, float]()
            self._walk(len(self._net.plan.nodes) - 1, seconds)
        for number, entry in enumerate(self._table[1:]):
            if entry.top in (-1, 0):
                ticks[number] = seconds[self._nodes[entry.layer]] * cv2.getTickFrequency()
        return int(ticks.sum()), ticks

    @cached_property
    def _makers(self) -> dict[int, int]:
        """The node that makes each value."""
        return {v: i for i, node in enumerate(self._net.plan.nodes) for v in node.tops}

    @cached_property
    def _lasting(self) -> frozenset[int]:
        """The values that no later one of the same name replaces."""
        return frozenset({name: v for v, name in enumerate(self._net.plan.blobs)}.values())

    def _tops(self, net: CaffeNet, entry: Entry) -> int:
        return len(self._declared) if entry.name == INPUT else len(self._node(net, entry).tops)

    def _last(self) -> str:
        self._check_not_empty("forward")
        return self._table[-1].name

    def _forward(self, names: list[str]) -> tuple[Array, ...]:
        self._check_not_empty("forward")
        entries = [self._entry(name, "forward") for name in names]
        return tuple(map(_array, self._run([(entry, entry.top) for entry in entries], "forward")))

    def _run(self, pins: Sequence[tuple[Entry, int]], func: str) -> list[torch.Tensor]:
        """Run what the tops need, and return them; each is given as a layer and the number of its top."""
        self._check_inputs(func)
        with as_dnn_error(func), torch.inference_mode():
            net = self._net
            self._check_weights(func)
            wanted = [self._value(net, entry, top, func) for entry, top in pins if entry.name != INPUT]
            try:
                values = self._compute(net, wanted)
            except ValueError as fault:
                raise self._with_shapes(fault, func) from None
        found = iter(wanted)
        given = [torch.from_numpy(self._values[blob]) for blob in self._declared]
        return [given[max(top, 0)] if entry.name == INPUT else values[next(found)] for entry, top in pins]

    def _value(self, net: CaffeNet, entry: Entry, top: int, func: str) -> int:
        if top < 0:
            raise DnnError(f'layer "{entry.name}" ({entry.type}) has no top', code=NOT_FOUND, func=func)
        return self._node(net, entry).tops[top]

    def _compute(self, net: CaffeNet, wanted: Sequence[int]) -> Mapping[int, torch.Tensor]:
        """Return the values of these numbers: of the whole net, or layer by layer up to the last that is needed."""
        if not wanted:
            return {}
        end, names, lasting = max(self._makers[v] for v in wanted), net.plan.blobs, self._lasting
        if end == len(net.plan.nodes) - 1 and all(v in lasting for v in wanted):
            net.keep = [names[v] for v in wanted]
            net(**self._values)
            return {v: net.blobs[names[v]] for v in wanted}
        return self._walk(end)

    def _walk(self, end: int, seconds: dict[int, float] | None = None) -> dict[int, torch.Tensor]:
        """Run the nodes up to ``end`` one by one; return all values, and note in ``seconds`` what each takes."""
        net = self._net
        values = net.given(self._values)

        def visit(step: Step, bottoms: list[torch.Tensor]) -> Any:
            begin = time.perf_counter()
            tops = step.run(*bottoms)
            if seconds is not None:
                seconds[step.node] = time.perf_counter() - begin
            return tops

        walk([step for step in net.eager.one_by_one() if step.node <= end], values, net.options.exact, visit)
        return values

    # What can be wrong

    def _input(self, name: str, func: str) -> str:
        """Return the blob of an input that is called ``name``; "" is the first."""
        for blob, shown in self._shown.items():
            if name in ("", shown):
                return blob
        found = f'no input "{name}" in this net' if name else "this net takes no input"
        known = ", ".join(self._shown.values()) or "none"
        raise DnnError(f"{found}; its inputs: {known}", self._file(), NOT_FOUND, func)

    def _check_inputs(self, func: str) -> None:
        self._check_not_empty(func)
        for blob, shown in self._shown.items():
            if blob not in self._values:
                known = ", ".join(self._shown.values())
                raise DnnError(f'no value for input "{shown}"; this net\'s inputs: {known}', self._file(), func=func)

    def _check_weights(self, func: str) -> None:
        if not self._runnable:
            message = "this net was read without weights; give the .caffemodel as well, or call setParam"
            raise DnnError(message, self._file(), func=func)

    def _with_shapes(self, fault: ValueError, func: str) -> DnnError:
        """Return a fault of a run with the shapes of the inputs that are not as the prototxt has them."""
        changed = [
            f'input "{self._shown[key]}" has shape {value.shape}, the prototxt declares {self._declared[key]}'
            for key, value in self._values.items()
            if value.shape != self._declared[key]
        ]
        message = "; ".join([getattr(fault, "message", str(fault)), *changed])
        return DnnError(message, getattr(fault, "where", None), BAD_ARGUMENT, func)


def _learns(files: CaffeFiles) -> Iterable[bool]:
    """Yield, for each layer whose type has weights, whether the prototxt does not hold them itself."""
    learning = ("Convolution", "Deconvolution", "InnerProduct", "ConvolutionDepthwise", "DepthwiseConvolution")
    return (layer.type in learning and not layer.blobs for layer in files.net.layer)


def _normalized(values: Array, scale: float, mean: Array) -> Array:
    """Return (values - mean) scale; the mean is by channel, as far as it is given."""
    if mean.any():
        by_channel = np.zeros(values.shape[1], np.float32)
        count = min(len(by_channel), len(mean))
        by_channel[:count] = mean[:count]
        values -= by_channel.reshape(-1, *(1,) * (values.ndim - 2))
    if scale != 1:
        values *= np.float32(scale)
    return values


def _array(values: torch.Tensor) -> Array:
    """Return a copy as OpenCV gives arrays: at least two axes, (n, 1) for a vector."""
    array = np.array(values.detach().numpy(), np.float32, order="C")
    return array if array.ndim > 1 else array.reshape(-1, 1)
