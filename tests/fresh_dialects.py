"""Dialects for one test: registry and schema are afterwards as they were before."""

import sys
from collections.abc import Iterator
from copy import copy

import pytest

from netspec.layers.contract import registry
from netspec.proto.dialect import files
from netspec.proto.dialect import registry as dialect


def keep_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let what is registered from now on be forgotten afterwards."""
    for name in ("_LAYERS", "_OWNERS", "_REPLACING", "_everywhere"):
        monkeypatch.setattr(registry, name, copy(getattr(registry, name)))


def fresh_dialects(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let a test use dialects; switch them off when it is done."""
    assert dialect.active() == []
    files.announce_known()
    monkeypatch.setattr(dialect, "_known", dict(dialect._known))
    keep_registry(monkeypatch)
    before = set(sys.modules)
    yield
    files.waiting.clear()  # switched on, never run
    for name in dialect.active():
        dialect.deactivate(name)
    own = {file.module for file in files.known_files().values()} & sys.modules.keys()
    for name in own | {name for name in sys.modules.keys() - before if name.startswith("netspec_dialect_")}:
        del sys.modules[name]
