"""Net: a torch.nn.Module that executes a Plan. It does not depend on any layer type.

Caffe: src/caffe/net.cpp
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from netspec.errors import Report, SpecError, Where
from netspec.exact import ALL
from netspec.exact.blas import other_kernels
from netspec.files.limits import amount, is_out_of_memory
from netspec.files.limits import memory as memory_of_machine
from netspec.graph import check_blobs
from netspec.graph.options import BuildOptions
from netspec.graph.plan import Node, Param, Plan, plan_backward
from netspec.layers import class_of, unknown_type
from netspec.layers.base import Context, Layer, Random, Shape, shape_string
from netspec.layers.reading import Fed, Restarts
from netspec.net.ignored_fields import unused_fields
from netspec.net.need import BYTES, Need, limit_on, limit_text
from netspec.net.table import table
from netspec.proto.schema import PHASE_NAMES, TEST, TRAIN
from netspec.run.eager import Eager, last_uses
from netspec.run.prepared import Prepared
from netspec.run.training import TrainingStep, obstacle
from netspec.run.walk import Runner, weighted_sum
from netspec.terminal import log

Array = np.ndarray | torch.Tensor
MUCH = 8  # a net that takes more than this part of the limit is first looked at as a whole


@dataclass(frozen=True)
class Learnable:
    """A parameter as the solver sees it: once, with the place of its owner and its multipliers."""

    parameter: torch.nn.Parameter
    lr_mult: float
    decay_mult: float
    layer: str
    index: int


class Net(torch.nn.Module):
    """A runnable net.

    ``net(data=array, label=array)`` runs one forward pass and returns the output blobs, by name in Caffe's
    (alphabetical) order; inputs are ndarrays or tensors. ``inputs`` and ``outputs`` list blob names. ``blobs`` has the
    blobs kept by the last pass: the outputs, with ``keep = "all"`` every blob, or with a list also the listed ones.
    ``params`` maps layer names to lists of tensors in Caffe's blob order; shared parameters are one object.
    ``layers[i]`` belongs to ``param.layer[i]``, splits included. Gradients are computed by torch.

    Threads may share a net: one waits for the pass of another, and ``blobs`` has what its own last pass kept.
    """

    def __init__(self, plan: Plan, options: BuildOptions | None = None) -> None:
        super().__init__()
        options = options or BuildOptions()
        self.plan = plan
        self.param = plan.net
        self.name: str = plan.net.name
        self.phase = plan.net.state.phase
        self.options = options
        self.device = torch.device(options.device)
        self.keep: str | Iterable[str] = ()
        self._kept_of: dict[str | tuple[str, ...], frozenset[int]] = {}  # by ``keep``, as it was last
        self._passing = _Passing()
        self.shapes: dict[str, Shape] = {}
        self.loss_weights: list[list[float]] = []
        self.learnable: list[Learnable] = []
        self.need = Need(plan, last_uses(plan))
        self._surveyed, self._too_much = False, None  # whether the whole net was looked at, and what was found
        seed = int.from_bytes(os.urandom(4), "little") if options.seed is None else options.seed
        self.random = Random(seed)
        if options.exact == ALL and self.device.type == "cpu" and (said := other_kernels()):
            log.warning("net.cpp:53", said)
        self.layers = self._build_layers(options)
        self.inputs = [blob for layer in self.layers if layer.is_input for blob in layer.param.top]
        self.outputs = list(plan.outputs)
        self._given = [
            v for node, layer in zip(plan.nodes, self.layers, strict=False) if layer.is_input for v in node.tops
        ]
        if len(self.layers) == len(plan.nodes):  # otherwise errors were collected: it will not run
            self._set_runners()

    def _set_runners(self) -> None:
        """Make what runs the net: of ``runners`` the first that can. The last, ``eager``, always can."""
        options = self.options
        made = self.plan, list(self.layers), self.loss_weights, options.exact
        self.eager = Eager(*made, options.compiled, learns=self.phase == TRAIN)
        self.prepared = Prepared(*made, options.passes) if self.phase == TEST and options.passes else None
        self._training: TrainingStep | str | None = None  # made at the first pass that trains
        self.runners: list[Runner] = [runner for runner in (self.prepared, self.eager) if runner]

    def replace_layer(self, i: int, layer: Layer) -> None:
        """Let another layer, of the same blobs and shapes, be layer ``i``."""
        self.layers[i] = layer
        self._set_runners()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what runs the net."""
        gone = {"runners", "eager", "prepared", "_training", "_passing"}
        return {name: value for name, value in self.__dict__.items() if name not in gone}

    @override
    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._passing = _Passing()
        self._set_runners()

    # Building

    def _build_layers(self, options: BuildOptions) -> Any:
        layers: dict[int, Layer] = {}  # without those with errors, if errors are collected
        shapes: dict[int, Shape] = {}
        memory, report = 0, self.plan.source.report
        for i, (node, param) in enumerate(zip(self.plan.nodes, self.param.layer, strict=True)):
            tie = _Tie(self.plan, i, partial(self._take, options, i))
            log.info("layer_factory.hpp:77", f"Creating layer {node.name}")
            cls = class_of(param, options.allow_python)
            if cls is None:
                report(SpecError(unknown_type(node.type), tie.at("type")))
                continue
            if any(v not in shapes for v in node.bottoms):
                continue  # an error upstream was reported
            context = Context(
                phase=self.phase,
                options=options,
                random=self.random,
                at=tie.at,
                report=report,
                created=tie.created,
                take=tie.take,
            )
            try:
                layer = cls(param, [shapes[v] for v in node.bottoms], context)
            except SpecError as fault:
                report(fault)
                continue
            except (MemoryError, RuntimeError) as fault:
                if not is_out_of_memory(fault):
                    raise
                raise SpecError(
                    f"its blobs need more memory than there is: this machine has {amount(memory_of_machine())}",
                    tie.at(),
                ) from None
            tie.take_from = None
            weights = _loss_weights(layer, report)
            layers[i] = layer
            self.loss_weights.append(weights)
            for v, shape in zip(node.tops, layer.top_shapes, strict=False):
                shapes[v] = shape
                self.shapes[self.plan.blobs[v]] = shape
            log.info("net.cpp:124", f"Setting up {node.name}")
            for shape, weight in zip(layer.top_shapes, weights, strict=True):
                memory += math.prod(shape) * 4
                log.info("net.cpp:131", "Top shape: " + shape_string(shape))
                if weight:
                    log.info("net.cpp:134", f"    with loss weight {log.number(weight)}")
            log.info("net.cpp:139", f"Memory required for data: {memory}")
            owned = len(self.learnable)
            self._adopt_params(layers, i, layer)
            self.need.add(i, layer, BYTES * sum(item.parameter.numel() for item in self.learnable[owned:]))
        if self.device.type != "meta" and (fault := self.need.fault(limit_on(self.device, options.limit))):
            report(fault)
        if len(layers) == len(self.plan.nodes):
            self._finish(list(layers.values()))
        return torch.nn.ModuleList(layers.values())

    def _take(self, options: BuildOptions, i: int, size: int) -> None:
        """Let layer ``i`` take memory, in bytes, while the net is built.

        Raises SpecError where that, or what the whole net needs, is too much. Only a net that takes much is looked at
        as a whole.
        """
        if (
            self.device.type == "meta"
            or self.need.total + size <= (limit := limit_on(self.device, options.limit)) // MUCH
        ):
            return
        if not self._surveyed:
            self._surveyed, self._too_much = True, self._survey(options).fault(limit)
        if self._too_much:
            raise self._too_much
        if self.need.parameters + size > limit:
            raise SpecError(
                f"needs {amount(size)} of memory beside {self.need}; {limit_text(limit)}", _Tie(self.plan, i).at()
            )

    def _survey(self, options: BuildOptions) -> Need:
        """Return what the net needs, from the shapes that are known so far, without memory, data or Python layers."""
        seen = replace(
            options,
            device="meta",
            open_data=False,
            write_files=False,
            given_shapes={**options.given_shapes, **self.shapes},
            allow_python=False,
            passes=(),
        )
        with log.silent():
            return Net(replace(self.plan, source=self.plan.source.telling(lambda fault: None)), seen).need

    def _adopt_params(self, layers: dict[int, Layer], i: int, layer: Layer) -> None:
        """Connect the shared parameters of layer ``i`` to their owners; list the others as learnable."""
        node, report = self.plan.nodes[i], self.plan.source.report
        if len(node.params) > len(layer.blobs):
            message = f"found {len(node.params)} param {{ }}, expected at most {len(layer.blobs)}, one per blob"
            report(layer.error(message, "param", len(layer.blobs)))
        for j in range(len(layer.blobs)):
            spec = _spec(node, layer, j)
            if spec.owner is None:
                parameter = layer.blobs[j]
                parameter.requires_grad_(spec.lr_mult != 0 or self.param.force_backward)
                self.learnable.append(Learnable(parameter, spec.lr_mult, spec.decay_mult, node.name, j))
                continue
            owner_index, owner_blob = spec.owner
            if owner_index not in layers:
                continue  # an error in the owner was reported
            owner = layers[owner_index]
            if owner_blob >= len(owner.blobs):
                continue  # the owner has too many param { }, which was reported
            here, there = layer.blob_shapes[j], owner.blob_shapes[owner_blob]
            owner_name = self.plan.nodes[owner_index].name
            fits = math.prod(here) == math.prod(there) if spec.permissive else here == there
            if not fits:
                rule = "equal counts" if spec.permissive else "equal shapes (share_mode: STRICT)"
                message = (
                    f'cannot share param "{spec.name}" owned by layer "{owner_name}", param index {owner_blob}: '
                    f"found shape {shape_string(here)} here and {shape_string(there)} there, expected {rule}"
                )
                report(layer.error(message, "param", j))
                continue
            layer.blobs[j] = owner.blobs[owner_blob]
            place = f"owned by layer '{owner_name}', param index {owner_blob}"
            log.info("net.cpp:467", f"Sharing parameters '{spec.name}' {place}")

    def _finish(self, layers: list[Layer]) -> None:
        """Log which layers need backward computation, as decided by Caffe, and the outputs."""
        learns = []
        for node, layer in zip(self.plan.nodes, layers, strict=True):
            learns.append(any(_spec(node, layer, j).lr_mult for j in range(len(layer.blobs))))
        has_loss = [[bool(w) for w in weights] for weights in self.loss_weights]
        self.backward_plan = plan_backward(self.plan, learns, has_loss, [layer.label_bottoms for layer in layers])
        for node, needs in zip(reversed(self.plan.nodes), reversed(self.backward_plan.layers), strict=True):
            if needs:
                log.info("net.cpp:200", f"{node.name} needs backward computation.")
            else:
                log.info("net.cpp:202", f"{node.name} does not need backward computation.")
        for name in self.plan.outputs:
            log.info("net.cpp:244", f"This network produces output {name}")
        log.info("net.cpp:257", "Network initialization done.")
        for line in unused_fields(self.plan, layers):
            log.warning("net.cpp:257", line)

    def __repr__(self) -> str:
        """Return the net as a table of its layers."""
        head = f"{self.name or 'a net without a name'}, phase {PHASE_NAMES[self.phase]}"
        return f"{head}\n{table(self.plan, list(self.layers))}"

    # Running

    @override
    def forward(self, *values: Array, **inputs: Array) -> dict[str, torch.Tensor]:
        """Run the net and return its output blobs; ``inputs`` are the values of the blobs in ``self.inputs``.

        The value of a net's only input needs no name: ``net(images)``.
        """
        if values and (len(values) > 1 or len(self.inputs) != 1 or inputs):
            known = ", ".join(f"{name}=..." for name in self.inputs) or "none (it reads its own data)"
            found = f"{len(values)} values" if len(values) > 1 else "a value"
            raise SpecError(f"found {found} without a name; give inputs by name: {known}", Where(self.plan.source.file))
        return self.forward_loss(**dict(zip(self.inputs, values, strict=False)), **inputs)[1]

    def forward_loss(self, **inputs: Array) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net; return the weighted sum of its losses (a scalar; 0 if it has none) and the outputs."""
        with self._passing.lock:
            given, kept = self.given(inputs), self._kept()
            loss, values = next(found for runner in self.runners if (found := runner.run(given, kept)) is not None)
            blobs = self.plan.blobs
            self._passing.own.blobs = self._passing.last = {blobs[v]: values[v] for v in sorted(kept)}
        outputs = {name: values[v] for name, v in self.plan.outputs.items()}
        return (torch.zeros((), device=self.device) if loss is None else loss), outputs

    @property
    def blobs(self) -> dict[str, torch.Tensor]:
        """The blobs kept by the last pass of this thread, or of any where it made none; see ``keep``."""
        return getattr(self._passing.own, "blobs", self._passing.last)

    def train_pass(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]] | None:
        """Run forward and backward by kernels prepared once; return the loss and the outputs, as forward_loss does.

        Gradients are added to ``grad``. None where autograd must do it: see :meth:`training_step`, or where hooks or
        ``keep`` look at the pass. The loss is good until the next call.
        """
        if self._training is None:
            self._training = self.training_step()
        if isinstance(self._training, str) or self.keep or self._training.is_watched():
            return None
        with self._passing.lock:
            loss, outputs = self._training.run()
            self._passing.own.blobs = self._passing.last = outputs
        return loss, outputs

    def training_step(self) -> TrainingStep | str:
        """Return what trains the net by kernels prepared once, or in words why there is none."""
        if self.eager.segments:
            return "its layers are compiled"
        if why := obstacle(self.plan, list(self.layers), self.eager.chains):
            return why
        weighted = partial(weighted_sum, exact=self.options.exact)
        return TrainingStep(self.plan, list(self.layers), self.loss_weights, self.eager.overwritten, weighted)

    def given(self, inputs: Mapping[str, Array]) -> dict[int, torch.Tensor]:
        """Return the values of the net's inputs. Raises SpecError where one is missing, or unknown."""
        unknown = sorted(set(inputs) - set(self.inputs))
        missing = [name for name in self.inputs if name not in inputs]
        if unknown or missing:
            found = f"unknown input {unknown[0]!r}" if unknown else f"no value for input {missing[0]!r}"
            known = ", ".join(self.inputs) or "none (it reads its own data)"
            raise SpecError(f"{found}; this net's inputs: {known}", Where(self.plan.source.file))
        return {v: self._as_input(inputs[self.plan.blobs[v]]) for v in self._given}

    def _as_input(self, value: Array) -> torch.Tensor:
        if isinstance(value, torch.Tensor):
            return value.to(self.device)
        dtype = self.learnable[0].parameter.dtype if self.learnable else torch.float32
        return torch.as_tensor(np.asarray(value)).to(self.device, dtype)

    def _kept(self) -> frozenset[int]:
        asked = self.keep if isinstance(self.keep, str) else tuple(self.keep)
        if asked not in self._kept_of:
            current = {name: v for v, name in enumerate(self.plan.blobs)}
            names = list(current) if asked == "all" else [asked] if isinstance(asked, str) else asked
            check_blobs(names, current, self.plan.source.file)
            self._kept_of = {asked: frozenset((*self.plan.outputs.values(), *(current[name] for name in names)))}
        return self._kept_of[asked]

    # Parameters and data

    @property
    def params(self) -> dict[str, list[torch.nn.Parameter]]:
        """Layer name -> learnable blobs, in Caffe's order; only layers that have some."""
        return {
            node.name: list(layer.blobs)
            for node, layer in zip(self.plan.nodes, self.layers, strict=True)
            if len(layer.blobs)
        }

    @property
    def output_loss_weights(self) -> dict[str, float]:
        """Output blob -> its loss weight, 0 if it is not a loss."""
        weights = {
            v: weight
            for node, row in zip(self.plan.nodes, self.loss_weights, strict=True)
            for v, weight in zip(node.tops, row, strict=False)
        }
        return {name: weights[v] for name, v in self.plan.outputs.items()}

    def share_weights_with(self, other: Net) -> None:
        """Use the learnable blobs of ``other`` in the layers of equal names (Caffe: ShareTrainedLayersWith).

        A layer whose blobs have different shapes there is a fault of this net.
        """
        mine = {layer.param.name: layer for layer in self.layers}
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
        """Give the MemoryData layer, the first if there are several, its images (n, C, H, W) and labels (n,).

        Without labels they are 0. n must be a multiple of the layer's batch size; each pass then takes the next batch.
        Raises SpecError for other shapes, and for a net without such a layer.
        Caffe: Net_SetInputArrays (python/caffe/_caffe.cpp)
        """
        takers = [layer for layer in self.layers if hasattr(layer, "set_input_arrays")]
        if not takers:
            message = (
                "set_input_arrays is for nets with a MemoryData layer, and this one has none; call net(blob=array)"
            )
            raise SpecError(message, Where(self.plan.source.file))
        taker: Any = takers[0]
        taker.set_input_arrays(data, np.zeros(len(data), np.float32) if labels is None else labels)

    def missing_inputs(self) -> Iterator[SpecError]:
        """Yield an error for each layer that needs inputs: a solver gives no inputs to its nets."""
        for layer in self.layers:
            if isinstance(layer, Fed) and (fault := layer.missing_input()):
                yield fault

    def restart_data(self) -> None:
        """Make every data layer start again at its first record."""
        for layer in self.layers:
            if isinstance(layer, Restarts):
                layer.restart()

    def close(self) -> None:
        """Close files and stop threads."""
        for layer in self.layers:
            layer.close()


