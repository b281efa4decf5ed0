"""Dialects that these nets activate are deactivated after each file of tests."""

import sys
from collections.abc import Iterator

import pytest

from fresh_dialects import keep_registry
from netspec.dialects import files as dialect_files
from netspec.dialects import registry as dialect


@pytest.fixture(autouse=True)
def _no_dialect_is_left_on() -> None:
    """Instead of the fixture for all tests: the tests of a file share their nets."""


@pytest.fixture(autouse=True, scope="module")
def _leave_no_dialect() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        keep_registry(patch)
        yield
    for name in dialect.active():
        dialect.deactivate(name)
    own = [file.module for file in dialect_files.known_files().values()]
    for name in [name for name in sys.modules if name in (*own, "netspec.dnn.opencv_layers")]:
        del sys.modules[name]
