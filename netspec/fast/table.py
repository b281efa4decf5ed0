"""The table of entries by class. A layer whose class has none, such as a user's subclass, runs by its ``forward``."""

from __future__ import annotations

from netspec.fast.entry import Entry
from netspec.fast.folding import Folds
from netspec.fast.kernels import Inference, Kernel, Learning
from netspec.fast.layers import activation, common, contrast, dialects, loss, normalization, scale, utility, vision
from netspec.layers.contract.base import Layer
from netspec.run.recorded import Kernels

ENTRIES: dict[type[Layer], Entry] = {
    **activation.ENTRIES,
    **common.ENTRIES,
    **contrast.ENTRIES,
    **loss.ENTRIES,
    **normalization.ENTRIES,
    **scale.ENTRIES,
    **utility.ENTRIES,
    **vision.ENTRIES,
}
_NONE = Entry()


def entry_of(layer: Layer) -> Entry:
    """Return the entry of a layer's class, or an empty one."""
    cls = type(layer)
    return ENTRIES.get(cls) or dialects.ENTRIES.get(f"{cls.__module__}.{cls.__qualname__}") or _NONE


def folds_of(layer: Layer) -> Folds:
    """Return how a layer can be joined with its neighbors."""
    return entry_of(layer).folds(layer)


def is_fresh(layer: Layer) -> bool:
    """Return whether a layer's single top has memory of its own, not that of a bottom."""
    fresh = entry_of(layer).fresh
    return fresh(layer) if callable(fresh) else fresh


def inference_kernel(layer: Layer, how: Inference) -> Kernel | None:
    """Return a layer's kernel for runs without gradients, at its present shapes; None if it has none."""
    return entry_of(layer).inference(layer, how)


def learning_kernels(layer: Layer, how: Learning) -> Kernels | None:
    """Return a layer's kernels for training, at its present shapes; None if it has none."""
    return entry_of(layer).learning(layer, how)


def learns_alone(layer: Layer) -> bool:
    """Return whether a layer has its own kernels for training at its present shapes."""
    how = Learning((True,) * len(layer.bottom_shapes), (None,) * len(layer.blobs))
    return learning_kernels(layer, how) is not None
