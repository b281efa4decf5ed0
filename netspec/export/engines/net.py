"""A runner that uses an engine: it computes the forward passes, and the net does everything else."""

from __future__ import annotations

import gc
import hashlib
import weakref
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np
import torch

from netspec.data.blobs import Shape
from netspec.export.engines.cache import key_of
from netspec.export.engines.choice import Choice
from netspec.export.engines.model import Model, Unable, warn_unable
from netspec.export.exporter import layer_notes
from netspec.export.formats.onnx import export_onnx
from netspec.export.formats.shapes import is_given
from netspec.graph.options import TORCH
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.learned import Seen, blobs_of, may_have_alias, values_of
from netspec.net.net import Net
from netspec.proto.schema import PHASE_NAMES, TEST
from netspec.run.shapes import fitted
from netspec.run.walk import Result, walk, weighted_sum


def write_model(net: Net, path: Path, blobs: Collection[str] = ()) -> None:
    """Write a net as an ONNX model, with these blobs as additional outputs.

    Raises SpecError if a layer cannot be exported, and Unable if an exported layer would compute something else.
    """
    if notes := layer_notes(net.layers):
        raise Unable(notes[0])
    export_onnx(net, path, largest=0, blobs=blobs)


def with_engine(net: Net, choice: Choice, path: str | Path, weights: Iterable[str | Path]) -> Net:
    """Let the chosen engine run a net that was read from ``path`` and ``weights``; return the net.

    Torch runs the net if it was chosen, or if the engine cannot run it; a warning says why.
    """
    reason = ""
    if choice.engine != TORCH and net.phase != TEST:
        reason = f"it runs nets in phase TEST, but this net is in phase {PHASE_NAMES[net.phase]}"
    elif choice.engine != TORCH and net.device.type != "cpu":
        reason = f"it runs on the CPU, but this net is on {net.device}"
    if choice.engine == TORCH or reason:
        warn_unable(choice, reason)
        return net
    net.runners.insert(0, Engine(net, choice, path if list(weights) or not net.learnable else None))
    return net


class Engine:
    """Runs a net with an engine. It keeps the plan of ``net``, and its layers, because they read the data.

    The model is kept in the cache if the net is that of the file ``prototxt``, which is None for random parameters.
    Outputs have no gradient. Torch runs a pass if an input requires a gradient, and every pass after the engine has
    failed, or after an alias of a parameter (``.data``, an array) was alive, since its changes cannot be seen. After
    any other change of the parameters the net is exported again.
    """

    def __init__(self, net: Net, choice: Choice, prototxt: str | Path | None) -> None:
        self._plan, self._layers, self._exact = net.plan, list(net.layers), net.options.exact
        self._net, self._choice, self._prototxt = weakref.ref(net), choice, prototxt  # the net refers to its runners
        self._blobs = blobs_of(net.layers)
        self._loaded = self._exported = Seen(self._blobs(), values=True)  # when it was loaded, and exported
        losses = [(node.tops, own) for node, own in zip(net.plan.nodes, net.eager.losses, strict=True)]
        self._nameless = any(loss.top >= len(tops) for tops, own in losses for loss in own)  # a loss without a top
        self._losses = [] if self._nameless else [(tops[loss.top], loss.weight) for tops, own in losses for loss in own]
        self._readers = [step for step in net.eager.one_by_one() if isinstance(self._layers[step.node], DataLayer)]
        ends = [node for node, layer in zip(net.plan.nodes, net.layers, strict=True) if is_given(layer)]
        self._ends = {v: net.plan.blobs[v] for node in ends for v in node.tops}  # what the exported net is given
        self._built = {blob: net.shapes[blob] for blob in self._ends.values()}
        self._model: Model | None = None
        self._opened_for: tuple[str, ...] = ()  # the blobs of the model
        self._unable = False
        self._fits: tuple[dict[int, Shape], dict[int, Shape]] = {}, {}  # shapes of inputs and of all values

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net on the values of its inputs. Return None if torch must run it."""
        if self._unable or any(value.requires_grad for value in given.values()):
            return None
        try:
            if any(map(may_have_alias, self._blobs())):
                raise Unable("a program could change the parameters through .data or an array that it holds")
            return self._pass(given, kept)
        except Unable as fault:
            warn_unable(self._choice, str(fault))
            self._unable = True
            return None

    def _pass(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result:
        if self._nameless:
            raise Unable("it cannot compute a loss without a top")
        names = self._plan.blobs
        wanted = (*sorted(kept), *(v for v, _ in self._losses))
        for v in wanted:
            if names[v] in names[v + 1 :] or (v not in self._ends and names[v] in self._built):
                raise Unable(f"a layer changes {names[v]} in place")
        model = self._current(tuple(dict.fromkeys(names[v] for v in wanted)))
        values = dict(given)
        walk(self._readers, values, self._exact)
        shapes = self._shapes({v: tuple(values[v].shape) for v in self._ends})
        arrays = {blob: np.asarray(values[v].detach().cpu().numpy(), np.float32) for v, blob in self._ends.items()}
        found = {**arrays, **model.run(arrays)}
        for v in wanted:
            if shapes.get(v, found[names[v]].shape) != found[names[v]].shape:
                raise Unable(f"{names[v]} has shape {found[names[v]].shape} there, expected {shapes[v]}")
        made = {v: torch.from_numpy(found[names[v]]) for v in wanted}
        loss = sum((weighted_sum(made[v], weight, self._exact) for v, weight in self._losses), torch.zeros(()))
        return loss, made

    def _shapes(self, given: dict[int, Shape]) -> dict[int, Shape]:
        """Return the shapes of the values for these inputs. Raises SpecError if a layer refuses them."""
        if given != self._fits[0]:
            self._fits = given, fitted(self._plan, self._layers, given)[1]
        return self._fits[1]

    def _current(self, blobs: tuple[str, ...]) -> Model:
        """Return the model of the net with its current parameters and these blobs."""
        if self._model is None or self._opened_for != blobs or not self._exported.are(self._blobs()):
            key, as_loaded, net = "", self._loaded.are(self._blobs()), self._net()
            assert net is not None, "the caller runs it"
            if self._prototxt is not None and as_loaded:
                weights = hashlib.sha256()
                for blob in self._blobs():
                    weights.update(values_of(blob).contiguous().numpy().data)
                state = {"level": net.options.level, "stages": net.options.stages, "shapes": self._built}
                key = key_of([self._prototxt], {**state, "blobs": blobs, "weights": weights.hexdigest()})
            self._model = Model(self._choice, key, lambda path: write_model(net, path, blobs))
            self._opened_for = blobs
            gc.collect()  # the exporter's parts refer to each other, and to arrays that share the parameters' memory
            self._exported = Seen(self._blobs(), values=True)  # after the export, which hands out aliases
            if as_loaded:
                self._loaded = self._exported
        return self._model
