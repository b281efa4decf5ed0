"""Optional libraries that tests need: a test is skipped where one is not installed."""

from types import ModuleType

import pytest

from netspec.data import database


def leveldb() -> ModuleType:
    """Return the library for LevelDB, which has another name from Python 3.12 on, or skip the test."""
    try:
        return database.leveldb()
    except ValueError as missing:
        pytest.skip(str(missing))
