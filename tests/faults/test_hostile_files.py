"""Files that were truncated, changed or made to harm a reader: false sizes, links, and contents that decompress."""

import io
import os
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import h5py
import lmdb
import numpy as np
import pytest

from faults.formats import all_records, all_rows, net
from loopclosure.descriptors.feature_file import read_features
from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from loopclosure.places.masks import read_truth_matrix
from netspec.data.database import Writer, open_reader
from netspec.data.images import read_image
from netspec.data.mean import read_mean_option
from netspec.errors import SpecError
from netspec.inspect.features.images import read_pixels as read_for_features
from netspec.load import load_net, load_solver
from netspec.net.weights import load_weights
from netspec.solver.snapshot import read_state
from optional_packages import leveldb
from paths import ROOT

HUGE = (1 << 20, 1 << 20)


def false_header() -> bytes:
    """Return an .npy file whose header gives a size of terabytes."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": HUGE})
    return stream.getvalue() + bytes(100)


def test_an_npy_with_a_false_size_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.npy").write_bytes(false_header())
    with pytest.raises(InputError, match="cannot be read"):
        read_truth_matrix(tmp_path / "x.npy")
    with pytest.raises(SpecError, match="cannot be read"):
        read_mean_option(str(tmp_path / "x.npy"))


def test_an_npz_with_a_false_size_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("features.npy", false_header())
    with pytest.raises(InputError, match="cannot be read"):
        read_features(tmp_path / "x.npz")


@pytest.mark.parametrize("name", ["x.npz", "x.npy"])
def test_an_array_whose_header_gives_fewer_rows_is_refused(name: str, tmp_path: Path) -> None:
    values, path = np.zeros((20, 20), np.uint8), tmp_path / name
    np.savez(path, features=values) if name == "x.npz" else np.save(path, values)
    path.write_bytes(path.read_bytes().replace(b"(20, 20)", b"(10, 20)"))
    with pytest.raises(InputError, match=r"more bytes than an array of shape|Bad CRC-32"):
        (read_features if name == "x.npz" else read_truth_matrix)(path)


@pytest.fixture(scope="module")
def large_npz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small .npz file whose array takes 280 MiB of memory."""
    path = tmp_path_factory.mktemp("large") / "x.npz"
    np.savez_compressed(path, features=np.zeros((70, 1 << 20), np.float32))
    return path


@pytest.mark.slow
def test_an_npz_that_decompresses_to_too_much_is_refused(large_npz: Path) -> None:
    with pytest.raises(InputError, match=r"would take 280 MiB of memory, but the file has only"):
        read_features(large_npz)


def test_an_npz_with_python_objects_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", features=np.array([{"a": 1}], object))
    with pytest.raises(InputError, match="bject arrays"):
        read_features(tmp_path / "x.npz")


def test_an_hdf5_file_with_a_false_size_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_dataset("data", HUGE, np.float32, chunks=(1024, 1024), compression="gzip")
        file["label"] = np.zeros(3)
    with pytest.raises(SpecError, match="dataset /data would take 4 TiB of memory, but the file has only"):
        all_rows(tmp_path / "x.h5")


@pytest.mark.parametrize("kind", ["link", "soft link", "stored", "virtual"])
def test_an_hdf5_file_with_data_in_another_file_is_refused(kind: str, tmp_path: Path) -> None:
    """The other file is not read; otherwise its contents would be in the output of ``extract`` or in a snapshot."""
    secret = tmp_path / "secret"
    with h5py.File(secret, "w") as file:
        file["data"] = np.arange(24.0).reshape(4, 6)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["label"] = np.zeros(4)
        if kind == "link":
            file["data"] = h5py.ExternalLink(str(secret), "data")
        elif kind == "soft link":
            file["other"] = h5py.ExternalLink(str(secret), "/")
            file["data"] = h5py.SoftLink("/other/data")
        elif kind == "stored":
            file.create_dataset("data", (4, 6), np.float32, external=[(str(secret), 0, 96)])
        else:
            layout = h5py.VirtualLayout((4, 6), np.float64)
            layout[:] = h5py.VirtualSource(str(secret), "data", (4, 6))
            file.create_virtual_dataset("data", layout)
    with pytest.raises(SpecError, match="this is not supported"):
        all_rows(tmp_path / "x.h5")


def test_weights_and_states_with_links_to_another_file_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "secret", "w") as file:
        file["0"] = np.zeros((3, 2, 3, 3), np.float32)
    with h5py.File(tmp_path / "w.caffemodel.h5", "w") as file:
        file.create_group("data")["conv"] = h5py.ExternalLink("secret", "/")
    with pytest.raises(SpecError, match=r"/data/conv is a link; this is not supported"):
        load_weights(net(), tmp_path / "w.caffemodel.h5")
    with h5py.File(tmp_path / "x.solverstate.h5", "w") as file:
        file["iter"], file["current_step"] = [1], [0]
        file["history"] = h5py.ExternalLink("secret", "/")
    with pytest.raises(SpecError, match=r"/history is a link; this is not supported"):
        read_state(tmp_path / "x.solverstate.h5")


