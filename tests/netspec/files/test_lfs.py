"""A clone without Git LFS has pointers in the place of large files: every reader says so, and the remedy."""

from collections.abc import Callable
from pathlib import Path

import pytest

import netspec
from netspec.data.database import open_reader
from netspec.data.hdf5 import Hdf5Source
from netspec.data.images import read_image
from netspec.data.mean import read_mean
from netspec.errors import SpecError
from netspec.files.lfs import pointer_fault
from netspec.inspect.features.images import read_pixels
from netspec.net.build import build_net
from netspec.net.weights import load_weights
from netspec.proto.text import parse_net_text, read_net
from netspec.solver.snapshot import read_state

POINTER = (
    b"version https://git-lfs.github.com/spec/v1\n"
    b"oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\n"
    b"size 243862418\n"
)
SAID = (
    r"is a Git LFS pointer to a file of 243,862,418 bytes, not that file; "
    r"run `git lfs pull` in its repository, or download the file itself$"
)

EMPTY = build_net(*parse_net_text("", "net.prototxt"))


def of_database(path: str) -> None:
    Path("db").mkdir()
    Path(path).rename("db/data.mdb")
    open_reader("db")


READERS: list[tuple[str, Callable[[str], object]]] = [
    ("net.prototxt", read_net),
    ("net.prototxt", netspec.load_net),
    ("w.caffemodel", lambda path: load_weights(EMPTY, path)),
    ("w.caffemodel.h5", lambda path: load_weights(EMPTY, path)),
    ("s.solverstate", read_state),
    ("mean.binaryproto", read_mean),
    ("data.mdb", of_database),
    ("1.png", read_image),
    ("1.png", lambda path: read_pixels(Path(path), 3)),
]


@pytest.mark.parametrize(("name", "read"), READERS, ids=range(len(READERS)))
def test_every_reader_names_the_pointer(
    name: str, read: Callable[[str], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(POINTER)
    with pytest.raises(ValueError, match=SAID):
        read(name)


def test_the_rows_of_a_pointer(tmp_path: Path):
    (tmp_path / "rows.h5").write_bytes(POINTER)
    (tmp_path / "list.txt").write_text(f"{tmp_path}/rows.h5\n")
    with pytest.raises(SpecError, match=SAID):
        Hdf5Source(str(tmp_path / "list.txt"), ["data"], 1)


def test_other_texts_are_no_pointers():
    assert pointer_fault(b"version 1\nsize 3\n") == ""
    assert pointer_fault(b'name: "net"\n' + POINTER) == ""
    assert "of 3 bytes" in pointer_fault(POINTER.replace(b"243862418\n", b"3"))
    assert "of 3 bytes" in pointer_fault(POINTER.replace(b"243862418", b"3").replace(b"\n", b"\r\n"))
