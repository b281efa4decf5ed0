"""``netspec export`` and ``netspec fold``, which convert the user's files to another format."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from netspec.errors import SpecError, Where
from netspec.export.formats.deploy import fold, with_inputs, write_caffe
from netspec.export.formats.inputs import prune
from netspec.export.formats.onnx import export_onnx
from netspec.export.formats.preprocess import Preprocess
from netspec.export.formats.torch import export_torch, write_tensors
from netspec.files.kinds import unreadable
from netspec.files.version import version
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.weights import check_names, load_weights
from netspec.proto.schema import PHASES
from netspec.proto.text import parse_net


@dataclass(frozen=True)
class Source:
    """The net to export: a prototxt, a phase, and weights files, which are loaded in order.

    ``options`` gives the level and stages, the shapes of inputs and of the tops of data layers, and whether Python
    layers may run. ``blobs``: only the layers that compute these are exported. Without ``labels``, layers that need
    labels (losses, accuracies) are left out.
    """

    file: Path
    weights: Sequence[Path] = ()
    phase: str = "TEST"
    options: BuildOptions = field(default_factory=BuildOptions)
    blobs: Sequence[str] = ()
    labels: bool = True

    def net(self) -> Net:
        """Return the net with its weights; layers that read data are inputs. Raises SpecError."""
        message, source = parse_net(self.file)
        message = with_state(message, PHASES[self.phase], self.options.level, self.options.stages)
        if self.blobs:
            message, source = prune(*filter_net(message, source), self.blobs, {})
        message, source = with_inputs(message, source, self.options, self.labels)
        net = build_net(message, source, replace(self.options, seed=0))
        if self.weights:
            load_weights(net, self.weights)
        return net

    def metadata(self) -> dict[str, str]:
        """Return the origin of an exported net."""
        found = {"prototxt": self.file.name, "prototxt.sha256": _sha256(self.file), "phase": self.phase}
        if self.weights:
            found["weights"] = ",".join(path.name for path in self.weights)
            found["weights.sha256"] = ",".join(_sha256(path) for path in self.weights)
        if self.options.level:
            found["level"] = str(self.options.level)
        if any(self.options.stages):
            found["stages"] = ",".join(self.options.stages)
        return {**found, "version": version()}

    @property
    def origin(self) -> str:
        """The origin of an exported net in a few words."""
        return " and ".join([self.file.name, *(path.name for path in self.weights)])


def export_net(source: Source, target: str, out: Path, preprocess: Preprocess | None = None) -> list[str]:
    """Write a net as ``onnx``, ``torch`` or ``safetensors``; return notes for the user, as lines.

    Raises SpecError for any error in the files, and for a layer that cannot be exported.
    """
    if not out.parent.is_dir():
        raise SpecError(f"there is no folder {out.parent}; create it first", Where(str(out)))
    net = source.net()
    if target == "onnx":
        if preprocess and preprocess.blob not in net.inputs:
            raise SpecError(
                f'no input "{preprocess.blob}" in this net; it has: {", ".join(net.inputs)}', Where(str(source.file))
            )
        return export_onnx(net, out, source.metadata(), preprocess)
    if target == "torch":
        return export_torch(net, out, source.origin)
    check_names(net, out)
    write_tensors(blob_tensors(net), out, source.metadata())
    return []


def blob_tensors(net: Net) -> dict[str, torch.Tensor]:
    """Return a net's learnable blobs in Caffe's order, as ``layer.index``. Shared blobs have their owner's name."""
    found: dict[str, torch.Tensor] = {}
    seen: set[int] = set()
    for layer in net.layers:
        for j, blob in enumerate(layer.blobs):
            if id(blob) not in seen:
                found[f"{layer.param.name}.{j}"] = layer.blob(j)
            seen.add(id(blob))
    return found


def fold_files(source: Source, prefix: Path) -> tuple[int, int]:
    """Write the folded net as PREFIX.prototxt and PREFIX.caffemodel; return the layer counts before and after."""
    if not prefix.parent.is_dir():
        raise SpecError(f"there is no folder {prefix.parent}; create it first", Where(str(prefix)))
    net = source.net()
    check_names(net, prefix)
    message = fold(net)
    write_caffe(message, prefix)
    splits = sum(layer.passes_on for layer in net.layers)
    return len(net.layers) - splits, len(message.layer)


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