HDF5_DATA = 'layer { name: "d" type: "HDF5Data" top: "a" hdf5_data_param { source: "SOURCE" batch_size: 1 } }'
HDF5_OUTPUT = """layer { name: "i" type: "DummyData" top: "a" top: "b"
  dummy_data_param { shape { dim: 1 } shape { dim: 1 } } }
layer { name: "o" type: "HDF5Output" bottom: "a" bottom: "b" hdf5_output_param { file_name: "SOURCE" } }"""
SETTINGS = (
    "base_lr: 0.1 lr_policy: 'fixed' max_iter: 1 solver_mode: CPU net_param { layer { name: 'x' type: 'Split' } }"
)


@pytest.mark.parametrize("name", [r"a\000b", "n" * 5000], ids=["NUL", "long"])
def test_names_that_no_file_can_have_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("list.txt").write_text(name.replace(r"\000", "\0") + "\n")
    for text in (HDF5_DATA.replace("SOURCE", name), HDF5_DATA.replace("SOURCE", "list.txt"), HDF5_OUTPUT):
        Path("net.prototxt").write_text(text.replace("SOURCE", name))
        with pytest.raises(SpecError):
            load_net("net.prototxt", phase="TRAIN").forward_loss()
    for field in ("snapshot: 1 snapshot_prefix", "weights", "net"):
        settings = SETTINGS.partition(" net_param")[0] if field == "net" else SETTINGS
        Path("solver.prototxt").write_text(f'{settings} {field}: "{name}"')
        with pytest.raises(SpecError):
            load_solver("solver.prototxt")


