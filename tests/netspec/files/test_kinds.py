"""A clone without Git LFS has pointers in the place of large files: every reader says so, and the remedy."""

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import netspec
from netspec.cli import main
from netspec.data.database import open_reader
from netspec.data.hdf5 import Hdf5Source
from netspec.data.images import read_image
from netspec.data.mean import read_mean
from netspec.errors import SpecError
from netspec.files.kinds import pointer_fault
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
    r"is a Git LFS pointer to a file of 243,862,418 bytes, not the file itself; "
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


NET = """layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 4 } } }
layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc"
  inner_product_param { num_output: 2 weight_filler { type: "xavier" } } }"""


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("x.npz", b"PK\x03\x04...", "a ZIP archive"),
        ("x.pth", b"\x80\x02...", "a pickle"),
        ("x.npy", b"\x93NUMPY\x01\x00", r"a NumPy array; copy its arrays into net\.params"),
        ("x.jpg", b"\xff\xd8\xff\xe0..", "a JPEG image"),
        ("x.html", b"\n<!DOCTYPE html>", "a web page: the download failed"),
        ("x.caffemodel", b"\x10\0\0\0\0\0\0\0{}", "a .safetensors file"),
        ("x.safetensors", b"\x02\0\0\0\0\0\0\0{}", r"has no tensor named LAYER\.NUMBER"),
        ("x.caffemodel.gz", b"\x1f\x8bxx", "packed by gzip|cannot be read"),
    ],
)
def test_wrong_files_are_reported(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SpecError, match=said) as caught:
        load_weights(EMPTY, tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_web_address_is_not_a_file() -> None:
    for read in (read_net, lambda path: load_weights(EMPTY, path)):
        with pytest.raises(SpecError, match=r"^https://example\.org/x\.prototxt: is a web address; download the file"):
            read("https://example.org/x.prototxt")


def test_packed_files_and_our_own_safetensors_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("n.prototxt").write_text(NET)
    net = netspec.load_net("n.prototxt", seed=1)
    netspec.save_weights(net, "x.caffemodel")
    for name in ("n.prototxt", "x.caffemodel"):
        Path(f"{name}.gz").write_bytes(gzip.compress(Path(name).read_bytes()))
    assert (
        main(["export", "n.prototxt", "--weights", "x.caffemodel", "--to", "safetensors", "--out", "x.safetensors"])
        == 0
    )
    for weights in ("x.caffemodel.gz", "x.safetensors"):
        found = netspec.load_net("n.prototxt.gz", weights=weights)
        assert all(map(torch.equal, found.params["fc"], net.params["fc"]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.int64, torch.bool])
def test_numbers_of_another_type_become_the_nets(dtype: torch.dtype, tmp_path: Path) -> None:
    (tmp_path / "n.prototxt").write_text(NET)
    assert netspec.load_net(tmp_path / "n.prototxt")(data=torch.ones(1, 4, dtype=dtype))["fc"].dtype == torch.float32


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (
            "    def reshape(self, shapes): return shape\n",
            r"own_\d+\.py:5: in reshape: NameError: name 'shape' is not defined",
        ),
        (
            "    def reshape(self, shapes): return shapes\n    def forward(self, x): return y\n",
            r"own_\d+\.py:6: in forward: NameError: name 'y' is not defined",
        ),
    ],
)
def test_a_fault_in_a_file_of_layers_is_one_line(
    body: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    kind, plugin = f"Broken{len(body)}", f"own_{len(body)}.py"  # a process knows one file of a name
    Path(plugin).write_text(f'from netspec.layers import *\n\n@register("{kind}")\nclass A(Layer):\n{body}')
    Path("n.prototxt").write_text(
        f'input: "x" input_shape {{ dim: 1 }} layer {{ name: "a" type: "{kind}" bottom: "x" top: "a" }}'
    )
    assert main(["time", "n.prototxt", "--plugin", plugin, "--iterations", "1", "-q"]) == 1
    assert re.fullmatch(said, capsys.readouterr().err.splitlines()[-1])
