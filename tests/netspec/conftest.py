"""Fixtures that build a net from text, collect warnings, copy golden folders, and run commands."""

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from gradients import check_gradients
from netspec.cli import main
from netspec.errors import Report, raise_fault
from netspec.exact.machine import other_bits
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.layers import Layer
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST, PhaseValue
from netspec.proto.text import parse_net_text
from paths import GOLDEN


@pytest.fixture(autouse=True)
def _the_same_numbers_in_every_run() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def caffes_bits() -> bool:
    """Whether BLAS and the C library compute the bits of those with which Caffe computed the golden files.

    BLAS does with the kernels for AVX-512, the C library if its functions round as those of glibc 2.36.
    """
    return not other_bits()


@pytest.fixture(scope="session")
def rounding(caffes_bits: bool) -> float:
    """What may be left of values that cancel to exactly zero where the bits are Caffe's."""
    return 0.0 if caffes_bits else 1e-6


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
    """``net_of(text, phase=TEST, report=raise_fault, **options)``: the net of a prototxt's text, ``net.prototxt``."""

    def build(text: str, phase: PhaseValue = TEST, report: Report = raise_fault, **options: Any) -> Net:
        net, source = parse_net_text(text, "net.prototxt")
        return build_net(
            with_state(net, phase),
            source.reporting_to(report),
            BuildOptions(**{"seed": 0, "speed": speed(), **options}),
        )

    return build


@pytest.fixture
def gradcheck() -> Callable[..., None]:
    """``gradcheck(layer, *bottoms, fixed=())``: in double, the gradients of bottoms and blobs are the function's.

    ``fixed`` are bottoms that get none.
    """

    def check(layer: Layer, *bottoms: torch.Tensor, fixed: Sequence[int] = ()) -> None:
        layer.double()
        inputs = [bottom.double().requires_grad_(i not in fixed) for i, bottom in enumerate(bottoms)]
        learned = [blob for j, blob in enumerate(layer.blobs) if layer.param_spec(j, None).lr_mult]
        check_gradients(lambda *args: layer.run(*args[: len(inputs)])[0], (*inputs, *learned))

    return check


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    """``warnings()``: the messages of the warnings so far."""
    return lambda: [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


@dataclass(frozen=True)
class Result:
    status: int
    out: str
    err: str

    @property
    def fault(self) -> str:
        """The line, after what the log may have said, that says what is wrong."""
        assert self.status == 1, self.err
        assert "Traceback" not in self.err
        return self.err.splitlines()[-1]

    @property
    def messages(self) -> list[str]:
        """The sentences of the log, without glog's prefix."""
        return [line.partition("] ")[2] for line in self.err.splitlines() if _is_log(line)]


def _is_log(line: str) -> bool:
    return line[:1] in "IWE" and line[1:5].isdigit()


@pytest.fixture
def run(work_in: Callable[..., Path], capfd: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """``run(*words)``: one command, in a folder with a golden training and its pairs."""
    work_in("train/sgd_step")

    def run_command(*words: object) -> Result:
        capfd.readouterr()
        status = main([str(word) for word in words])
        said = capfd.readouterr()
        return Result(status, said.out, said.err)

    return run_command


@pytest.fixture
def edited(run: Callable[..., Result]) -> Callable[..., str]:
    """``edited(path, old, new, ...)``: the path of a copy of a prototxt in which texts are replaced."""

    def edit(path: str, *changes: str) -> str:
        text = Path(path).read_text()
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in text
            text = text.replace(old, new, 1)
        copy = Path("edited.prototxt")
        copy.write_text(text)
        return str(copy)

    return edit
