"""How tests build a net from text, keep what it warns of, and get a folder to train in."""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from netspec.graph.filter import with_state
from netspec.net import BuildOptions, Net, build_net
from netspec.proto.text import parse_net_text

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.fixture
def work_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a function that copies a golden folder into the working directory, under a name of choice.

    ``pairs/`` is there beside it, as the paths in the golden files want it.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")

    def copy(source: str, name: str = "") -> Path:
        return Path(shutil.copytree(GOLDEN / source, name or Path(source).name))

    return copy


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
