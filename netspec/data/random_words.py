"""Random numbers by record: the numbers of record k depend only on the seed, the stream's name and k.

Batches therefore do not depend on the order of reading or the number of threads, and a run can continue from any
iteration. The generator is counter-based (Philox-4x64); NumPy guarantees that its raw words never change.
"""

from __future__ import annotations

import hashlib

import numpy as np

WORDS = 4  # a block of Philox


def words(seed: int, stream: str, first: int, count: int) -> np.ndarray:
    """Return the words of the records ``first`` to ``first + count - 1``: uint64 (count, 4)."""
    key = hashlib.blake2b(f"{seed}:{stream}".encode(), digest_size=16).digest()
    generator = np.random.Philox(key=int.from_bytes(key, "little"), counter=first)
    return generator.random_raw(WORDS * count).reshape(count, WORDS)


def words_at(seed: int, stream: str, records: range) -> np.ndarray:
    """Return the words of a range of records, which can have a step: uint64 (len(records), 4)."""
    return words(seed, stream, records.start, len(range(records.start, records.stop)))[:: records.step]


def derived(seed: int, name: str) -> int:
    """Return a seed below 2^32 for one of several parts that are derived from ``seed``."""
    return int.from_bytes(hashlib.blake2b(f"{seed}:{name}".encode(), digest_size=4).digest(), "little")


def permutation(seed: int, stream: str, count: int) -> np.ndarray:
    """Return the numbers 0 to ``count - 1`` in random order: int64 (count,)."""
    blocks = -(-count // WORDS)
    return np.argsort(words(seed, stream, 0, blocks).ravel()[:count], kind="stable")