def compressed_png(side: int) -> bytes:
    """Return a black PNG of 1 bit per pixel, compressed to a thousandth; in color it takes 24 times the memory."""
    header = b"IHDR" + side.to_bytes(4, "big") * 2 + b"\x01\x00\x00\x00\x00"
    body = b"IDAT" + zlib.compress(bytes(side * (side // 8 + 1)))
    parts = (header, body, b"IEND")
    chunks = (len(part[4:]).to_bytes(4, "big") + part + zlib.crc32(part).to_bytes(4, "big") for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


READ = """
import resource, sys
from {module} import {function} as read
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read("x.png")
except ValueError as fault:
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024, fault)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measures memory in Linux's unit")
@pytest.mark.parametrize(
    ("module", "function"), [("netspec.data.images", "read_image"), ("loopclosure.places.frames", "read_bgr")]
)
def test_an_image_that_decompresses_to_too_much_is_refused_without_using_memory(
    module: str, function: str, tmp_path: Path
) -> None:
    (tmp_path / "x.png").write_bytes(compressed_png(20_000))
    code = READ.format(module=module, function=function)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("OPENCV_IO_MAX_IMAGE_PIXELS", None)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    mebibytes, _, said = done.stdout.partition(" ")
    assert int(mebibytes) < 100
    assert "image" in said


def test_a_truncated_jpeg_is_refused_by_every_reader(tmp_path: Path) -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 80, 3)).astype(np.uint8), (5, 5), 2)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    path = tmp_path / "x.jpg"
    for size in range(0, len(data) - 2, 97):
        path.write_bytes(data[:size])
        with pytest.raises(ValueError, match="image"):
            read_image(str(path))
        with pytest.raises(SpecError, match="image"):
            read_for_features(path, 3)
        with pytest.raises(InputError, match="image"):
            read_bgr(path)


def packed_rows(path: Path, chunk: bytes, rows: int = 40) -> None:
    """Write an HDF5 file with a dataset of one chunk, which is stored as these bytes."""
    with h5py.File(path, "w") as file:
        file["data"], file["label"] = np.zeros((rows, 2)), np.zeros(rows)
        file.create_dataset("packed", (rows, 4), np.float32, chunks=(rows, 4), compression="gzip")
        file["packed"].id.write_direct_chunk((0, 0), chunk)


@pytest.mark.slow
def test_an_hdf5_chunk_that_decompresses_to_too_much_is_refused(tmp_path: Path) -> None:
    packed_rows(tmp_path / "x.h5", zlib.compress(bytes(640)))
    all_rows(tmp_path / "x.h5")
    packed_rows(tmp_path / "x.h5", zlib.compress(bytes(300 << 20)), 40_000)
    with pytest.raises(SpecError, match="packed has a chunk of more than its"):
        all_rows(tmp_path / "x.h5")


def test_hdf5_data_in_an_unsupported_compression_are_refused(tmp_path: Path) -> None:
    packed_rows(tmp_path / "x.h5", zlib.compress(bytes(640)))
    with h5py.File(tmp_path / "x.h5", "r+") as file:
        del file["packed"]
        file.create_dataset("packed", (40, 4), np.int32, chunks=(40, 4), scaleoffset=3)
    with pytest.raises(SpecError, match="packed has an unsupported compression; write it with gzip"):
        all_rows(tmp_path / "x.h5")


@pytest.mark.parametrize(
    "packing",
    [{"compression": "lzf"}, {"compression": "gzip", "shuffle": True, "fletcher32": True}],
    ids=["lzf", "gzip_shuffle_fletcher32"],
)
def test_hdf5_data_in_usual_compressions_are_read(packing: dict[str, Any], tmp_path: Path) -> None:
    noise = np.random.default_rng(0).random((40_000, 4)).astype(np.float32)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"], file["label"] = np.zeros((40_000, 2)), np.zeros(40_000)
        file.create_dataset("packed", data=noise, chunks=(40_000, 4), **packing)
    all_rows(tmp_path / "x.h5")


# LMDB


@pytest.mark.parametrize("seed", range(4))
def test_open_reader_reads_a_random_lmdb_as_the_library_does(seed: int, tmp_path: Path) -> None:
    """The records have many sizes and are overwritten and deleted in several transactions."""
    draw = np.random.default_rng(seed)
    with lmdb.open(str(tmp_path / "db"), map_size=1 << 26, lock=False) as env:
        for _ in range(6):
            with env.begin(write=True) as transaction:
                for _ in range(150):
                    key = b"%d" % draw.integers(0, 400) * int(draw.integers(1, 40))
                    if draw.random() < 0.2:
                        transaction.delete(key)
                    else:
                        transaction.put(key, draw.bytes(int(draw.choice([0, 1, 30, 900, 3000, 9000, 70_000]))))
        with env.begin() as transaction:
            expected = list(transaction.cursor())
    reader = open_reader(str(tmp_path / "db"))
    assert [(reader.key(i), reader.record(i)) for i in range(len(reader))] == expected


@pytest.fixture
def database(tmp_path: Path) -> Path:
    with Writer(str(tmp_path / "db")) as writer:
        for i in range(300):
            writer.put(b"%08d" % i, bytes([i % 256]) * (20 + 50 * (i % 90)))
    return tmp_path / "db"


@pytest.mark.slow
def test_a_truncated_database_is_refused(database: Path, tmp_path: Path) -> None:
    data = (database / "data.mdb").read_bytes()
    (tmp_path / "cut").mkdir()
    for size in range(len(data) - 1, 0, -4099):
        (tmp_path / "cut" / "data.mdb").write_bytes(data[:size])
        with pytest.raises(SpecError, match=r"truncated|damaged|not an LMDB"):
            all_records(tmp_path / "cut")


@pytest.mark.parametrize("change", ["cut", "emptied", "rewritten"])
def test_a_database_that_is_changed_while_it_is_read_is_refused(change: str, database: Path) -> None:
    reader = open_reader(str(database))
    reader.record(0)
    data = database / "data.mdb"
    if change == "rewritten":
        with lmdb.open(str(database), lock=False, map_size=1 << 24) as env, env.begin(write=True) as transaction:
            transaction.put(b"%08d" % 7, b"new")
        os.utime(data, (1, 1))  # clocks of file systems are coarse
    else:
        os.truncate(data, data.stat().st_size // 2 if change == "cut" else 0)
    with pytest.raises(SpecError, match="by another program while it was being read"):
        reader.record(299)


@pytest.mark.parametrize("backend", ["lmdb", "leveldb"])
def test_a_database_that_was_written_to_is_opened_again(backend: str, tmp_path: Path) -> None:
    """A reader that was opened before keeps the old contents."""
    library = leveldb() if backend == "leveldb" else None
    path = str(tmp_path / "db")
    with Writer(path, backend) as writer:
        writer.put(b"00000000", b"old")
    before = open_reader(path, backend)
    assert open_reader(path, backend) is before
    if library is None:
        with lmdb.open(path, lock=False, map_size=1 << 24) as env, env.begin(write=True) as transaction:
            transaction.put(b"00000001", b"new")
        os.utime(tmp_path / "db" / "data.mdb", (1, 1))  # clocks of file systems are coarse
    else:
        store = library.DB(path)
        store.put(b"00000001", b"new")
        store.close()
    after = open_reader(path, backend)
    assert [after.record(i) for i in range(len(after))] == [b"old", b"new"]
    assert len(before) == 1
