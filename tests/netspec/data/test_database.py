from __future__ import annotations

import gc
import os
import random
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import lmdb
import numpy as np
import pytest

from netspec.data import database
from netspec.data.database import Writer, open_reader
from netspec.errors import SpecError, Where
from optional_packages import leveldb
from paths import GOLDEN

PLACE = Where("net.prototxt", 7, 3)


def write(path: Path, records: dict[bytes, bytes], backend: str = "lmdb") -> None:
    with Writer(str(path), backend) as writer:
        for key, value in records.items():
            writer.put(key, value)


def test_records_are_in_the_order_of_their_keys(tmp_path: Path) -> None:
    write(tmp_path / "db", {b"b": b"2", b"a": b"1", b"c": b"3"})
    reader = open_reader(str(tmp_path / "db"))
    assert [(reader.key(i), reader.record(i)) for i in range(len(reader))] == [(b"a", b"1"), (b"b", b"2"), (b"c", b"3")]


def test_any_record_can_be_read_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_SCAN", 10)  # keys are listed in several goes
    reader = open_reader(str(GOLDEN / "pairs" / "train_lmdb"))
    for i in (639, 5, 300):
        assert reader.key(i) == b"%08d" % i
        assert len(reader.record(i)) == 1579


def test_reading_caffes_database_leaves_no_lock_file() -> None:
    assert len(open_reader(str(GOLDEN / "features" / "feat_lmdb"))) == 200
    assert os.listdir(GOLDEN / "features" / "feat_lmdb") == ["data.mdb"]


def test_a_reader_works_in_a_forked_worker() -> None:
    reader = open_reader(str(GOLDEN / "pairs" / "test_lmdb"))
    expected = reader.record(3)
    child = os.fork()
    if not child:
        try:
            same = reader.record(3) == expected and reader.key(199) == b"00000199"
        finally:  # also after an error: what forked is a worker of pytest
            os._exit(not same)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.slow
def test_readers_can_be_opened_and_closed_in_threads() -> None:  # liblmdb must not open what is still being closed
    faults: list[Exception] = []

    def come_and_go() -> None:
        for _ in range(200):
            try:
                open_reader(str(GOLDEN / "pairs" / "test_lmdb")).record(5)
            except SpecError as fault:
                faults.append(fault)

    threads = [threading.Thread(target=come_and_go) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults


def test_a_program_can_open_the_database_of_a_reader(tmp_path: Path) -> None:
    """The library opens a file once in a process, so a reader has it open only while it reads."""
    source = str(GOLDEN / "images" / "lmdb_gray")
    reader = open_reader(source)
    reader.record(0)
    with lmdb.open(source, readonly=True, lock=False) as env, env.begin() as transaction:
        expected = list(transaction.cursor())
    assert [(reader.key(i), reader.record(i)) for i in range(len(reader))] == expected


@pytest.mark.parametrize("change", ["replaced", "gone"])
def test_a_replaced_database_is_refused_by_its_reader(tmp_path: Path, change: str) -> None:
    write(tmp_path / "db", {b"a": b"old"})
    old = open_reader(str(tmp_path / "db"))
    (tmp_path / "db").rename(tmp_path / "before")
    if change == "replaced":
        write(tmp_path / "db", {b"a": b"new"})
        assert open_reader(str(tmp_path / "db")).record(0) == b"new"
    with pytest.raises(SpecError, match="by another program"):
        old.record(0)


# What is wrong with a source, in one line at the place that names it


def make_leveldb(path: Path) -> None:
    path.mkdir()
    (path / "CURRENT").write_text("MANIFEST-000002\n")


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (None, "does not exist"),
        (b"a file", "is a file"),
        ({}, "without data.mdb"),
        ({"data.mdb": b""}, "empty data.mdb"),
        ({"data.mdb": b"hello" * 4000}, "has a data.mdb that is not an LMDB"),
        ({"CURRENT": b"MANIFEST-000002\n"}, "has backend LEVELDB, not LMDB; set backend: LEVELDB"),
    ],
    ids=str,
)
def test_an_invalid_source_is_refused_in_one_line(
    tmp_path: Path, contents: bytes | dict[str, bytes] | None, message: str
) -> None:
    if isinstance(contents, bytes):
        (tmp_path / "db").write_bytes(contents)
    elif contents is not None:
        (tmp_path / "db").mkdir()
        for name, data in contents.items():
            (tmp_path / "db" / name).write_bytes(data)
    with pytest.raises(SpecError) as fault:
        open_reader(str(tmp_path / "db"), "lmdb", PLACE)
    assert str(fault.value).startswith(f'net.prototxt:7:3: database "{tmp_path}/db" ')
    assert message in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_database_without_records_or_truncated_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "none", {})
    with pytest.raises(SpecError, match="is empty: it contains no records"):
        open_reader(str(tmp_path / "none"))
    write(tmp_path / "cut", {b"%08d" % i: bytes(3000) for i in range(100)})
    size = os.path.getsize(tmp_path / "cut" / "data.mdb")
    os.truncate(tmp_path / "cut" / "data.mdb", 100_000)
    for _ in range(2):
        with pytest.raises(SpecError, match="is truncated"):
            open_reader(str(tmp_path / "cut"))
        os.truncate(tmp_path / "cut" / "data.mdb", size)  # zeros instead of what was cut


