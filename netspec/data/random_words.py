"""Random numbers by record: what is drawn for record k follows from the seed, the stream's name and k alone.

So a batch is the same whoever reads it first and however many threads read ahead, and a run can go on from any
iteration. The generator is counter-based (Philox-4x64), and its raw words are what numpy promises never to change.
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


def permutation(seed: int, stream: str, count: int) -> np.ndarray:
    """Return the numbers 0 to ``count - 1`` in random order: int64 (count,)."""
    blocks = -(-count // WORDS)
    return np.argsort(words(seed, stream, 0, blocks).ravel()[:count], kind="stable")
