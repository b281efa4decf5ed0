"""A layer's settings in a few words, whatever its type: ``5×5, 20, stride 2``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec.proto.schema import fields_of
from netspec.proto.writer import scalar_text

MOST = 6  # settings that are shown
OWN = "_param"  # how the names of the fields end that hold a layer's own settings
COMMON = ("loss_param", "transform_param")  # and of those, these belong to many layers
SILENT = ("engine", "bias_term", "axis", "source", "backend", "root_folder", "mean_file", "prefetch", "rand_skip")
WINDOWS = {"kernel_size": ("kernel_h", "kernel_w"), "stride": ("stride_h", "stride_w"), "pad": ("pad_h", "pad_w")}
DEFAULTS = {"kernel_size": "0", "stride": "1", "pad": "0"}
USUAL = (("group", "1"), ("dilation", "1"))


def settings_text(layer: Any) -> str:
    """Return what the prototxt says of a layer's own settings; messages in them (fillers, lists of shapes) are not."""
    words: list[str] = []
    for name, field in fields_of(layer.DESCRIPTOR).items():
        if name.endswith(OWN) and name not in COMMON and not field.repeated and field.present(layer):
            words += _words(field.get(layer))
    return ", ".join(words[:MOST])


def _words(param: Any) -> Iterator[str]:
    given: dict[str, Any] = {}
    for field in fields_of(param.DESCRIPTOR).values():
        name = field.name
        if field.type != Declared.TYPE_MESSAGE and field.present(param) and name not in SILENT:
            given[name] = _value(field, field.get(param))
    for name, (high, wide) in WINDOWS.items():
        sizes = given[name].split("×") if name in given else [given.pop(side, DEFAULTS[name]) for side in (high, wide)]
        given.pop(name, None)
        if set(sizes) == {DEFAULTS[name]}:
            continue
        same = len(set(sizes)) == 1
        given[name] = (
            f"{sizes[0]}×{sizes[0]}" if same and name == "kernel_size" else sizes[0] if same else "×".join(sizes)
        )
    for name in ("kernel_size", "num_output", "pool"):
        if name in given:
            yield given.pop(name)
    for name, value in given.items():
        if value == "true":
            yield name.replace("_", " ")
        elif (name, value) not in USUAL:
            yield f"{name.replace('_', ' ')} {value}" if not value.isupper() else value


def _value(field: Any, value: Any) -> str:
    values = list(value) if field.repeated else [value]
    separator = "×" if field.name in WINDOWS else " "
    return separator.join(each if isinstance(each, str) else scalar_text(field, each) for each in values)