def test_an_lmdb_with_backend_leveldb_gets_advice() -> None:
    with pytest.raises(SpecError, match=r"LEVELDB is Caffe's default\); set backend: LMDB"):
        open_reader(str(GOLDEN / "pairs" / "test_lmdb"), "leveldb", PLACE)


# Writing


@pytest.mark.parametrize(
    "folder", ["images/lmdb_plain", "images/lmdb_resized", "images/lmdb_encoded", "features/feat_lmdb"]
)
def test_the_file_is_byte_identical_to_caffes(tmp_path: Path, folder: str) -> None:
    caffes = GOLDEN / folder
    reader = open_reader(str(caffes))
    write(tmp_path / "db", {reader.key(i): reader.record(i) for i in range(len(reader))})
    assert (tmp_path / "db" / "data.mdb").read_bytes() == (caffes / "data.mdb").read_bytes()


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_a_batch_that_overflows_the_map_is_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int
) -> None:
    monkeypatch.setattr(database, "_FIRST_MAP_SIZE", 1 << 16)
    monkeypatch.setattr(database, "_COMMIT_RECORDS", batch)
    rng = np.random.default_rng(1)
    records = {b"%08d" % i: rng.bytes(int(size)) for i, size in enumerate(rng.integers(1, 9000, 500))}
    with Writer(str(tmp_path / "db")) as writer:
        for i, (key, value) in enumerate(records.items()):
            if i % 3 == 0:
                writer.put(key, b"an earlier record of this key")
            writer.put(key, value)
    reader = open_reader(str(tmp_path / "db"))
    assert {reader.key(i): reader.record(i) for i in range(len(reader))} == records


def test_records_can_be_written_in_any_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_FIRST_MAP_SIZE", 1 << 20)
    rng = np.random.default_rng(0)
    records = {b"%08d" % i: rng.bytes(3000) for i in rng.permutation(2500)}
    write(tmp_path / "db", records)
    reader = open_reader(str(tmp_path / "db"))
    assert [reader.key(i) for i in range(2500)] == sorted(records)
    assert all(reader.record(i) == records[reader.key(i)] for i in range(0, 2500, 7))


def test_an_existing_path_is_refused_and_kept(tmp_path: Path) -> None:
    write(tmp_path / "db", {b"a": b"1"})
    with pytest.raises(SpecError, match="already exists"):
        write(tmp_path / "db", {b"a": b"2"})
    assert open_reader(str(tmp_path / "db")).record(0) == b"1"


def test_the_database_appears_only_when_complete(tmp_path: Path) -> None:
    with Writer(str(tmp_path / "db")) as writer:
        writer.put(b"a", b"1")
        writer.commit()
        assert not (tmp_path / "db").exists()
    assert (tmp_path / "db").exists()


def test_a_failure_leaves_no_files(tmp_path: Path) -> None:
    def put_and_fail(writer: Writer) -> None:
        writer.put(b"a", b"1")
        raise RuntimeError("image 2")

    with pytest.raises(RuntimeError, match="image 2"), Writer(str(tmp_path / "db")) as writer:
        put_and_fail(writer)
    assert os.listdir(tmp_path) == []


def test_a_key_that_is_too_long_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r'cannot write record "xxx'), Writer(str(tmp_path / "db")) as writer:
        writer.put(b"x" * 600, b"1")
    assert os.listdir(tmp_path) == []


def test_missing_folders_are_created_or_reported(tmp_path: Path) -> None:
    write(tmp_path / "new" / "folder" / "db", {})
    assert os.listdir(tmp_path / "new" / "folder") == ["db"]
    (tmp_path / "file").touch()
    with pytest.raises(SpecError, match="cannot write a database here"):
        write(tmp_path / "file" / "db", {})


def test_an_unknown_backend_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match='unknown backend "sqlite"; expected one of: lmdb, leveldb'):
        write(tmp_path / "db", {}, "sqlite")


# LevelDB


