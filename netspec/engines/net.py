"""A net whose forward pass an engine computes; all else is that of :class:`netspec.net.net.Net`."""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from netspec.data.blobs import Shape
from netspec.engines.choice import TORCH, Choice
from netspec.engines.export import write_model
from netspec.engines.model import Model, Origin
from netspec.engines.runners import Unable, tell_unable
from netspec.exact import SMALL
from netspec.export.convert import Source
from netspec.graph.steps import PASSES
from netspec.layers.learned import Stamp, is_lent, stamp
from netspec.net import build
from netspec.net.net import Array, Net
from netspec.proto.schema import PHASE_NAMES, TEST
from netspec.run.shapes import fitted


def load_net(
    path: str | Path,
    phase: str | int = "TEST",
    weights: str | Path | None = None,
    level: int = 0,
    stages: Iterable[str] = (),
    device: str | torch.device = "cpu",
    seed: int | None = None,
    allow_python: bool = False,
    exact: str = SMALL,
    strict: bool = False,
    passes: Collection[str] = PASSES,
    engine: str = TORCH,
    precision: str = "fp32",
    cache: str | Path | bool | None = None,
) -> Net:
    """Build the net of a prototxt for a phase, level and stages; ``weights`` names a .caffemodel or .caffemodel.h5.

    A warning names the layers that the weights lack; with ``strict`` that is an error.
    ``passes`` are what may speed up a net of phase TEST that runs without gradients (netspec/graph/steps.py).
    ``exact`` says which sums are Caffe's to the last bit: "none", "small" or "all" (see netspec/exact/__init__.py).
    ``engine`` is "torch", "onnxruntime" or "openvino" (docs/engines.md), ``precision`` "fp32", or "bf16" where the
    engine has it, ``cache`` the folder that keeps exported models (None: the user's cache folder, False: none).
    Raises SpecError for every fault of the files.
    """
    choice = Choice.of(engine, precision, cache)
    stages = tuple(stages)
    net = build.load_net(path, phase, weights, level, stages, device, seed, allow_python, exact, strict, passes)
    return with_engine(net, choice, path, [] if weights is None else [weights], level, stages)


def with_engine(
    net: Net, choice: Choice, path: str | Path, weights: Iterable[str | Path], level: int, stages: Iterable[str]
) -> Net:
    """Return a net, read from ``path`` and ``weights``, that the chosen engine runs: an :class:`EngineNet`.

    It is the net itself where torch does: by choice, or because a warning said what the engine cannot do.
    """
    if choice.engine == TORCH:
        tell_unable(choice, "")
        return net
    weights = list(weights)
    reason = ""
    if net.phase != TEST:
        reason = f"it runs nets in phase TEST, this one is in {PHASE_NAMES[net.phase]}"
    elif net.device.type != "cpu":
        reason = f"it runs on the CPU, this net is on {net.device}"
    if reason:
        tell_unable(choice, reason)
        return net
    made: Any = EngineNet(net, choice, Path(path), [Path(each) for each in weights], level, tuple(stages))
    return made  # it has all that a Net has


