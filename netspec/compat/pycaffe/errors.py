"""Errors for programs written for pycaffe. Where Caffe would abort, an exception has Caffe's message.

Exceptions of the code of a Python layer, while a net is built, are raised unchanged.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from netspec.errors import SpecError

_LABELS = (
    "outer_num_ * inner_num_ == bottom[1]->count() ({1} vs. {0}) Number of labels must match number of predictions; "
    "e.g., if softmax axis == 1 and prediction shape is (N, C, H, W), label count (number of labels) must be N*H*W, "
    "with integer values in {{0, 1, ..., C-1}}."
)
#: Our messages, and the check in Caffe that fails for the same fault.
_CHECKS = [
    (r'unknown layer type "(.*?)"', "registry.count(type) == 1 (0 vs. 1) Unknown layer type: {0}"),
    (
        r"has (\d+) values from axis \d+ on, expected (\d+)",
        "K_ == new_K ({1} vs. {0}) Input size incompatible with inner product parameters.",
    ),
    (
        r"does not fit the filters, made for (\d+) channels",
        "bottom[0]->shape(channel_axis_) == channels_ Input size incompatible with convolution kernel.",
    ),
    (r"found (\d+) labels, shape .* for (\d+) predictions", _LABELS),
    (
        r"expected equal shapes except along axis",
        "top_shape[j] == bottom[i]->shape(j) All inputs must have the same shape, except at concat_axis.",
    ),
    (r"expected equal shapes$", "bottom[0]->shape() == bottom[i]->shape()"),
    (r"kernel_size .* is missing", "kernel_shape_data[i] > 0 Filter dimensions must be nonzero."),
    (
        r"expected a binary NetParameter",
        "ReadProtoFromBinaryFile(param_file, param) Failed to parse NetParameter file: {file}",
    ),
]
_WORDS = [(r'unknown bottom blob "(.*?)"', "Unknown bottom blob '{0}' (layer '{layer}'")]


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
    for table, prefix, end in ((_CHECKS, "Check failed: ", ""), (_WORDS, "", ")")):
        for pattern, words in table:
            if found := re.search(pattern, fault.message):
                return prefix + words.format(*found.groups(), **known) + end
    return None


DISTRIBUTIONS = {"skimage": "scikit-image", "pydot": "pydot", "fissix": "fissix"}


def load(module: str, extra: str, purpose: str) -> Any:
    """Import a module of an extra. Raises ImportError with one line that says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        name = DISTRIBUTIONS[module.partition(".")[0]]
        message = f"{purpose} needs {name}: pip install {name}, or pip install 'netspec-caffe[{extra}]'"
        raise ImportError(message) from fault
