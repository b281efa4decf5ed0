"""Binary files: Caffe's own are read, others are refused in one line."""

import struct
from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.proto.binary import parse_binary, parse_net_binary, read_binary, read_net_binary
from netspec.proto.schema import BlobProto, NetParameter, SolverState
from paths import GOLDEN
from wire import field


def test_files_written_by_caffe_are_read() -> None:
    net, source = parse_net_binary(GOLDEN / "snapshot" / "ref_iter_40.caffemodel")
    assert "conv1" in [layer.name for layer in net.layer]
    assert len(source.layers) == len(net.layer)
    assert str(source.at(0, "blobs")).endswith("ref_iter_40.caffemodel")
    state = read_binary(GOLDEN / "snapshot" / "ref_iter_40.solverstate", SolverState)
    assert (state.iter, state.learned_net) == (40, "sgd_step/ref_iter_40.caffemodel")
    assert read_binary(GOLDEN / "images" / "mean.binaryproto", BlobProto).channels == 3


def test_old_weights_are_upgraded(tmp_path: Path) -> None:
    path = tmp_path / "old.caffemodel"
    old = NetParameter()
    old.layers.add(name="ip", type=14).blobs.add(data=[1])
    path.write_bytes(old.SerializeToString())
    (layer,) = read_net_binary(path).layer
    assert (layer.name, layer.type, list(layer.blobs[0].data)) == ("ip", "InnerProduct", [1])
    assert parse_net_binary(path, upgrade=False)[0] == old


@pytest.mark.slow
def test_there_is_no_limit_of_64_megabytes(tmp_path: Path) -> None:
    path = tmp_path / "large.caffemodel"
    path.write_bytes(field(100, field(1, b"fc") + field(7, field(5, bytes(68 << 20)))))
    (layer,) = read_net_binary(path).layer
    assert (layer.name, len(layer.blobs[0].data)) == ("fc", 17 << 20)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty, expected a binary NetParameter"),
        (b'name: "net"\nlayer {}\n', "expected a binary NetParameter, found text"),
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "found an HDF5 file; its name should end in .h5"),
        (struct.pack("<BB", 10, 200), "found another kind of data, or a truncated file"),
        (b"\x68\x01", "found another kind of data, or a truncated file"),
    ],
    ids=["empty", "text", "HDF5", "cut off", "no known field"],
)
def test_other_files_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.caffemodel"
    path.write_bytes(data)
    with pytest.raises(SpecError) as caught:
        read_net_binary(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).endswith(message)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"absent: cannot be read: No such file or directory$"):
        read_binary(tmp_path / "absent", SolverState)
    with pytest.raises(SpecError, match=r"cannot be read: Is a directory$"):
        read_net_binary(tmp_path)


def test_names_that_are_not_utf8() -> None:
    """Caffe takes any bytes; they are shown as escapes."""
    net = parse_binary(b"\n\x05sm\x06/\xa5\x1a\x01\xff\x1a\x01a", "x.caffemodel", NetParameter)
    assert net.name == "sm\x06/\\xa5"
    assert list(net.input) == ["\\xff", "a"]
    layer = parse_binary(b"\xa2\x06\x03\n\x01\xb0", "x.caffemodel", NetParameter).layer[0]
    assert layer.name == "\\xb0"