class EngineNet(torch.nn.Module):
    """A net that an engine runs: ``net`` is the torch one, which reads the data and has the parameters.

    Outputs carry no gradient; a pass whose input asks for one is torch's, and so is every pass once the engine turned
    out to be unable. Where parameters were changed the net is exported anew; as long as somebody holds memory through
    which they could change unseen (``.data``, an array), torch runs the net.
    """

    def __init__(
        self, net: Net, choice: Choice, path: Path, weights: list[Path], level: int, stages: tuple[str, ...]
    ) -> None:
        super().__init__()
        self.net = net
        self._choice, self._path, self._weights, self._level, self._stages = choice, path, weights, level, stages
        self._blobs: dict[str, torch.Tensor] = {}
        self._model: Model | None = None
        self._opened_for: tuple[Any, ...] | None = None
        self._as_loaded = self._exported = self._stamps()
        self._readers = [i for i, layer in enumerate(net.layers) if layer.reads_data]
        self._unable, self._told = False, False
        self._fits: tuple[dict[str, Shape], dict[str, Shape]] = {}, {}  # of the inputs at the last pass, of all blobs

    def __getattr__(self, name: str) -> Any:
        """Return what the torch net has."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("net"), name)

    def __repr__(self) -> str:
        """Return the net as a table of its layers."""
        return f"{self.net!r}\nrun by {'torch' if self._unable else self._choice.engine}"

    @property
    def keep(self) -> str | Iterable[str]:
        """The blobs that are kept besides the outputs; see :class:`netspec.net.net.Net`."""
        return self.net.keep

    @keep.setter
    def keep(self, names: str | Iterable[str]) -> None:
        self.net.keep = names

    @property
    def blobs(self) -> dict[str, torch.Tensor]:
        """The blobs kept by the last pass."""
        return self._blobs

    @override
    def forward(self, **inputs: Array) -> dict[str, torch.Tensor]:
        """Run the net and return its output blobs; ``inputs`` are the values of the blobs in ``inputs``."""
        return self.forward_loss(**inputs)[1]

    def forward_loss(self, **inputs: Array) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Run the net; return the weighted sum of its losses (a scalar; 0 if it has none) and the outputs."""
        wants_gradient = any(isinstance(value, torch.Tensor) and value.requires_grad for value in inputs.values())
        usable = not self._unable and not wants_gradient and set(inputs) == set(self.net.inputs)
        if usable and not self._are_lent():
            try:
                return self._pass(inputs)
            except Unable as fault:
                tell_unable(self._choice, str(fault))
                self._unable = True
        loss, outputs = self.net.forward_loss(**inputs)
        self._blobs = self.net.blobs
        return loss, outputs

    def _are_lent(self) -> bool:
        """Return whether the parameters may change unseen; say so once."""
        lent = any(is_lent(parameter) for parameter in self.net.parameters())
        if lent and not self._told:
            self._told = True
            tell_unable(self._choice, "parameters may change unseen while their memory is held, by .data or an array")
        return lent

    def _pass(self, inputs: Mapping[str, Array]) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        losses = self._losses()
        wanted = {**dict.fromkeys(self.net.outputs), **dict.fromkeys(self._kept()), **dict.fromkeys(losses)}
        model = self._current(tuple(wanted))
        given = {name: _array(value) for name, value in inputs.items()}
        given.update(self._read())
        shapes = self._shapes({name: value.shape for name, value in given.items()})
        found = {**given, **model.run(given)}
        for name, value in found.items():
            if shapes.get(name, value.shape) != value.shape:
                raise Unable(f"{name} has shape {value.shape} there, expected {shapes[name]}")
        values = {name: torch.from_numpy(found[name]) for name in wanted}
        loss = torch.zeros(())
        for name, weight in losses.items():
            loss = loss + self.net.weighted_sum(values[name], weight)
        self._blobs = {name: values[name] for name in values if name in self.net.outputs or name in self._kept()}
        return loss, {name: values[name] for name in self.net.outputs}

    def _read(self) -> dict[str, np.ndarray]:
        """Return the tops of the layers that read data."""
        read = {}
        for i in self._readers:
            layer = self.net.layers[i]
            for blob, top in zip(layer.param.top, self.net.run_layer(i, {}, {}), strict=False):
                read[blob] = _array(top)
        return read

    def _shapes(self, given: Mapping[str, Shape]) -> dict[str, Shape]:
        """Return the shapes of the blobs for inputs of these. Raises SpecError where a layer cannot take them."""
        if given != self._fits[0]:
            plan, layers = self.net.plan, list(self.net.layers)
            ends = [node for node, layer in zip(plan.nodes, layers, strict=True) if layer.is_input or layer.reads_data]
            values = {v: tuple(given[plan.blobs[v]]) for node in ends for v in node.tops}
            _, shapes = fitted(plan, layers, values)
            self._fits = dict(given), {plan.blobs[v]: shape for v, shape in shapes.items()}
        return self._fits[1]

    def _kept(self) -> list[str]:
        if self.net.keep == "all":
            return list(dict.fromkeys(self.net.plan.blobs))
        return [self.net.keep] if isinstance(self.net.keep, str) else list(self.net.keep)

    def _losses(self) -> dict[str, float]:
        """Return the blobs that are part of the loss, and their weights."""
        weighted = {}
        for layer, row in zip(self.net.layers, self.net.loss_weights, strict=True):
            weighted.update({blob: w for blob, w in zip(layer.param.top, row, strict=False) if w})
        return weighted

    def _stamps(self) -> tuple[Stamp, ...]:
        return tuple(stamp(parameter) for parameter in self.net.parameters())

    def _current(self, blobs: tuple[str, ...]) -> Model:
        """Return the model of the net as it is, with these blobs."""
        if self._model is None or self._opened_for != (self._stamps(), blobs):
            self._model = Model(self._choice, self._origin(blobs), lambda path: self._write(path, blobs))
            if self._as_loaded == self._exported:
                self._as_loaded = self._stamps()
            self._opened_for = (self._stamps(), blobs)  # the export, too, counts as handing them out
        return self._model

    def _origin(self, blobs: tuple[str, ...]) -> Origin | None:
        """Return what the net is made of; None where its parameters are no longer, or never were, those of files."""
        self._exported = self._stamps()
        if self._exported != self._as_loaded or (not self._weights and self._exported):
            return None
        shapes = {blob: self.net.shapes[blob] for blob in self._data_blobs()}
        options = {"level": self._level, "stages": self._stages, "blobs": blobs, "shapes": shapes}
        return Origin([self._path, *self._weights], options)

    def _data_blobs(self) -> list[str]:
        layers = [layer for layer in self.net.layers if layer.reads_data or layer.is_input]
        return [blob for layer in layers for blob in layer.param.top]

    def _write(self, path: Path, blobs: tuple[str, ...]) -> None:
        net = self.net
        if self._readers:
            shapes = {blob: self.net.shapes[blob] for i in self._readers for blob in self.net.layers[i].param.top}
            net = Source(self._path, (), "TEST", self._level, self._stages, shapes).net()
            net.share_weights_with(self.net)
        write_model(net, path, [blob for blob in blobs if blob not in self._data_blobs()])
        gc.collect()  # the writer's parts refer to each other, and to arrays that share the parameters' memory


def _array(value: Array) -> np.ndarray:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    return np.asarray(value, np.float32)
