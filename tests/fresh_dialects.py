"""Dialects for one test."""

import sys

import pytest

from netspec.dialects import known
from netspec.dialects.files import OF_FILES
from netspec.layers import layer_class
from netspec.layers.contract import registry
from netspec.proto.forks import forks
from netspec.proto.schema import given
from netspec.proto.text import parse_net_text


def fresh_dialects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a test add dialects for every net; afterwards there are none."""
    from netspec.compat.pycaffe.proto import caffe_pb2

    assert known.added() == ()
    monkeypatch.setattr(caffe_pb2, "_of_net", ())
    monkeypatch.setattr(known, "_added", {})
    for module in [name for name in sys.modules if name.startswith(OF_FILES)]:
        del sys.modules[module]  # another test's file of the same name


def used_by(text: str) -> list[str]:
    """Return the dialects of a net's fields, in the order of the text, then those of its layer types.

    Unknown fields are left out.
    """
    net, _ = parse_net_text(text, "net.prototxt", report=lambda fault: None)
    order = list(dict.fromkeys(dialect for layer in net.layer for dialect in _dialects_in(layer)))
    for layer in net.layer:
        cls = layer_class(layer.type)
        owners = forks().additions().types.get(layer.type, ()) if cls and layer.type not in registry._LAYERS else ()
        order += [name for name in owners if name not in order]
    return order


def _dialects_in(message) -> list[str]:
    found = []
    for field in given(message):
        if field.descriptor.is_extension:
            found.append(field.descriptor.file.package.rpartition(".")[2])
        elif field.descriptor.message_type:
            values = field.get(message)
            for value in values if field.repeated else [values]:
                found += _dialects_in(value)
    return found
