"""Settings of all tests: each must leave the process unchanged, and torch uses one thread, for fast parallel runs.

torch is imported only in processes that run tests, not in the one that distributes them.
"""

import gc
import logging
import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from fresh_dialects import fresh_dialects
from netspec.files.limits import no_collection

LIBRARIES = (
    "PYTEST",
    "TORCH",
    "_TORCH",
    "TRITON",
    "KMP",
    "OPENCV",
    "QT",
)  # libraries that set variables when they are used
LOGGERS = [logging.getLogger(name) for name in ("", "netspec", "loopclosure", "lmdb_build")]
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def pytest_configure(config: pytest.Config) -> None:
    """Refuse a path that does not exist; pytest-xdist would run no test and not say why."""
    for argument in config.args:
        if not (config.invocation_params.dir / argument.partition("::")[0]).exists():
            raise pytest.UsageError(f"file or directory not found: {argument}")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Pyright takes the longest and comes first, then tests of pages, site, wheel and examples.

    In a parallel run, the last tests are then short, and the site is built only once.
    """
    items.sort(key=lambda item: (item.path.name != "test_types.py", item.path.parent != Path(__file__).parent))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without Python's garbage collector, and leave what was made until then out of its later passes.

    It would go through millions of objects, which all stay, again and again: 3 of 8 seconds, in each process.
    """
    with no_collection():
        collected = yield
    gc.freeze()
    return collected


def pytest_collection_finish() -> None:
    """Set up a process that runs tests; in a parallel run, not the one that distributes them."""
    import torch

    import fake_gpu  # noqa: F401  autograd counts the devices at its first backward pass
    from netspec.compat.pycaffe import logs

    torch.set_num_threads(1)
    logs.stop()  # importing pycaffe shows Caffe's log from then on; here pytest keeps it
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # in the background; children would inherit that
        signal.signal(signal.SIGINT, signal.default_int_handler)


def settings() -> dict[str, Any]:
    """Return the settings of the process that tests must not change, because other tests depend on them."""
    import torch

    return {
        **{name: value for name, value in os.environ.items() if not name.startswith(LIBRARIES)},
        "folder": os.getcwd(),
        "handlers of signals": [signal.getsignal(number) for number in SIGNALS],
        "loggers": [(log.name, log.level, log.propagate, log.disabled, list(log.handlers)) for log in LOGGERS],
        "torch's settings": (
            torch.get_num_threads(),
            torch.get_default_dtype(),
            torch.is_grad_enabled(),
            torch.are_deterministic_algorithms_enabled(),
            torch.get_float32_matmul_precision(),
        ),
    }


@pytest.fixture(autouse=True)
def _the_process_is_left_as_it_was() -> Iterator[None]:
    before = settings()
    yield
    after = settings()
    left = {name: after.get(name) for name in before.keys() | after.keys() if after.get(name) != before.get(name)}
    assert not left, f"this test leaves behind: {left}"


@pytest.fixture(autouse=True)
def _no_dialect_stays_added(_the_process_is_left_as_it_was: None, monkeypatch: pytest.MonkeyPatch) -> None:
    fresh_dialects(monkeypatch)
