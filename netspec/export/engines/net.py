"""A runner that uses an engine: it computes the forward passes, and the net does everything else."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from netspec.data.blobs import Shape
from netspec.export.engines.choice import Choice
from netspec.export.engines.model import Model, Origin
from netspec.export.engines.runners import Unable, warn_unable
from netspec.export.exporter import layer_notes
from netspec.export.formats.convert import Source
from netspec.export.formats.onnx import export_onnx
from netspec.graph.options import TORCH, BuildOptions
from netspec.graph.plan import origins
from netspec.layers.contract.learned import Seen, blobs_of, may_have_alias
from netspec.net.net import Net
from netspec.proto.schema import PHASE_NAMES, TEST
from netspec.run.shapes import fitted
from netspec.run.walk import Result, walk, weighted_sum


def write_model(net: Net, path: Path, blobs: Iterable[str] = ()) -> None:
    """Write a net as an ONNX model. ``blobs`` that are not inputs become additional outputs.

    Raises SpecError if a layer cannot be exported. Raises Unable if an exported layer would compute something
    else, and for a blob that the model does not have.
    """
    import onnx

    if notes := layer_notes(net.layers):
        raise Unable(notes[0])
    export_onnx(net, path, largest=0)
    model = onnx.load(str(path), load_external_data=False)
    there = {output.name for output in model.graph.output} | {given.name for given in model.graph.input}
    made = {name for node in model.graph.node for name in node.output}
    for blob in blobs:
        if blob in there:
            continue
        if blob not in made:
            raise Unable(f'blob "{blob}" is not in the exported net')
        model.graph.output.append(onnx.helper.make_tensor_value_info(blob, onnx.TensorProto.FLOAT, None))
    path.write_bytes(model.SerializeToString())


Write = Callable[[Path, Sequence[str]], None]  # exports the net to a path, with these blobs as additional outputs


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
    weights, write = list(weights), _writer(net, Path(path))
    origin = Origin([path, *weights], {"level": net.options.level or 0, "stages": tuple(net.options.stages)})
    net.runners.insert(0, Engine(net, choice, origin if weights else None, write))
    return net


class Engine:
    """Runs a net with an engine. It keeps the plan of ``net``, and its layers, because they read the data.

    ``origin`` names the files that the net is made from; it is None if the parameters are random. ``write`` exports the
    net. Outputs have no gradient. Torch runs a pass if an input requires a gradient, and every pass after the engine
    has failed. After a change of the parameters the net is exported again. While an alias of a parameter is alive
    (``.data``, an array), a change could be missed, so torch runs the net.
    """

    def __init__(self, net: Net, choice: Choice, origin: Origin | None, write: Write) -> None:
        self._plan, self._layers, self._exact = net.plan, list(net.layers), net.options.exact
        self._choice, self._from, self._write = choice, origin, write
        self._blobs = blobs_of(net.layers)
        self._loaded = self._exported = Seen(self._blobs(), values=True)  # when it was loaded, and exported
        losses = list(zip(net.plan.nodes, net.eager.losses, strict=True))
        # The values of named losses, and their weights.
        self._weighted = [(node.tops[j], w) for node, own in losses for j, w in own if j < len(node.tops)]
        # A loss without a top is no value of the model: torch computes it from its bottoms.
        unnamed = {i for i, (node, own) in enumerate(losses) if any(j >= len(node.tops) for j, _ in own)}
        self._unnamed = [step for step in net.eager.one_by_one() if step.node in unnamed]
        first = origins(net.plan, [layer.passes_on for layer in net.layers])
        self._read = {v: first[v] for step in self._unnamed for v in step.bottoms}
        self._readers = [step for step in net.eager.one_by_one() if self._layers[step.node].reads_data]
        layers = zip(net.plan.nodes, net.layers, strict=True)
        ends = [node for node, layer in layers if layer.is_input or layer.reads_data]
        self._ends = {
            v: net.plan.blobs[v] for node in ends for v in node.tops
        }  # inputs, and tops of layers that read data
        self._built = {blob: net.shapes[blob] for blob in self._ends.values()}
        self._model: Model | None = None
        self._opened_for: tuple[str, ...] = ()  # the blobs of the model
        self._unable, self._warned = False, False
        self._fits: tuple[dict[int, Shape], dict[int, Shape]] = {}, {}  # shapes of inputs and of all values

    def run(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result | None:
        """Run the net on the values of its inputs. Return None if torch must run it."""
        if self._unable or any(value.requires_grad for value in given.values()) or self._may_change_unseen():
            return None
        try:
            return self._pass(given, kept)
        except Unable as fault:
            warn_unable(self._choice, str(fault))
            self._unable = True
            return None

    def _may_change_unseen(self) -> bool:
        """Return whether the parameters could be changed through an alias. Warn the first time."""
        aliased = any(map(may_have_alias, self._blobs()))
        if aliased and not self._warned:
            self._warned = True
            warn_unable(self._choice, "a program could change the parameters through .data or an array it holds")
        return aliased

    def _pass(self, given: Mapping[int, torch.Tensor], kept: frozenset[int]) -> Result:
        names = self._plan.blobs
        if any(names[v] in names[v + 1 :] for v in self._read.values()):
            raise Unable("a loss without a top reads a blob that is changed afterwards")
        wanted = (*sorted(kept), *(v for v, _ in self._weighted), *self._read.values())
        model = self._current(tuple(dict.fromkeys(names[v] for v in wanted)))
        values = dict(given)
        walk(self._readers, values, self._exact)
        shapes = self._shapes({v: tuple(values[v].shape) for v in self._ends})
        arrays = {names[v]: _array(values[v]) for v in self._ends}
        found = {**arrays, **model.run(arrays)}
        for v in wanted:
            if shapes.get(v, found[names[v]].shape) != found[names[v]].shape:
                raise Unable(f"{names[v]} has shape {found[names[v]].shape} there, expected {shapes[v]}")
        values = {v: torch.from_numpy(found[names[v]]) for v in wanted}
        loss = torch.zeros(())
        for v, weight in self._weighted:
            loss = loss + weighted_sum(values[v], weight, self._exact)
        if self._unnamed:
            read = {v: values[first] for v, first in self._read.items()}
            loss = loss + (walk(self._unnamed, read, self._exact) or 0)
        return loss, values

    def _shapes(self, given: dict[int, Shape]) -> dict[int, Shape]:
        """Return the shapes of the values for these inputs. Raises SpecError if a layer refuses them."""
        if given != self._fits[0]:
            self._fits = given, fitted(self._plan, self._layers, given)[1]
        return self._fits[1]

    def _current(self, blobs: tuple[str, ...]) -> Model:
        """Return the model of the net with its current parameters and these blobs."""
        if self._model is None or self._opened_for != blobs or not self._exported.are(self._blobs()):
            computed, as_loaded = [blob for blob in blobs if blob not in self._built], self._loaded.are(self._blobs())
            origin = self._origin(blobs) if as_loaded else None
            self._model = Model(self._choice, origin, lambda path: self._write(path, computed))
            self._opened_for = blobs
            self._exported = Seen(self._blobs(), values=True)  # after the export, which hands out aliases
            if as_loaded:
                self._loaded = self._exported
        return self._model

    def _origin(self, blobs: tuple[str, ...]) -> Origin | None:
        """Return the files and options that the net is made from; None if its parameters do not come from files."""
        if self._from is None and self._blobs():
            return None
        files, options = (self._from.files, self._from.options) if self._from else ([], {})
        return Origin(files, {**options, "blobs": blobs, "shapes": self._built})


def _writer(net: Net, path: Path) -> Write:
    """Return a function that exports ``net``, which was read from ``path``. It does not keep the net alive."""
    held, chosen = weakref.ref(net), net.options
    readers = [blob for layer in net.layers if layer.reads_data for blob in layer.param.top]

    def write(to: Path, blobs: Sequence[str]) -> None:
        original = held()
        assert original is not None, "the caller runs it"
        if readers:
            shapes = {blob: original.shapes[blob] for blob in readers}
            given = BuildOptions(level=chosen.level, stages=chosen.stages, given_shapes=shapes)
            copy = Source(path, options=given).net()
            copy.share_weights_with(original)
            original = copy
        write_model(original, to, blobs)
        gc.collect()  # the writer's parts refer to each other, and to arrays that share the parameters' memory

    return write


def _array(value: torch.Tensor) -> np.ndarray:
    return np.asarray(value.detach().cpu().numpy(), np.float32)
