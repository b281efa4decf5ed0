"""Refuses an LMDB that is not whole before the library maps it: reading past the end of a mapped file is a crash.

Pages 0 and 1 each describe a state of the database, of which the one with the later transaction is valid. LMDB:
libraries/liblmdb/mdb.c (MDB_meta, MDB_db, MDB_page, MDB_node), format 1
"""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

_META, _FORMAT = struct.Struct("<16x IIQQ" + 2 * "IHHQQQQQ" + "QQ"), (0xBEEFC0DE, 1)
_PAGE, _NODE = struct.Struct("<QHHHH"), struct.Struct("<HHHH")
_LEAF, _LARGE_VALUE = 2, 1  # flags of a page and of a node


def check_is_whole(path: str) -> None:
    """Raise ValueError if a data.mdb is no LMDB, was cut, or ends in zeros, as unfinished copies do."""
    with open(path, "rb") as file:
        size, first = os.fstat(file.fileno()).st_size, _meta(file, 0)
        if not first:
            raise ValueError("has a data.mdb that is not an LMDB, or from another LMDB version or kind of machine")
        page_size = first[4]
        *_, depth, _, _, _, records, root, last, _ = max(first, _meta(file, page_size) or first, key=lambda m: m[-1])
        expected = (last + 1) * page_size
        file.seek(last * page_size)
        # A file without its last pages can be whole, if they are not in use; so can one whose last value is zeros.
        if records and (size < expected or not any(file.read(page_size))):
            try:
                _check_below(file, page_size, root, depth)
            except (ValueError, OverflowError, struct.error, RecursionError):
                raise ValueError(f"is truncated: data.mdb lacks some of its {expected} bytes, or they are 0") from None


def _meta(file: BinaryIO, offset: int) -> tuple[int, ...]:
    file.seek(offset)
    data = file.read(_META.size)
    fields = _META.unpack(data) if len(data) == _META.size else ()
    return fields if fields[:2] == _FORMAT else ()


def _check_below(file: BinaryIO, page_size: int, number: int, depth: int) -> None:
    """Raise an error if a page, or one below it, is not in the file."""
    file.seek(number * page_size)
    page = file.read(page_size)
    own, _, kind, end, _ = _PAGE.unpack_from(page)
    if own != number or bool(kind & _LEAF) != (depth == 1) or len(page) < page_size:
        raise ValueError
    for start in struct.unpack_from(f"<{(end - _PAGE.size) // 2}H", page, _PAGE.size):
        low, high, flags, key_size = _NODE.unpack_from(page, start)
        if depth > 1:
            _check_below(file, page_size, low | high << 16 | flags << 32, depth - 1)
        elif flags & _LARGE_VALUE:
            (first,) = struct.unpack_from("<Q", page, start + _NODE.size + key_size)
            file.seek(first * page_size)
            header = file.read(_PAGE.size)
            file.seek((low | high << 16) - 1, os.SEEK_CUR)
            if header[:8] != first.to_bytes(8, "little") or not file.read(1):
                raise ValueError