class _Passing:
    """Which thread runs a net, and what the last pass of each kept. A copy of a net has its own."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.own = threading.local()
        self.last: dict[str, torch.Tensor] = {}

    def __reduce__(self) -> Any:
        return _Passing, ()


class _Tie:
    """What layer ``i`` knows of its net; ``take_from`` counts the memory that it takes, while the net is built.

    It has slots and does not keep the net alive, because of nets of very many layers.
    """

    __slots__ = ("_i", "_plan", "take_from")

    def __init__(self, plan: Plan, i: int, take_from: Callable[[int], None] | None = None) -> None:
        self._plan, self._i, self.take_from = plan, i, take_from

    def at(self, *path: str | int) -> Where:
        """Return the place in the prototxt of a field of the layer."""
        node = self._plan.nodes[self._i]
        return self._plan.source.at(self._i, *path, layer=node.name, type=node.type)

    def take(self, size: int) -> None:
        if self.take_from:
            self.take_from(size)

    def created(self) -> None:
        """Log what the layer reads and writes."""
        node, blobs = self._plan.nodes[self._i], self._plan.blobs
        log.info("net.cpp:86", f"Creating Layer {node.name}")
        for v in node.bottoms:
            log.info("net.cpp:408", f"{node.name} <- {blobs[v]}")
        for v, in_place in zip(node.tops, node.in_place, strict=True):
            if in_place:
                log.info("net.cpp:369", f"{node.name} -> {blobs[v]} (in-place)")
            else:
                log.info("net.cpp:382", f"{node.name} -> {blobs[v]}")


def _spec(node: Node, layer: Layer, j: int) -> Param:
    """Return the settings of learnable blob ``j``, from the prototxt or the layer."""
    spec = node.params[j] if j < len(node.params) else Param("", layer.default_param_lr, 1.0, False, None)
    return replace(spec, lr_mult=0.0, decay_mult=0.0) if j in layer.not_learned else spec


def _loss_weights(layer: Layer, report: Report) -> list[float]:
    """Return the loss weight of each top (Caffe: Layer::SetLossWeights, LossLayer::LayerSetUp)."""
    given = list(layer.param.loss_weight)
    if given:
        if len(given) == layer.num_tops:
            return given
        message = f"found {len(given)} loss_weight, expected none or one per top blob ({layer.num_tops})"
        report(layer.error(message, "loss_weight"))
    return [1.0 if layer.is_loss and j == 0 else 0.0 for j in range(layer.num_tops)]
