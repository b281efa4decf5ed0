"""Dialects are off again after each test."""

from collections.abc import Iterator

import pytest

from fresh_dialects import fresh_dialects


@pytest.fixture(autouse=True)
def _leave_no_dialect(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from fresh_dialects(monkeypatch)
