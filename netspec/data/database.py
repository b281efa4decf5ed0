"""Caffe's databases: LMDB, and LevelDB through an optional package (the extra ``leveldb``).

Records are numbered in the order of their keys, which is the order in which Caffe reads them.

Caffe: src/caffe/util/db_lmdb.cpp, src/caffe/util/db_leveldb.cpp
"""

from __future__ import annotations

import os
import shutil
import struct
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from multiprocessing.util import Finalize
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType, TracebackType

import lmdb

from netspec import log
from netspec.data.lmdb_pages import check_is_whole
from netspec.errors import SpecError, Where
from netspec.files.kinds import head_of, nearest_existing, pointer_fault
from netspec.files.limits import amount
from netspec.files.whole_file import whole_folder

BACKENDS = ("lmdb", "leveldb")
_SCAN = 4096  # number of keys to list beyond the requested one
LEAST_FREE_BYTES = 1 << 16  # a disk with fewer is considered full
_FIRST_MAP_SIZE = 1 << 20  # Caffe's
_COMMIT_RECORDS, _COMMIT_BYTES = 1000, 64 << 20  # a batch stays in memory until it is committed


class Reader(ABC):
    """Read access to a database, by record number; thread-safe."""

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of records."""

    @abstractmethod
    def key(self, i: int) -> bytes:
        """Return the key of record ``i``."""

    @abstractmethod
    def records(self, numbers: Sequence[int]) -> list[bytes]:
        """Return the values of records; raises SpecError if the database is damaged or was changed."""

    def record(self, i: int) -> bytes:
        """Return the value of record ``i``; see :meth:`records`."""
        return self.records((i,))[0]

    @property
    @abstractmethod
    def is_current(self) -> bool:
        """Whether the database has not changed since it was opened."""


# Two nets that use the same database (training and test, for example) share its reader. A forked process opens it
# again, and so does a net that is built after another program has changed the database.
_open_readers: weakref.WeakValueDictionary[tuple[int, int, int], Reader] = weakref.WeakValueDictionary()
_open_lock = threading.Lock()


def open_reader(source: str, backend: str = "lmdb", where: Where | None = None) -> Reader:
    """Open a database for reading; it is closed when the last reference to the reader is deleted.

    ``where`` is the position in the prototxt. Raises SpecError for a database that is missing, empty, damaged, or has
    the other backend.
    """
    try:
        found = _kind(source)
        if found != backend.lower():
            default = " (LEVELDB is Caffe's default)" if found == "lmdb" else ""
            named = found.upper()
            raise ValueError(f"has backend {named}, not {backend.upper()}{default}; set backend: {named}")
        status = os.stat(os.path.join(source, "data.mdb") if found == "lmdb" else source)
        identity = os.getpid(), status.st_dev, status.st_ino
        with _open_lock:
            reader = _open_readers.get(identity)
            if reader is None or not reader.is_current:
                reader = _LmdbReader(source) if found == "lmdb" else _LevelDbReader(source)
                if not len(reader):
                    raise ValueError("is empty: it contains no records")
                _open_readers[identity] = reader
    except (ValueError, OSError) as fault:
        raise SpecError(f'database "{source}" {fault}', where or Where(source)) from None
    _log_opened(found, source)
    return reader


def _log_opened(backend: str, path: str) -> None:
    log.info("db_lmdb.cpp:35" if backend == "lmdb" else "db_leveldb.cpp:18", f"Opened {backend} {path}")


def _kind(source: str) -> str:
    """Return the backend of the database in a folder."""
    folder = Path(source)
    if not os.path.exists(folder):
        raise ValueError(f"does not exist{nearest_existing(folder)}")
    if not folder.is_dir():
        raise ValueError("is a file; expected a folder that contains data.mdb (LMDB) or CURRENT (LevelDB)")
    if (folder / "data.mdb").is_file():
        return "lmdb"
    if (folder / "CURRENT").is_file():
        return "leveldb"
    raise ValueError("is a folder without data.mdb (LMDB) or CURRENT (LevelDB), so it is not a database")


class _LmdbReader(Reader):
    """An LMDB, read without locks, so that it works on read-only media.

    It is open only while it is read, because the library opens a file only once in a process, and a program may want to
    look at the records too.
    """

    def __init__(self, source: str) -> None:
        self._source, self._path = source, os.path.join(source, "data.mdb")
        if not os.path.getsize(self._path):
            raise ValueError("has an empty data.mdb, so it was never written")
        if fault := pointer_fault(head_of(self._path)):
            raise ValueError(f"has a data.mdb that {fault}")
        check_is_whole(self._path)
        self._stamp = _stamp(self._path)
        self._keys: list[bytes] = []
        with self._reading() as transaction:
            self._size: int = transaction.stat()["entries"]

    def __len__(self) -> int:
        return self._size

    def key(self, i: int) -> bytes:
        if i >= len(self._keys):
            with self._reading() as transaction:
                self._list_keys(i, transaction)
        return self._keys[i]

    def records(self, numbers: Sequence[int]) -> list[bytes]:
        with self._reading() as transaction:
            self._list_keys(max(numbers), transaction)
            return [bytes(transaction.get(self._keys[i], b"")) for i in numbers]

    @property
    def is_current(self) -> bool:
        return _stamp(self._path) == self._stamp

    @contextmanager
    def _reading(self) -> Iterator[lmdb.Transaction]:
        """Open the database. Raise SpecError if it is damaged or was changed: a cut file must not be mapped."""
        with _lmdb_lock:
            if not self.is_current:
                raise SpecError(f'database "{self._source}" was changed by another program while it was being read')
            try:
                with lmdb.open(self._source, readonly=True, lock=False, readahead=False) as env, env.begin() as opened:
                    yield opened
            except lmdb.Error as fault:
                raise SpecError(f'database "{self._source}" cannot be read as an LMDB ({fault})') from None

    def _list_keys(self, last: int, transaction: lmdb.Transaction) -> None:
        """List the keys up to a record and some more: listing those of a large database can take minutes."""
        if last >= len(self._keys):
            cursor = transaction.cursor()
            if self._keys:
                cursor.set_key(self._keys[-1])
                cursor.next()
            self._keys += map(bytes, islice(cursor.iternext(values=False), last + _SCAN - len(self._keys)))


# While it is held, the library has a file open. A process is forked only in between.
_lmdb_lock = threading.Lock()
os.register_at_fork(before=_lmdb_lock.acquire, after_in_parent=_lmdb_lock.release, after_in_child=_lmdb_lock.release)


def _stamp(path: str) -> tuple[int, ...] | None:
    """Return what changes with a file, None if it is gone."""
    try:
        state = os.stat(path)
    except OSError:
        return None
    return state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns


class _LevelDbReader(Reader):
    """A LevelDB, opened in a folder of links to its files.

    Even for reading, the library locks a database and rewrites parts of it. With links, several processes can read the
    same database, also on read-only media. Without ``paranoid_checks`` and ``verify_checksums``, damage is ignored.
    """

    def __init__(self, source: str) -> None:
        library = leveldb()
        self._source, self._stamp = source, _contents(source)
        folder = mkdtemp(prefix="netspec-leveldb-")
        # Unlike weakref's finalizers, this also runs at the end of a worker, and never in a process forked later.
        Finalize(self, shutil.rmtree, (folder, True), exitpriority=0)
        for name in set(os.listdir(source)) - {"LOCK", "LOG", "LOG.old"}:
            if name.endswith(".log") and _ends_within_a_record(Path(source, name)):
                raise ValueError(f"is damaged: its file {name} is truncated; copy or write the database again")
            os.symlink(os.path.abspath(os.path.join(source, name)), os.path.join(folder, name))
        try:
            self._db = library.DB(folder, create_if_missing=False, paranoid_checks=True)
            with self._db.iterator(include_value=False, verify_checksums=True) as keys:
                self._keys: list[bytes] = list(keys)
        except (library.Error, OSError) as fault:
            raise ValueError(f"cannot be opened as a LevelDB ({_message(fault)})") from None

    def __len__(self) -> int:
        return len(self._keys)

    def key(self, i: int) -> bytes:
        return self._keys[i]

    def records(self, numbers: Sequence[int]) -> list[bytes]:
        try:
            return [value for run in _runs(numbers) for value in self._values([self._keys[i] for i in numbers[run]])]
        except (leveldb().Error, OSError) as fault:
            raise SpecError(f'database "{self._source}" is damaged ({_message(fault)})') from None

    def _values(self, keys: Sequence[bytes]) -> list[bytes]:
        """Return the values of consecutive keys."""
        if len(keys) == 1:
            return [self._db.get(keys[0], verify_checksums=True)]
        with self._db.iterator(
            start=keys[0], stop=keys[-1], include_stop=True, include_key=False, verify_checksums=True
        ) as walk:
            return list(walk)

    @property
    def is_current(self) -> bool:
        return _contents(self._source) == self._stamp


def _runs(numbers: Sequence[int]) -> Iterator[slice]:
    """Yield the runs of consecutive numbers."""
    start = 0
    for end in range(1, len(numbers) + 1):
        if end == len(numbers) or numbers[end] != numbers[end - 1] + 1:
            yield slice(start, end)
            start = end


def _message(fault: Exception) -> str:
    """Return the message of an error of the library, which is bytes."""
    message = fault.args[0] if fault.args else ""
    return message.decode(errors="replace") if isinstance(message, bytes) else str(fault)


def _ends_within_a_record(log: Path) -> bool:
    """Return whether a log of LevelDB is cut or ends in zeros, which the library takes for an interrupted writer's.

    LevelDB: doc/log_format.md
    """
    size, block, header = log.stat().st_size, 32768, 7
    full, last = 1, 4  # types of parts; a record has one part, or several parts in several blocks
    position, kind = 0, full
    with log.open("rb") as file:
        while position < size:
            left = block - position % block
            if left < header:  # zeros up to the end of the block
                position += left
                continue
            file.seek(position)
            _, length, kind = struct.unpack("<IHB", file.read(header).ljust(header, b"\0"))
            if kind == 0:  # space that a writer reserved, or the zeros of an interrupted copy
                return True
            position += header + length
    return position > size or kind not in (full, last)


def _contents(folder: str) -> dict[str, tuple[int, int]]:
    """Return the inode numbers and sizes of a LevelDB's files, which may grow but are never overwritten; {} if none.

    They distinguish it from a new database, whose folder may have the inode number of a removed one.
    """
    try:
        files = [entry for entry in os.scandir(folder) if not entry.name.startswith(("LO", "."))]
        return {entry.name: (entry.inode(), entry.stat().st_size) for entry in files}
    except FileNotFoundError:
        return {}


def leveldb() -> ModuleType:
    """Return the library for LevelDB: plyvel, or plyvel-next, which has wheels for Python 3.12 and later.

    Raises ValueError if none is installed.
    """
    with suppress(ImportError):
        import plyvel  # pyright: ignore[reportMissingImports]

        return plyvel
    with suppress(ImportError):
        import plyvel_next  # pyright: ignore[reportMissingImports]

        return plyvel_next
    raise ValueError("is a LevelDB, which needs an extra package: pip install 'netspec-caffe[leveldb]'")


class Writer:
    """Writes a new database that appears at its path only when it is complete.

    A context manager: records are written to a hidden folder next to the path, which is renamed at the end, or removed
    after an error. Missing parent folders are created. Memory use is constant, and Caffe can read the result. Raises
    SpecError if the path already exists (as Caffe does) or cannot be written to.
    """

    def __init__(self, path: str, backend: str = "lmdb") -> None:
        self.path = path.rstrip("/") or path
        if backend.lower() not in BACKENDS:
            raise SpecError(f'unknown backend "{backend}"; expected one of: {", ".join(BACKENDS)}', Where(path))
        self._backend = backend.lower()
        self._end = ExitStack()
        self._store: _LmdbStore | _LevelDbStore | None = None

    def __enter__(self) -> Writer:
        if os.path.lexists(self.path):
            raise SpecError("already exists; remove it or choose another name for the database", Where(self.path))
        try:
            os.makedirs(os.path.dirname(self.path) or ".", exist_ok=True)
            with ExitStack() as stack:
                unfinished = stack.enter_context(whole_folder(self.path))
                self._store = (_LmdbStore if self._backend == "lmdb" else _LevelDbStore)(str(unfinished))
                stack.callback(self._store.close)
                self._end = stack.pop_all()
        except (OSError, ValueError, lmdb.Error) as fault:
            raise SpecError(f"cannot write a database here ({fault})", Where(self.path)) from None
        _log_opened(self._backend, self.path)
        return self

    def put(self, key: bytes, value: bytes) -> None:
        """Add a record; it replaces an earlier one with the same key."""
        assert self._store is not None, "put() outside of the with block"
        try:
            self._store.put(key, value)
        except (lmdb.Error, OSError) as fault:
            name = key.decode(errors="backslashreplace")
            raise SpecError(f'cannot write record "{name}" ({self._why(fault)})', Where(self.path)) from None

    def commit(self) -> None:
        """Write the records so far to the file system."""
        assert self._store is not None, "commit() outside of the with block"
        try:
            self._store.commit()
        except (lmdb.Error, OSError) as fault:
            raise SpecError(f"cannot write to the database ({self._why(fault)})", Where(self.path)) from None

    def _why(self, fault: Exception) -> str:
        """Return why writing failed. On a full disk, LMDB's error is "Input/output error"."""
        free = shutil.disk_usage(Path(self.path).absolute().parent).free
        return f"the disk is full: {amount(free)} left" if free < LEAST_FREE_BYTES else str(fault)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.commit()
            self._store = None
            self._end.__exit__(kind, error, trace)
        except (lmdb.Error, OSError) as fault:
            raise SpecError(f"cannot rename the finished database to its path ({fault})", Where(self.path)) from None
        except SpecError as fault:
            self._end.__exit__(type(fault), fault, None)
            raise


