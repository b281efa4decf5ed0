"""Net and Layer with the methods of OpenCV 4's cv2.dnn.Net and cv2.dnn.Layer, for Caffe's files.

OpenCV: modules/dnn/src/net_impl.cpp (4.12)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from netspec import log
from netspec.compat.dnn.caffe_files import CaffeFiles
from netspec.compat.dnn.errors import BAD_ARGUMENT, NOT_FOUND, NOT_IMPLEMENTED, UNSPECIFIED, DnnError, as_dnn_error
from netspec.compat.dnn.file_net import FileNet
from netspec.compat.dnn.table import INPUT, Entry, unconnected
from netspec.data.blobs import Shape
from netspec.files.opencv import cv2
from netspec.graph.options import OPENVINO

if TYPE_CHECKING:
    import torch

    from netspec.net.net import Net as CaffeNet
    from netspec.run.walk import Step

Array = np.ndarray
INFERENCE_ENGINE, CUDA = 2, 5  # DNN_BACKEND_...
BIASED = ("Convolution", "Deconvolution", "InnerProduct", "Scale")
INSTEAD = {  # of methods of OpenCV's net that are refused
    "addLayer addLayerToPrev connect registerOutput": "write the layer into the prototxt",
    "quantize getInputDetails getOutputDetails": "export the net to ONNX (netspec export) and quantize that",
    "dump dumpToFile": "netspec draw shows the layers, shapes and connections",
    "getFLOPS getMemoryConsumption": "netspec check shows multiply-adds and memory",
    "forwardAsync": "use forward",
}


class Layer:
    """One layer: ``name``, ``type``, ``preferableTarget``, and ``blobs``, copies of its learnable blobs.

    Assigning to ``blobs`` sets them, as :meth:`Net.setParam` does. A bias may be left out; it becomes 0.
    """

    __slots__ = ("_entry", "_net")

    def __init__(self, net: Net, entry: Entry) -> None:
        self._net, self._entry = net, entry

    name = property(lambda self: self._entry.name)
    type = property(lambda self: self._entry.type)
    preferableTarget = property(lambda self: 0)

    @property
    def blobs(self) -> tuple[Array, ...]:
        """Copies of the learnable blobs."""
        return tuple(self._net._parameter(self._entry, j) for j in range(len(self._net._blobs(self._entry))))

    @blobs.setter
    def blobs(self, arrays: Sequence[Array]) -> None:
        self._net._set_blobs(self._entry, arrays)

    def outputNameToIndex(self, outputName: str) -> int:
        """Return the index of an input, for the input layer (-1 if it has no such input); 0 for other layers."""
        if self.name != INPUT:
            return 0
        inputs = list(self._net._caffe.shown.values())
        return inputs.index(outputName) if outputName in inputs else -1


class Net:
    """A net read from Caffe's files; without files, an empty net.

    Names and numbers of layers are those of OpenCV (netspec/compat/dnn/table.py). Arrays are float32 with Caffe's axes.
    Faults raise :class:`netspec.dnn.DnnError`, which is a cv2.error.
    """

    def __init__(self, files: CaffeFiles | None = None) -> None:
        self._caffe = FileNet(files)

    # Its layers

    def empty(self) -> bool:
        """Return whether it has no layers."""
        return len(self._caffe.table) < 2

    def getLayerNames(self) -> tuple[str, ...]:
        """Return the names of all layers except the input layer."""
        return tuple(entry.name for entry in self._caffe.table[1:])

    def getLayerId(self, layer: str) -> int:
        """Return the number of a layer, -1 if there is no layer of that name."""
        return self._caffe.numbers.get(layer, -1)

    def getLayerTypes(self) -> tuple[str, ...]:
        """Return the types of its layers, without duplicates, in alphabetical order."""
        return tuple(sorted({entry.type or "__NetInputLayer__" for entry in self._caffe.table}))

    def getLayersCount(self, layerType: str) -> int:
        """Return the number of layers of a type."""
        return sum((entry.type or "__NetInputLayer__") == layerType for entry in self._caffe.table)

    def getUnconnectedOutLayers(self) -> Array:
        """Return the numbers of the layers whose tops no other layer reads: (n,) int32."""
        return np.array(unconnected(self._caffe.files.net, self._caffe.table) if self._caffe.files else [], np.int32)

    def getUnconnectedOutLayersNames(self) -> tuple[str, ...]:
        """Return the names of the layers whose tops no other layer reads."""
        return tuple(self._caffe.table[number].name for number in self.getUnconnectedOutLayers())

    # Shapes

    def getLayersShapes(self, netInputShapes: Any) -> tuple[Array, tuple[Any, ...], tuple[Any, ...]]:
        """Return the numbers of all layers and the shapes of their bottoms and tops, for inputs of these shapes."""
        net = self._caffe.shaped(netInputShapes, "getLayersShapes")
        shapes = [self._caffe.shapes(net, entry) for entry in self._caffe.table]
        ids = np.arange(len(self._caffe.table), dtype=np.int32)
        return ids, tuple(_arrays(ins) for ins, _ in shapes), tuple(_arrays(outs) for _, outs in shapes)

    def getLayerShapes(self, netInputShape: Any, layerId: int | str) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return the shapes of the bottoms and of the tops of one layer."""
        net = self._caffe.shaped(netInputShape, "getLayerShapes")
        bottoms, tops = self._caffe.shapes(net, self._caffe.entry(layerId, "getLayerShapes"))
        return _arrays(bottoms), _arrays(tops)

    # Its parameters

    def getLayer(self, layerId: int | str) -> Layer:
        """Return a layer, by number or name."""
        return Layer(self, self._caffe.entry(layerId, "getLayer"))

    def getParam(self, layer: int | str, numParam: int = 0) -> Array:
        """Return a copy of a learnable blob of a layer."""
        entry = self._caffe.entry(layer, "getParam")
        self._blob(entry, numParam, "getParam")
        return self._parameter(entry, numParam)

    def setParam(self, layer: int | str, numParam: int, blob: Array | Sequence[float]) -> None:
        """Write a learnable blob of a layer; the array must have the same number of elements."""
        entry = self._caffe.entry(layer, "setParam")
        self._blob(entry, numParam, "setParam")
        self._write({numParam: blob}, entry, "setParam")

    def _set_blobs(self, entry: Entry, arrays: Sequence[Array]) -> None:
        """Write all learnable blobs of a layer; a bias that is left out becomes 0, as without one in OpenCV."""
        blobs, values = self._blobs(entry), dict(enumerate(arrays))
        if len(values) == 1 and len(blobs) == 2 and entry.type in BIASED:
            values[1] = np.zeros(blobs[1].shape)
        if len(values) != len(blobs):
            message = f'found {len(values)} arrays for the blobs of layer "{entry.name}", expected {len(blobs)}'
            raise DnnError(message, code=BAD_ARGUMENT, func="Layer.blobs")
        self._write(values, entry, "Layer.blobs")

    def _write(self, arrays: Mapping[int, Array | Sequence[float]], entry: Entry, func: str) -> None:
        """Write learnable blobs of a layer, after a look at the sizes of all."""
        blobs = self._blobs(entry)
        made = {j: np.asarray(array, np.float32) for j, array in arrays.items()}
        for j, values in made.items():
            if values.size != blobs[j].numel():
                message = f"found an array of shape {values.shape}, expected {tuple(blobs[j].shape)}"
                raise DnnError(message, code=BAD_ARGUMENT, func=func)
        import torch

        with torch.no_grad():
            for j, values in made.items():
                blobs[j].copy_(torch.tensor(values).reshape(blobs[j].shape))
        self._caffe.runnable, self._caffe.engine = True, None

    def _blobs(self, entry: Entry) -> Sequence[torch.Tensor]:
        return () if entry.name == INPUT else list(self._caffe.layer(self._caffe.net, entry).blobs)

    def _parameter(self, entry: Entry, index: int) -> Array:
        """Return a copy of a learnable blob; vectors are columns, but the bias of an InnerProduct is a row."""
        array = _array(self._caffe.layer(self._caffe.net, entry).blobs[index].detach().cpu().numpy())
        return array.reshape(1, -1) if entry.type == "InnerProduct" and index == 1 else array

    def _blob(self, entry: Entry, index: int, func: str) -> torch.Tensor:
        blobs = self._blobs(entry)
        if not 0 <= index < len(blobs):
            message = f'layer "{entry.name}" has {len(blobs)} learnable blobs, found index {index}'
            raise DnnError(message, code=BAD_ARGUMENT, func=func)
        return blobs[index]

    # Settings

    def setInputsNames(self, inputBlobNames: Sequence[str]) -> None:
        """Rename the inputs, in order."""
        self._caffe.shown = dict(zip(self._caffe.declared, inputBlobNames, strict=False))

    def setInputShape(self, inputName: str, shape: Sequence[int]) -> None:
        """Declare the shape of an input."""
        self._caffe.declared[self._input(inputName, "setInputShape")] = tuple(int(size) for size in shape)

    # Running

    def setInput(self, blob: Any, name: str = "", scalefactor: float = 1.0, mean: Any = ()) -> None:
        """Set an input, the first one if no name is given: (blob - mean) * scalefactor, with one ``mean`` per channel.

        The shape may differ from the prototxt if all layers allow it. None removes the input.
        """
        if self._caffe.files is None:
            return
        key = self._input(name, "setInput")
        if blob is None:
            self._caffe.values.pop(key, None)
            return
        blob = blob.get() if isinstance(blob, cv2.UMat) else blob
        try:
            values = np.array(blob, np.float32)
        except (TypeError, ValueError):
            message = f'found {type(blob).__name__} for input "{self._caffe.shown[key]}", expected an array of numbers'
            raise DnnError(message, code=BAD_ARGUMENT, func="setInput") from None
        self._caffe.values[key] = _normalized(values, float(scalefactor), np.atleast_1d(np.asarray(mean, np.float32)))

    def forward(self, outputName: Any = "", *more: Any, outputBlobs: Any = None, outBlobNames: Any = None) -> Any:
        """Run the net; return the first top of a layer (default: the last one), or a tuple for a list of layers.

        Only layers that are needed run. The result is the top before other layers overwrite it in place.
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
        """Run the net; return all tops of each of the layers."""
        entries = [self._caffe.entry(name, "forwardAndRetrieve") for name in outBlobNames]
        pins = [[(entry, top) for top in range(self._caffe.tops(entry))] for entry in entries]
        found = iter(self._run([pin for row in pins for pin in row], "forwardAndRetrieve"))
        return tuple(tuple(_array(next(found)) for _ in row) for row in pins)

    def getPerfProfile(self) -> tuple[int, Array]:
        """Run again on the last inputs; return the ticks (cv2.getTickFrequency) in total and by layer, (n,)."""
        ticks = np.zeros(len(self._caffe.table) - 1)
        self._check_inputs("getPerfProfile")
        import torch

        with as_dnn_error("getPerfProfile"), torch.inference_mode():
            seconds = dict[int, float]()
            self._walk(len(self._caffe.net.plan.nodes) - 1, seconds)
        for number, entry in enumerate(self._caffe.table[1:]):
            if entry.top in (-1, 0):
                ticks[number] = seconds[self._caffe.nodes[entry.layer]] * cv2.getTickFrequency()
        return int(ticks.sum()), ticks

    @cached_property
    def _makers(self) -> dict[int, int]:
        """The node that computes each value."""
        return {v: i for i, node in enumerate(self._caffe.net.plan.nodes) for v in node.tops}

    @cached_property
    def _lasting(self) -> frozenset[int]:
        """The values that no later value of the same name replaces."""
        return frozenset({name: v for v, name in enumerate(self._caffe.net.plan.blobs)}.values())

    def _last(self) -> str:
        self._caffe.check_not_empty("forward")
        return self._caffe.table[-1].name

    def _forward(self, names: list[str]) -> tuple[Array, ...]:
        self._caffe.check_not_empty("forward")
        entries = [self._caffe.entry(name, "forward") for name in names]
        return tuple(map(_array, self._run([(entry, entry.top) for entry in entries], "forward")))

    def _run(self, pins: Sequence[tuple[Entry, int]], func: str) -> list[Array]:
        """Run the layers that the tops need, and return the tops; each is given as a layer and an index."""
        self._check_inputs(func)
        found = self._by_engine(pins)
        return self._by_torch(pins, func) if found is None else found

    def _by_engine(self, pins: Sequence[tuple[Entry, int]]) -> list[Array] | None:
        """Return the tops, or None if one is not an output of the net, or if PyTorch must run it."""
        caffe = self._caffe
        names = [caffe.outputs.get((entry.layer, top), "") for entry, top in pins]
        if caffe.engine is None or caffe.device != "cpu" or not all(names):
            return None
        values = caffe.engine.run(caffe.values)
        return [values[name] for name in names] if values is not None and values.keys() >= {*names} else None

    def _by_torch(self, pins: Sequence[tuple[Entry, int]], func: str) -> list[Array]:
        import torch

        with as_dnn_error(func), torch.inference_mode():
            net = self._caffe.net
            if not self._caffe.runnable:
                message = "this net was read without weights; also give the .caffemodel, or call setParam"
                raise DnnError(message, self._caffe.where(), func=func)
            wanted = [self._value(net, entry, top, func) for entry, top in pins if entry.name != INPUT]
            try:
                values = self._compute(net, wanted)
            except ValueError as fault:
                raise self._with_shapes(fault, func) from None
        found = iter(wanted)
        given = [self._caffe.values[blob] for blob in self._caffe.declared]
        return [given[max(top, 0)] if entry.name == INPUT else values[next(found)].cpu().numpy() for entry, top in pins]

    def _value(self, net: CaffeNet, entry: Entry, top: int, func: str) -> int:
        if top < 0:
            raise DnnError(f'layer "{entry.name}" ({entry.type}) has no top', code=NOT_FOUND, func=func)
        return net.plan.nodes[self._caffe.nodes[entry.layer]].tops[top]

    def _compute(self, net: CaffeNet, wanted: Sequence[int]) -> Mapping[int, torch.Tensor]:
        """Return the values with these numbers, from the whole net, or layer by layer up to the last one needed."""
        if not wanted:
            return {}
        end, names, lasting = max(self._makers[v] for v in wanted), net.plan.blobs, self._lasting
        if end == len(net.plan.nodes) - 1 and all(v in lasting for v in wanted):
            net.keep = [names[v] for v in wanted]
            net(**self._caffe.values)
            return {v: net.blobs[names[v]] for v in wanted}
        return self._walk(end)

    def _walk(self, end: int, seconds: dict[int, float] | None = None) -> dict[int, torch.Tensor]:
        """Run the nodes up to ``end`` one by one; return all values, and store the time of each in ``seconds``."""
        from netspec.run.walk import walk

        net = self._caffe.net
        values = net.input_tensors(self._caffe.values)

        def visit(step: Step, bottoms: list[torch.Tensor]) -> Any:
            begin = time.perf_counter()
            tops = step.run(*bottoms)
            if seconds is not None:
                seconds[step.node] = time.perf_counter() - begin
            return tops

        walk([step for step in net.eager.one_by_one() if step.node <= end], values, net.options.exact, visit)
        return values

    # The engine, and settings without effect

    def setPreferableBackend(self, backendId: int) -> None:
        """Run the net with OpenVINO (INFERENCE_ENGINE), with PyTorch on a GPU (CUDA), or else with the default engine.

        Without a GPU there is a warning, as in OpenCV. Raises DnnError if OpenVINO is not installed.
        """
        if self._caffe.engine is not None:
            with as_dnn_error("setPreferableBackend"):
                self._caffe.engine.choose(OPENVINO if backendId == INFERENCE_ENGINE else "")
        device = "cpu"
        if backendId == CUDA:
            import torch

            if torch.cuda.is_available():
                device = "cuda"
            else:
                log.logger.warning("DNN_BACKEND_CUDA: torch finds no GPU on this machine; the net runs on the CPU")
        self._caffe.move(device)

    def _accept(self, *settings: Any, **named: Any) -> None:
        """Accept and ignore a setting: no switch changes a result."""

    setPreferableTarget = enableFusion = enableWinograd = setHalideScheduler = _accept

    # Errors

    def _input(self, name: str, func: str) -> str:
        """Return the blob of the input ``name``; "" is the first."""
        for blob, shown in self._caffe.shown.items():
            if name in ("", shown):
                return blob
        raise self._fault(f'no input "{name}"', func, NOT_FOUND)

    def _check_inputs(self, func: str) -> None:
        self._caffe.check_not_empty(func)
        for blob, shown in self._caffe.shown.items():
            if blob not in self._caffe.values:
                raise self._fault(f'no value for input "{shown}"', func)

    def _fault(self, found: str, func: str, code: int = UNSPECIFIED) -> DnnError:
        known = ", ".join(self._caffe.shown.values()) or "none"
        return DnnError(f"{found}; this net's inputs: {known}", self._caffe.where(), code, func)

    def _with_shapes(self, fault: ValueError, func: str) -> DnnError:
        """Return an error of a run, with the shapes of the inputs that differ from the prototxt."""
        caffe = self._caffe
        changed = [
            f'input "{caffe.shown[key]}" has shape {value.shape}, but the prototxt declares {caffe.declared[key]}'
            for key, value in caffe.values.items()
            if value.shape != caffe.declared[key]
        ]
        message = "; ".join([getattr(fault, "message", str(fault)), *changed])
        return DnnError(message, getattr(fault, "where", None), BAD_ARGUMENT, func)


def _refused(func: str, instead: str) -> Callable[..., NoReturn]:
    """Return a method that raises an error for any arguments."""

    def refuse(self: Net, *arguments: Any, **named: Any) -> NoReturn:
        raise DnnError(f"{func} is not supported; {instead}", self._caffe.where(), NOT_IMPLEMENTED, func)

    return refuse


for _names, _instead in INSTEAD.items():
    for _name in _names.split():
        setattr(Net, _name, _refused(_name, _instead))


def _normalized(values: Array, scale: float, mean: Array) -> Array:
    """Return (values - mean) * scale; the mean has a number for each channel, or for the first channels."""
    if mean.any():
        by_channel = np.zeros(values.shape[1], np.float32)
        count = min(len(by_channel), len(mean))
        by_channel[:count] = mean[:count]
        values -= by_channel.reshape(-1, *(1,) * (values.ndim - 2))
    if scale != 1:
        values *= np.float32(scale)
    return values


def _array(values: Array) -> Array:
    """Return a copy in OpenCV's form: at least two axes, (n, 1) for a vector."""
    array = np.array(values, np.float32, order="C")
    return array if array.ndim > 1 else array.reshape(-1, 1)


def _arrays(shapes: Iterable[Shape]) -> tuple[Array, ...]:
    return tuple(np.array(shape, np.int32) for shape in shapes)
