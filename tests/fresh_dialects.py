"""Dialects for one test. Afterwards the registry and the schema are restored."""

import sys
from collections.abc import Iterator
from copy import copy

import pytest

from netspec.dialects import files, layers
from netspec.dialects import registry as dialect
from netspec.layers import layer_class
from netspec.layers.contract import registry
from netspec.proto.text import parse_net_text


def keep_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the registry of layers after the test."""
    monkeypatch.setattr(registry, "_LAYERS", copy(registry._LAYERS))
    for name in ("_owners", "_replacing", "_everywhere"):
        monkeypatch.setattr(layers, name, copy(getattr(layers, name)))


def fresh_dialects(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let a test use dialects; switch them off when it is done."""
    assert dialect.active() == []
    files.announce_known()
    monkeypatch.setattr(dialect, "_known", dict(dialect._known))
    keep_registry(monkeypatch)
    before = set(sys.modules)
    yield
    files.waiting.clear()  # activated, but their layers were never used
    for name in dialect.active():
        dialect.deactivate(name)
    own = {file.module for file in files.known_files().values()} & sys.modules.keys()
    for name in own | {name for name in sys.modules.keys() - before if name.startswith("netspec_dialect_")}:
        del sys.modules[name]


def activated_by(text: str) -> list[str]:
    """Read a net, where unknown fields are left out, and look its layers up; return the dialects that are then active.

    The first are those of fields, in the order of the text.
    """
    order: list[str] = []
    net, _ = parse_net_text(text, "net.prototxt", report=lambda fault: None)
    order += dialect.active()
    for layer in net.layer:
        layer_class(layer.type)
        order += [name for name in dialect.active() if name not in order]
    return order
