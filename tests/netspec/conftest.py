"""How tests build a net from text, and keep what it warns of."""

import logging
from collections.abc import Callable

import pytest

from netspec.graph.filter import with_state
from netspec.net import BuildOptions, Net, build_net
from netspec.proto.text import parse_net_text


@pytest.fixture
def net_of() -> Callable[..., Net]:
    """``net_of(text, phase=1, **options)``: the net of a prototxt's text; faults are in ``net.prototxt``."""

    def build(text: str, phase: int = 1, **options: object) -> Net:
        net, source = parse_net_text(text, "net.prototxt")
        return build_net(with_state(net, phase), source, BuildOptions(**{"seed": 0, **options}))

    return build


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    """``warnings()``: the messages of the warnings so far."""
    return lambda: [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
