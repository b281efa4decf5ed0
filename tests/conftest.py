"""What all tests share: one thread a process, so that runs in parallel stay quick, and a fake GPU."""

import signal
from collections.abc import Iterator

import pytest

from fresh_dialects import fresh_dialects


@pytest.fixture(autouse=True, scope="session")
def _interrupts_are_heard() -> None:
    """Where the tests run in the background, a shell may have SIGINT ignored, and children inherit that."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _no_dialect_is_left_on(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from fresh_dialects(monkeypatch)


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _fake_gpu() -> None:
    import fake_gpu  # noqa: F401  autograd counts the devices at its first backward pass
