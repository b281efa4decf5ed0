"""Errors for programs written for pycaffe. Where Caffe would abort, an exception has Caffe's message.

Exceptions of the code of a Python layer, while a net is built, are raised unchanged.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from netspec.errors import Code, SpecError

_LABELS = (
    "Check failed: outer_num_ * inner_num_ == bottom[1]->count() ({1} vs. {0}) "
    "Number of labels must match number of predictions; "
    "e.g., if softmax axis == 1 and prediction shape is (N, C, H, W), label count (number of labels) must be N*H*W, "
    "with integer values in {{0, 1, ..., C-1}}."
)
#: What Caffe says where an error has this code. The numbers are those of the error's details.
_WORDS = {
    Code.UNKNOWN_TYPE: "Check failed: registry.count(type) == 1 (0 vs. 1) Unknown layer type: {0}",
    Code.INPUTS: "Check failed: K_ == new_K ({1} vs. {0}) Input size incompatible with inner product parameters.",
    Code.CHANNELS: "Check failed: bottom[0]->shape(channel_axis_) == channels_ "
    "Input size incompatible with convolution kernel.",
    Code.LABELS: _LABELS,
    Code.SHAPES_BESIDE_AXIS: "Check failed: top_shape[j] == bottom[i]->shape(j) "
    "All inputs must have the same shape, except at concat_axis.",
    Code.SHAPES: "Check failed: bottom[0]->shape() == bottom[i]->shape()",
    Code.NO_KERNEL_SIZE: "Check failed: kernel_shape_data[i] > 0 Filter dimensions must be nonzero.",
    Code.NOT_BINARY: "Check failed: ReadProtoFromBinaryFile(param_file, param) Failed to parse {0} file: {file}",
    Code.UNKNOWN_BOTTOM: "Unknown bottom blob '{0}' (layer '{layer}')",
}


class CheckError(SpecError):
    """A fault for which Caffe aborts. The text is our message, followed by the check that fails in Caffe."""


@contextmanager
def caffes_errors() -> Iterator[None]:
    """Turn a SpecError into a :class:`CheckError` if Caffe's message for the fault is known.

    If the code of a Python layer raised an exception, that exception is raised instead of the SpecError.
    """
    try:
        yield
    except SpecError as fault:
        if isinstance(fault.__cause__, Exception):
            raise fault.__cause__ from fault
        words = None if isinstance(fault, CheckError) else _caffes_words(fault)
        if words is None:
            raise
        raise CheckError(f"{fault.message} ({words})", fault.where) from None


def _caffes_words(fault: SpecError) -> str | None:
    where = fault.where
    known = {"file": where.file if where else "", "layer": where.layer if where else ""}
    return _WORDS[fault.code].format(*fault.details, **known) if fault.code in _WORDS else None


def load(module: str, purpose: str) -> Any:
    """Import a module of scikit-image. Raises ImportError with one line that says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        message = f"{purpose} needs scikit-image: pip install scikit-image, or pip install 'netspec-caffe[pycaffe]'"
        raise ImportError(message) from fault
