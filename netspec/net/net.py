"""Net: a torch.nn.Module that executes a Plan. Nothing here depends on a type of layer.

Caffe: src/caffe/net.cpp
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from typing_extensions import override

from netspec import log
from netspec.errors import SpecError, Where, check_blobs, did_you_mean
from netspec.exact import ALL
from netspec.exact.machine import other_bits
from netspec.graph.options import BuildOptions
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer, State
from netspec.layers.contract.context import device_of
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.learned import uncounted
from netspec.net.assembly import Assembly
from netspec.net.table import table
from netspec.proto.schema import PHASE_NAMES, TEST
from netspec.run.eager import Eager
from netspec.run.walk import Runner, Trainer, losses_of

Array = np.ndarray | torch.Tensor


V = TypeVar("V")


class ByName(dict[str, V]):
    """A dict by the names of blobs or layers, whose KeyError says what names there are.

    ``known`` are the names of blobs that the last pass did not keep, but could.
    """

    def __init__(self, kind: str, values: Mapping[str, V], known: Iterable[str] = ()) -> None:
        super().__init__(values)
        self._kind, self._known = kind, known

    def __missing__(self, name: str) -> V:
        if name in self._known:
            raise KeyError(f'{self._kind} "{name}" was not kept; set net.keep = "all", or ["{name}"], and run the net')
        hint = did_you_mean(str(name), [*self, *self._known]) or ";"
        raise KeyError(f'no {self._kind} "{name}" in this net{hint} it has: {", ".join(self._known or self)}')


class Net(torch.nn.Module):
    """A runnable net.

    ``net(data=array, label=array)`` runs one forward pass and returns the output blobs, by name in Caffe's
    (alphabetical) order; inputs are ndarrays or tensors. ``inputs`` and ``outputs`` list blob names. ``blobs`` has the
    blobs kept by the last pass: the outputs, with ``keep = "all"`` every blob, or with a list also the listed ones.
    ``params`` maps layer names to lists of tensors in Caffe's blob order; shared parameters are one object.
    ``layers[i]`` belongs to ``param.layer[i]``, splits included. Gradients are computed by torch.

    Threads may share a net. Each waits until the pass of another has finished, and ``blobs`` has the blobs that the
    last pass of the same thread kept.

        >>> net = netspec.load_net("deploy.prototxt", weights="x.caffemodel")
        >>> net.inputs, net.outputs, net.shapes["feat"]
        (['data'], ['prob'], (1, 4))
        >>> net.keep = ["feat"]
        >>> scores = net(data=images)["prob"]
        >>> net.blobs["feat"].shape
        torch.Size([2, 4])
    """

    def __init__(self, plan: Plan, options: BuildOptions | None = None) -> None:
        super().__init__()
        options = options or BuildOptions()
        self.device = device_of(options.device)
        self.keep: str | Iterable[str] = ()
        self._kept_values: dict[str | tuple[str, ...], frozenset[int]] = {}  # what the last ``keep`` means
        self._passes = _Passes()
        if options.exact == ALL and self.device.type == "cpu" and (warning := other_bits()):
            log.warning("net.cpp:53", warning)
        assembly = Assembly(plan, options)
        self.options = assembly.options
        self.plan, self.param = assembly.plan, plan.net
        self.name: str = plan.net.name
        self.phase = plan.net.state.phase
        self.layers: Any = torch.nn.ModuleList(assembly.layers.values())
        self.positions = Positions(self.data_layers)
        self.shapes = ByName("blob", assembly.shapes)
        self.loss_weights, self.learnable = assembly.loss_weights, assembly.learnable
        self.need, self.random = assembly.need, assembly.random
        self.inputs = [blob for layer in self.layers if layer.is_input for blob in layer.param.top]
        self.outputs = list(plan.outputs)
        self._input_values = [
            v for node, layer in zip(plan.nodes, self.layers, strict=False) if layer.is_input for v in node.tops
        ]
        if assembly.backward is not None:  # otherwise errors were collected, and the net will not run
            self.backward_plan = assembly.backward
            self._set_runners()

    def _set_runners(self) -> None:
        """Make the runners. The first one that can run a pass runs it; the last, ``eager``, can run any."""
        options = self.options
        losses = losses_of(self.plan, self.loss_weights, self.backward_plan)
        self.eager = Eager(self.plan, list(self.layers), losses, options.exact)
        speed = options.speed if options.passes and self.phase == TEST else None
        self.prepared: Any = speed and speed.prepared(self.eager, options.passes)
        self._trainer: Trainer | str | None = None  # made at the first pass that trains
        self.runners: list[Runner] = [runner for runner in (self.prepared, self.eager) if runner]

    def replace_layer(self, i: int, layer: Layer) -> None:
        """Replace layer ``i`` by a layer with the same blobs and shapes."""
        self.layers[i] = layer
        self.positions = Positions(self.data_layers)
        self._set_runners()

    @property
    def data_layers(self) -> list[DataLayer]:
        """The layers whose tops are records."""
        return [layer for layer in self.layers if isinstance(layer, DataLayer)]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the runners."""
        gone = {"runners", "eager", "prepared", "_trainer", "_passes", "positions"}
        return {name: value for name, value in self.__dict__.items() if name not in gone}

    @override
    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._passes = _Passes()
        self.positions = Positions(self.data_layers)
        self._set_runners()

    @override
    def _apply(self, fn: Any, *arguments: Any, **named: Any) -> Any:
        """Move the net to another device, or change its precision, as torch's ``to`` and ``double`` want."""
        super()._apply(fn, *arguments, **named)
        before = torch.empty(0, device=self.device)
        if (device := fn(before).device) != before.device:
            self.device = device
            self.options = replace(self.options, device=str(device))
            self._set_runners()
        return self

    def __repr__(self) -> str:
        """Return the net as a table of its layers."""
        head = f"{self.name or 'a net without a name'}, phase {PHASE_NAMES[self.phase]}"
        return f"{head}\n{table(self.plan, list(self.layers))}"

    # Running

    @override
    def __call__(self, /, *values: Any, **inputs: Any) -> Any:
        if "self" in inputs and not values:  # an input named "self" cannot be a keyword of torch's __call__
            return super().__call__(inputs)
        return super().__call__(*values, **inputs)

    @override
    def forward(self, /, *values: Array | Mapping[str, Array], **inputs: Array) -> dict[str, torch.Tensor]:
        """Run the net and return its output blobs. ``inputs`` are the values of the blobs in ``self.inputs``.

        They may also be given as one mapping, and the value of a net's only input without a name: ``net(images)``.
        """
        return self.forward_loss(**(self._named(values, inputs) if values else inputs))[1]

    def _named(self, values: tuple[Any, ...], inputs: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return the inputs by name. ``values`` are those that were given without a name."""
        first, *more = values
        if not more and not inputs and isinstance(first, Mapping):
            return first
        if more or len(self.inputs) != 1 or inputs:
            known = ", ".join(f"{name}=..." for name in self.inputs) or "none (the net reads its own data)"
            found = f"{len(values)} values" if more else "a value"
            raise SpecError(f"found {found} without a name; give inputs by name: {known}", Where(self.plan.source.file))
        return {self.inputs[0]: first}

    def forward_loss(self, /, **inputs: Array) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net; return the weighted sum of its losses (a scalar; 0 if it has none) and the outputs."""
        with self._passes.lock, self.positions, uncounted():
            given, kept = self.input_tensors(inputs), self._values_to_keep()
            loss, values = next(found for runner in self.runners if (found := runner.run(given, kept)) is not None)
            blobs = self.plan.blobs
            self._passes.of_thread.blobs = self._passes.last = {blobs[v]: values[v] for v in sorted(kept)}
            outputs = {name: values[v] for name, v in self.plan.outputs.items()}
            return (torch.zeros((), device=self.device) if loss is None else loss), outputs

    @property
    def blobs(self) -> dict[str, torch.Tensor]:
        """The blobs kept by the last pass of this thread, or of any thread if this one made none; see ``keep``."""
        return ByName("blob", getattr(self._passes.of_thread, "blobs", self._passes.last), self.shapes)

    def forward_backward(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]] | None:
        """Run forward and backward by prepared kernels; return the loss and the outputs, as forward_loss does.

        Gradients are added to ``grad``. The loss is valid until the next call. Returns None, without running anything,
        if autograd is needed: because of hooks or ``keep``, or because :meth:`new_trainer` gives a reason.
        """
        trainer = self.trainer()
        if trainer is None or self.keep or trainer.is_watched():
            return None
        with self._passes.lock, self.positions, uncounted():
            loss, outputs = trainer.run()
            self._passes.of_thread.blobs = self._passes.last = outputs
            return loss, outputs

    def trainer(self) -> Trainer | None:
        """Return the trainer that :meth:`forward_backward` runs, or None if there is none. It is made once."""
        if self._trainer is None:
            self._trainer = self.new_trainer()
        return None if isinstance(self._trainer, str) else self._trainer

    def new_trainer(self) -> Trainer | str:
        """Return a trainer that is faster than autograd, or the reason why there is none."""
        if self.options.speed is None:
            return "without netspec/fast"
        return self.options.speed.trainer(self.eager)

    def input_tensors(self, inputs: Mapping[str, Array]) -> dict[int, torch.Tensor]:
        """Return the inputs as tensors, by value number. Raises SpecError for a missing or an unknown one."""
        unknown = sorted(set(inputs) - set(self.inputs))
        missing = [name for name in self.inputs if name not in inputs]
        if unknown or missing:
            found = f"unknown input {unknown[0]!r}" if unknown else f"no value for input {missing[0]!r}"
            known = ", ".join(self.inputs) or "none (the net reads its own data)"
            raise SpecError(f"{found}; this net's inputs: {known}", Where(self.plan.source.file))
        return {v: self._as_input(inputs[self.plan.blobs[v]]) for v in self._input_values}

    def _as_input(self, value: Array) -> torch.Tensor:
        dtype = self.learnable[0].parameter.dtype if self.learnable else torch.float32
        if isinstance(value, torch.Tensor):
            return value.to(self.device, dtype if self.learnable or not value.is_floating_point() else None)
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            what = f"a {type(value).__name__}" if array.ndim == 0 else f"values of type {array.dtype}"
            advice = "read the file first, for example with cv2.imread" if isinstance(value, (str, Path)) else ""
            message = f"found {what} for an input; expected an array of numbers or a tensor"
            raise SpecError(f"{message}; {advice}" if advice else message, Where(self.plan.source.file))
        plain = array.astype(array.dtype.newbyteorder("="), order="C", copy=False)  # torch takes no negative strides
        return torch.as_tensor(plain).to(self.device, dtype)

    def _values_to_keep(self) -> frozenset[int]:
        """Return the numbers of the values to keep: the outputs, and what ``keep`` says."""
        keep = self.keep if isinstance(self.keep, str) else tuple(self.keep)
        if keep not in self._kept_values:
            values = {name: v for v, name in enumerate(self.plan.blobs)}  # of an in-place chain, the last one
            names = list(values) if keep == "all" else [keep] if isinstance(keep, str) else keep
            check_blobs(names, values, self.plan.source.file)
            self._kept_values = {keep: frozenset((*self.plan.outputs.values(), *(values[name] for name in names)))}
        return self._kept_values[keep]

    # Parameters and data

    @property
    def params(self) -> dict[str, list[torch.nn.Parameter]]:
        """Layer name -> learnable blobs, in Caffe's order; only layers that have some."""
        learning = [pair for pair in zip(self.plan.nodes, self.layers, strict=True) if len(pair[1].blobs)]
        return ByName("layer with learnable blobs", {node.name: list(layer.blobs) for node, layer in learning})

    @property
    def output_loss_weights(self) -> dict[str, float]:
        """Output blob -> its loss weight, 0 if it is not a loss."""
        weights = {
            v: weight
            for node, row in zip(self.plan.nodes, self.loss_weights, strict=True)
            for v, weight in zip(node.tops, row, strict=False)
        }
        return {name: weights[v] for name, v in self.plan.outputs.items()}

    def layers_by_name(self) -> dict[str, Layer]:
        """Return the first layer of each name: the one that gets weights for this name, as in Caffe."""
        return {layer.param.name: layer for layer in reversed(self.layers)}

    def share_weights_with(self, other: Net) -> None:
        """Use the learnable blobs of ``other`` in the layers with the same names (Caffe: ShareTrainedLayersWith).

        If the shapes of a layer's blobs differ, an error goes to ``plan.source.report``.
        """
        mine = self.layers_by_name()
        for theirs in other.layers:
            layer = mine.get(theirs.param.name)
            if layer is None:
                continue
            shapes = (layer.blob_shapes, theirs.blob_shapes)
            if shapes[0] != shapes[1]:
                message = f"cannot share weights with the training net: shapes are {shapes[0]} here, {shapes[1]} there"
                self.plan.source.report(layer.error(message))
                continue
            for j, blob in enumerate(theirs.blobs):
                layer.blobs[j] = blob

    def set_input_arrays(self, data: np.ndarray, labels: np.ndarray | None = None) -> None:
        """Give images (n, C, H, W) and labels (n,) to the first MemoryData layer.

        Labels default to 0. n must be a multiple of the layer's batch size. Each pass takes the next batch.
        Raises SpecError for other shapes, and for a net without such a layer.
        Caffe: Net_SetInputArrays (python/caffe/_caffe.cpp)
        """
        taker = next((layer for layer in self.data_layers if layer.takes_arrays), None)
        if taker is None:
            message = "set_input_arrays needs a MemoryData layer, and this net has none; call net(blob=array)"
            raise SpecError(message, Where(self.plan.source.file))
        self.positions.go_back()
        taker.set_input_arrays(data, np.zeros(len(data), np.float32) if labels is None else labels)

    def missing_inputs(self) -> Iterator[SpecError]:
        """Yield an error for each layer that needs inputs. A solver needs a net without such layers."""
        yield from filter(None, [layer.missing_input() for layer in self.layers])

    def restart_data(self) -> None:
        """Make every data layer start again at its first record."""
        self.positions.go_back()
        for layer in self.layers:
            layer.restart()

    def close(self) -> None:
        """Close files and stop threads."""
        for layer in self.layers:
            layer.close()


class _Passes:
    """The lock for the passes of a net, and the blobs that they kept. A copy of a net gets a new object."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.of_thread = threading.local()  # ``blobs``: those of the last pass of the thread
        self.last: dict[str, torch.Tensor] = {}  # the blobs of the last pass of any thread

    def __reduce__(self) -> Any:
        return _Passes, ()


class Positions:
    """A block for a pass. If Ctrl-C interrupts it, no data layer counts its records: the next pass reads them again.

    Further Ctrl-C may interrupt any line here. What was not restored then is restored at the start of the next block.
    """

    def __init__(self, layers: Sequence[Layer]) -> None:
        self._layers = layers
        self._before: list[tuple[Layer, State]] = []  # from the start of the pass; [] once it is done

    def __enter__(self) -> None:
        self.go_back()
        self._before = [(layer, layer.running_state()) for layer in self._layers]

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and not issubclass(kind, Exception):
            self.go_back()
        self._before = []  # an error counts, so that the next pass does not read the same bad record

    def go_back(self) -> None:
        """Return to the records of a pass that was interrupted, if there is one."""
        for layer, state in self._before:
            layer.resume(state)
        self._before = []
