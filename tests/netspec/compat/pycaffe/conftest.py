"""Makes nets for tests of pycaffe, from text, in a temporary working directory."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import netspec.pycaffe as caffe
from netspec.compat.pycaffe import mode


@pytest.fixture(autouse=True)
def _same_weights_in_every_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mode, "_mode", mode._Mode(seed=1))


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """``write(text, name="net.prototxt")``: the path of a file with that text."""
    monkeypatch.chdir(tmp_path)

    def write_text(text: str, name: str = "net.prototxt") -> str:
        Path(name).write_text(text)
        return name

    return write_text


@pytest.fixture
def net_of(write: Callable[..., str]) -> Callable[..., caffe.Net]:
    """``net_of(text, phase=caffe.TEST, **options)``: the net of a prototxt's text."""

    def build(text: str, phase: int = caffe.TEST, **options: Any) -> caffe.Net:
        return caffe.Net(write(text), phase, **options)

    return build
