"""Commands on a full disk, without their folder or beside another training: one line, and old files are unchanged."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from faults.commands import CASES
from netspec.cli import main
from netspec.proto.schema import NetParameter

resource = pytest.importorskip("resource", reason="limits the size of files")
pytestmark = pytest.mark.slow

MOST = 1500  # bytes of a file; all that the commands write is larger


@contextmanager
def full_disk() -> Iterator[None]:
    """Limit the size of files; the error differs from that of a full disk, but is handled in the same way."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    return tmp_path


def contents() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", CASES)
def test_a_command_on_a_full_disk_reports_one_line_and_keeps_old_files(
    name: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = CASES[name]
    case.prepare()
    assert case.main(case.words) == 0
    if name == "convert":
        shutil.rmtree("out/db")
    before = contents()
    capsys.readouterr()
    with full_disk():
        assert case.main(case.words) == 1
    *_, line = capsys.readouterr().err.strip().splitlines()
    assert "File too large" in line or "No space left on device" in line  # LMDB has its own message
    assert contents() == before


def test_a_missing_output_folder_is_reported(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = CASES["extract"]
    case.prepare()
    Path("out").rmdir()
    assert case.main(case.words) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert "No such file or directory" in line


NET = """
layer { name: "x" type: "DummyData" top: "x" top: "y" dummy_data_param { shape { dim: 8 dim: 90 } shape { dim: 8 } } }
layer { name: "o" type: "HDF5Output" bottom: "x" bottom: "y" hdf5_output_param { file_name: "out/o.h5" } }
"""


@pytest.fixture
def output_net(here: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """``output_net(command)``: run it on a net with HDF5Output whose file exists already."""
    Path("net.prototxt").write_text(NET)
    Path("w.caffemodel").write_bytes(NetParameter(name="of no layer").SerializeToString())
    with h5py.File("out/o.h5", "w") as file:
        file["data"] = np.ones(3)
    return lambda command: main(f"{command} --model net.prototxt --iterations 3".split())


def test_hdf5_output_on_a_full_disk_reports_one_line_and_keeps_the_old_file(
    output_net: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents()
    with full_disk():
        assert output_net("test --weights w.caffemodel") == 1
    assert 'HDF5 file "out/o.h5" cannot be written: File too large' in capsys.readouterr().err.splitlines()[-1]
    assert contents() == before
    assert output_net("test --weights w.caffemodel") == 0
    with h5py.File("out/o.h5") as file:
        assert {name: np.asarray(file[name]).shape for name in file} == {"data": (24, 90, 1, 1), "label": (24, 1, 1, 1)}


def test_time_and_check_do_not_write_the_file_of_hdf5_output(output_net: Callable[..., int]) -> None:
    before = contents()
    assert output_net("time") == 0
    assert main(["check", "net.prototxt", "--data"]) == 0
    assert contents() == before


def test_snapshots_over_2_gib_are_refused_at_the_start(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = CASES["train"]
    case.prepare()
    monkeypatch.setattr("netspec.solver.training.MOST_BYTES", 1000)
    assert case.main(case.words) == 1
    assert "a binary file; set snapshot_format: HDF5" in capsys.readouterr().err.splitlines()[-1]
    with Path("solver.prototxt").open("a") as file:
        file.write("snapshot_format: HDF5\n")
    assert case.main(case.words) == 0
