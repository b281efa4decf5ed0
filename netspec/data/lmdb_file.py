"""Reading the records of an LMDB from its file, page by page.

The LMDB library maps the file into memory and trusts its contents. If the file is truncated, damaged, or changed by
another program, the process crashes. This module reads and checks every page and raises ValueError instead.

A file has pages of equal size. Pages 0 and 1 each describe a state of the database; the one with the later transaction
is valid. Below its root, branch pages refer to pages. Leaf pages contain keys with their values, or with the number of
the first page of a large value.

LMDB: libraries/liblmdb/mdb.c (MDB_meta, MDB_db, MDB_page, MDB_node), format 1
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Lock
from typing import NamedTuple

_HEADER = 16  # bytes of a page's header; in a meta page, the meta data follows
_META = struct.Struct("<IIQQ" + 2 * "IHHQQQQQ" + "QQ")
_MAGIC, _VERSION = 0xBEEFC0DE, 1
_PAGE = struct.Struct("<QHHHH")  # page number, padding, type, end of the pointers, start of the nodes
_NODE = struct.Struct("<HHHH")  # size of the value or page number, in two or three parts; size of the key
_BRANCH, _LEAF = 1, 2  # types of pages
_LARGE = 1  # a node whose value is on separate pages
_PAGE_SIZES = [1 << k for k in range(8, 17)]
_DEEPEST = 32  # CURSOR_STACK
_SMALLEST = 11  # minimum bytes of a record: a node with a key of one byte, and its pointer
_AT_ONCE = 1 << 22  # maximum bytes to read for several values; their copies need the same amount
_NOWHERE = (1 << 64) - 1  # P_INVALID: the root of an empty database


class Record(NamedTuple):
    """The key of a record, and the offset and size of its value in the file, in bytes."""

    key: bytes
    offset: int
    size: int


class LmdbFile:
    """The records of a data.mdb, in the order of their keys; ``len()`` is their number.

    Raises ValueError if the file is not an LMDB or is damaged, and OSError if it cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self._lock = Lock()
        self._file = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        try:
            self._stamp = self._size_and_time()
            self._read_meta()
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return self._entries

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        if getattr(self, "_file", -1) >= 0:
            os.close(self._file)
            self._file = -1

    def records(self) -> Iterator[Record]:
        """Yield all records."""
        count = 0
        for record in self._below(self._root, self._depth) if self._entries else ():
            count += 1
            if count > self._entries:
                break
            yield record
        if count != self._entries:
            raise ValueError(f"is damaged: {self._entries} records expected from its header, found {count} or more")

    def values(self, records: Sequence[Record]) -> list[bytes]:
        """Return the values of records; adjacent values are read together."""
        if not self.is_current:
            raise ValueError("was changed by another program while it was being read")
        start = min(record.offset for record in records)
        size = max(record.offset + record.size for record in records) - start
        if len(records) > 1 and size <= min(_AT_ONCE, self._page_size + 2 * sum(record.size for record in records)):
            data = self._bytes(start, size)
            offsets = [record.offset - start for record in records]
            return [data[offset : offset + record.size] for offset, record in zip(offsets, records, strict=True)]
        return [self._bytes(record.offset, record.size) for record in records]

    @property
    def is_current(self) -> bool:
        """Whether the file has not changed since it was opened."""
        return self._size_and_time() == self._stamp

    def _size_and_time(self) -> tuple[int, int]:
        state = os.fstat(self._file)
        return state.st_size, state.st_mtime_ns

    def _read_meta(self) -> None:
        size, _ = self._stamp
        first = self._meta(0)
        if first is None:
            raise ValueError("has a data.mdb that is not an LMDB, or from another LMDB version or kind of machine")
        self._page_size = first[4]  # the page size, in the unused entry of the list of free pages
        if self._page_size not in _PAGE_SIZES:
            raise ValueError(f"is damaged: it has pages of {self._page_size} bytes")
        meta = max(first, self._meta(self._page_size) or first, key=lambda found: found[-1])
        *_, flags, self._depth, _, _, _, self._entries, self._root, last, _ = meta
        if flags or self._depth > _DEEPEST or self._entries * _SMALLEST > size:
            found = f"flags {flags}, depth {self._depth}, {self._entries} records in {size} bytes"
            raise ValueError(f"is damaged, or has several values per key: {found}")
        if self._entries and self._root == _NOWHERE:
            raise ValueError(f"is damaged: {self._entries} records expected from its header, found none")
        expected = (last + 1) * self._page_size
        if size < 2 * self._page_size or (size < expected and not self._is_whole()):
            raise ValueError(f"is truncated: data.mdb has {size} bytes, expected at least {expected}")

    def _is_whole(self) -> bool:
        """Return whether all records are in the file; unused pages at the end may be missing."""
        try:
            return sum(1 for _ in self.records()) == self._entries
        except ValueError:
            return False

    def _meta(self, offset: int) -> tuple[int, ...] | None:
        """Return the fields of a meta page without its header; None if it is not a meta page."""
        data = self._read(_META.size, offset + _HEADER)
        fields = _META.unpack(data) if len(data) == _META.size else (0, 0)
        return fields if fields[:2] == (_MAGIC, _VERSION) else None

    def _below(self, number: int, levels: int) -> Iterator[Record]:
        """Yield the records of the leaves below a page, ``levels`` pages deep."""
        page, kind, starts = self._page(number)
        if levels <= 0 or kind != (_LEAF if levels == 1 else _BRANCH):
            raise self._damage(number)
        for start in starts:
            low, high, flags, key_size = _NODE.unpack_from(page, start)
            key_start = start + _NODE.size
            if kind == _BRANCH:
                yield from self._below(low | high << 16 | flags << 32, levels - 1)
                continue
            size, key = low | high << 16, page[key_start : key_start + key_size]
            here = key_start + key_size
            if flags == _LARGE and here + 8 <= len(page):
                yield Record(key, self._large(int.from_bytes(page[here : here + 8], "little"), size), size)
            elif flags == 0 and here + size <= len(page):
                yield Record(key, number * self._page_size + here, size)
            else:
                raise self._damage(number)

    def _page(self, number: int) -> tuple[bytes, int, tuple[int, ...]]:
        """Return a page, its type, and the offsets of its nodes."""
        page = self._bytes(number * self._page_size, self._page_size)
        own, _, kind, lower, _ = _PAGE.unpack_from(page)
        count, odd = divmod(lower - _HEADER, 2)
        if own != number or count < 1 or odd or lower > len(page):
            raise self._damage(number)
        starts = struct.unpack_from(f"<{count}H", page, _HEADER)
        if min(starts) < lower or max(starts) + _NODE.size > len(page):
            raise self._damage(number)
        return page, kind, starts

    def _large(self, number: int, size: int) -> int:
        """Return the offset of a value on separate pages."""
        start = number * self._page_size + _HEADER
        if start + size > self._stamp[0]:
            raise self._damage(number)
        return start

    def _bytes(self, offset: int, size: int) -> bytes:
        if offset + size > self._stamp[0]:
            raise self._damage(offset // self._page_size)
        data = self._read(size, offset)
        while len(data) < size:  # a read returns at most 2 GiB, and nothing at the end of the file
            more = self._read(size - len(data), offset + len(data))
            if not more:
                raise ValueError("was truncated by another program while it was being read")
            data += more
        return data

    def _read(self, size: int, offset: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(self._file, size, offset)
        with self._lock:  # Windows
            os.lseek(self._file, offset, os.SEEK_SET)
            return os.read(self._file, size)

    def _damage(self, number: int) -> ValueError:
        return ValueError(f"is damaged: page {number} of data.mdb is not valid")