class _LmdbStore:
    """A growing LMDB: if the map is full, it is doubled and the batch is written again.

    Caffe: LMDBTransaction (src/caffe/util/db_lmdb.cpp). The files are byte-identical if 1000 records have at most
    ``_COMMIT_BYTES``.
    """

    def __init__(self, folder: str) -> None:
        self._env = lmdb.open(folder, map_size=_FIRST_MAP_SIZE, mode=0o664, lock=False, sync=False)
        self._longest = self._env.max_key_size()
        self._batch: list[tuple[bytes, bytes]] = []
        self._bytes = 0

    def put(self, key: bytes, value: bytes) -> None:
        if not 0 < len(key) <= self._longest:
            raise lmdb.BadValsizeError(f"found a key of {len(key)} bytes, expected 1 to {self._longest}")
        self._batch.append((key, value))
        self._bytes += len(key) + len(value)
        if len(self._batch) >= _COMMIT_RECORDS or self._bytes >= _COMMIT_BYTES:
            self.commit()

    def commit(self) -> None:
        while self._batch:
            try:
                with self._env.begin(write=True) as transaction:
                    for key, value in self._batch:
                        transaction.put(key, value)
                self._batch.clear()
                self._bytes = 0
            except lmdb.MapFullError:
                self._env.set_mapsize(2 * self._env.info()["map_size"])

    def close(self) -> None:
        self._env.close()


class _LevelDbStore:
    def __init__(self, folder: str) -> None:
        self._library = leveldb()
        self._db = self._library.DB(folder, create_if_missing=True, error_if_exists=True)
        self._batch = self._db.write_batch()
        self._bytes = self._records = 0

    def put(self, key: bytes, value: bytes) -> None:
        self._batch.put(key, value)
        self._bytes += len(key) + len(value)
        self._records += 1
        if self._records >= _COMMIT_RECORDS or self._bytes >= _COMMIT_BYTES:
            self.commit()

    def commit(self) -> None:
        try:
            self._batch.write()
        except self._library.Error as fault:
            raise OSError(_message(fault)) from None
        self._batch = self._db.write_batch()
        self._bytes = self._records = 0

    def close(self) -> None:
        self._db.close()
