"""The entries of all classes. A class without one, such as a subclass with another ``forward``, runs by ``forward``."""

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
    """Return the entry of a layer's class, an empty one where it has none."""
    cls = type(layer)
    return ENTRIES.get(cls) or dialects.ENTRIES.get(f"{cls.__module__}.{cls.__qualname__}") or _NONE


def folds_of(layer: Layer) -> Folds:
    """Return what a layer is to its neighbors."""
    return entry_of(layer).folds(layer)


def is_fresh(layer: Layer) -> bool:
    """Return whether a layer's one top is memory of its own, not a bottom's."""
    fresh = entry_of(layer).fresh
    return fresh(layer) if callable(fresh) else fresh


def inference_kernel(layer: Layer, how: Inference) -> Kernel | None:
    """Return the kernel of runs without gradients that a layer has for its present shapes."""
    return entry_of(layer).inference(layer, how)


def learning_kernels(layer: Layer, how: Learning) -> Kernels | None:
    """Return the kernels that a layer that learns has for its present shapes."""
    return entry_of(layer).learning(layer, how)


def learns_alone(layer: Layer, steady: bool = True) -> bool:
    """Return whether a layer that learns has kernels of its own at its present shapes."""
    how = Learning((True,) * len(layer.bottom_shapes), (None,) * len(layer.blobs), steady)
    return learning_kernels(layer, how) is not None