def test_leveldb_can_be_written_and_read(tmp_path: Path) -> None:
    leveldb()
    records = {b"%08d" % i: bytes([i % 256]) * i for i in range(2500)}
    write(tmp_path / "db", records, "leveldb")
    reader = open_reader(str(tmp_path / "db"), "LEVELDB")
    assert {reader.key(i): reader.record(i) for i in range(len(reader))} == records
    assert open_reader(str(tmp_path / "db"), "leveldb").record(3) == b"\x03" * 3  # LevelDB itself would refuse a second
    assert len(open_reader(str((tmp_path / "db").rename(tmp_path / "moved")), "leveldb")) == len(reader)


@pytest.mark.slow
def test_reading_a_leveldb_neither_locks_nor_changes_it(tmp_path: Path) -> None:
    library = leveldb()
    write(tmp_path / "db", {b"%04d" % i: bytes(i) for i in range(3000)}, "leveldb")
    before = {path.name: path.read_bytes() for path in (tmp_path / "db").iterdir()}
    other = library.DB(str(tmp_path / "db"))  # as another process that reads it
    during = {path.name: path.read_bytes() for path in (tmp_path / "db").iterdir()}
    reader = open_reader(str(tmp_path / "db"), "leveldb")
    assert [len(reader.record(i)) for i in range(3000)] == list(range(3000))
    assert {path.name: path.read_bytes() for path in (tmp_path / "db").iterdir()} == during
    folders = set(Path(tempfile.gettempdir()).glob("netspec-leveldb-*"))
    del reader
    gc.collect()
    assert len(folders - set(Path(tempfile.gettempdir()).glob("netspec-leveldb-*"))) >= 1
    other.close()
    assert set(before) - set(during) <= {name for name in before if name.endswith(".log") or "MANIFEST" in name}


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def cut_in_header(data: bytes) -> bytes:
    return data[: 32768 + 3]  # a block begins with a header


def end_in_zeros(data: bytes) -> bytes:
    return data[:32768] + bytes(len(data) - 32768)


def flip(data: bytes) -> bytes:
    return data[:-200] + bytes([data[-200] ^ 1]) + data[-199:]


@pytest.mark.parametrize(
    ("kind", "damage", "says"),
    [
        pytest.param("*.log", cut, "000003.log is truncated", id="a log that is cut"),
        pytest.param("*.log", cut_in_header, "000003.log is truncated", id="a log that is cut in a header"),
        pytest.param("*.log", end_in_zeros, "000003.log is truncated", id="a log that ends in zeros"),
        pytest.param("*.log", flip, "checksum mismatch", id="a log with another bit"),
        pytest.param("*.ldb", cut, "Corruption|Invalid argument", id="a table that is cut"),
        pytest.param("*.ldb", flip, "checksum mismatch|Corruption", id="a table with another bit"),
    ],
)
def test_a_damaged_leveldb_is_refused(tmp_path: Path, kind: str, damage: Callable[[bytes], bytes], says: str) -> None:
    """The library alone reads fewer or other records."""
    library = leveldb()
    write(tmp_path / "db", {b"%08d" % i: bytes([i % 256]) * 100 for i in range(2500)}, "leveldb")
    if kind == "*.ldb":
        tables = library.DB(str(tmp_path / "db"))
        tables.compact_range()
        tables.close()
    (place,) = (path for path in (tmp_path / "db").glob(kind) if path.stat().st_size)
    place.write_bytes(damage(place.read_bytes()))
    with pytest.raises(SpecError, match=says):
        open_reader(str(tmp_path / "db"), "leveldb")


def test_a_leveldb_that_is_damaged_after_opening_is_reported(tmp_path: Path) -> None:
    """What was not read when it was opened is checked when it is read."""
    library = leveldb()
    write(tmp_path / "db", {b"%08d" % i: random.Random(i).randbytes(10_000) for i in range(200)}, "leveldb")
    tables = library.DB(str(tmp_path / "db"))
    tables.compact_range()
    tables.close()
    reader = open_reader(str(tmp_path / "db"), "leveldb")
    (place,) = (path for path in (tmp_path / "db").glob("*.ldb") if path.stat().st_size)
    with place.open("r+b") as file:
        file.write(bytes(1_000_000))
    with pytest.raises(SpecError, match="is damaged"):
        reader.records(range(200))
    with pytest.raises(SpecError, match="is damaged"):
        reader.record(3)


def test_without_a_library_a_message_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("plyvel", "plyvel_next"):
        monkeypatch.setitem(sys.modules, name, None)
    make_leveldb(tmp_path / "db")
    with pytest.raises(SpecError, match=r"pip install 'netspec-caffe\[leveldb\]'"):
        open_reader(str(tmp_path / "db"), "leveldb", PLACE)
    with pytest.raises(SpecError, match=r"pip install 'netspec-caffe\[leveldb\]'"):
        write(tmp_path / "new", {}, "leveldb")
    assert os.listdir(tmp_path) == ["db"]
