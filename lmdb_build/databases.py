"""Writes lists of single images or pairs to databases of Datums.

A pair becomes one Datum, both images stacked along the channels: six for color (blue, green, red of the first, then
of the second), two for gray. An encoded Datum can hold only one image, so encoded pairs become two databases in the
same order.

Caffe: tools/convert_imageset.cpp, examples/siamese/convert_mnist_siamese_data.cpp
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from lmdb_build.pairs.list_file import read_pair_list
from loopclosure.progress import Progress, silent
from netspec import log
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum, decode_image, encoded_datum, shape_text
from netspec.data.images import read_image, read_image_list
from netspec.data.random_words import permutation
from netspec.errors import SpecError, Where
from netspec.files.opencv import cv2

S = TypeVar("S")
T = TypeVar("T")
_AHEAD = 8  # pending entries per worker


@dataclass(frozen=True)
class Entry:
    """A record to write: one or two images, the label, and the line in the list."""

    images: tuple[str, ...]
    label: int
    where: Where


@dataclass(frozen=True)
class DatumOptions:
    """How images become Datums of a database.

    color       color or grayscale
    size        (height, width) to resize to; None: each file's own size
    encoding    None: store pixels; "": store the file's format; else a format such as "png" or "jpg"
    backend     "lmdb" or "leveldb"
    check_size  raise an error if an image has another size than the first
    skip        log and leave out entries that cannot be read, as Caffe's convert_imageset does; the other keys do not
                change; an error if no entry can be read
    workers     number of processes that read images; None: one per core
    """

    color: bool = True
    size: tuple[int, int] | None = None
    encoding: str | None = None
    backend: str = "lmdb"
    check_size: bool = False
    skip: bool = False
    workers: int | None = None


def read_pairs(path: str) -> list[Entry]:
    """Return the entries of a list of pairs; see lmdb_build/pairs/list_file.py. Raises SpecError for a bad line."""
    pairs = read_pair_list(Path(path))
    return [Entry((pair.first, pair.second), pair.label, Where(path, pair.line, 1)) for pair in pairs]


def read_single_list(path: str) -> list[Entry]:
    """Read lines of ``name label``, split at the last space. Raises SpecError for a bad line."""
    return [Entry((image.name,), image.label, image.where) for image in read_image_list(path)]


def shuffled(entries: Sequence[Entry], seed: int) -> list[Entry]:
    """Return the entries in a random order that depends only on the seed."""
    return [entries[i] for i in permutation(seed, "convert/shuffle", len(entries))]


def pair_key(number: int, entry: Entry) -> str:
    """Return the key of a pair, as in convert_mnist_siamese_data."""
    return f"{number:08d}"


def image_key(number: int, entry: Entry) -> str:
    """Return the key of a single image, as in convert_imageset."""
    return f"{number:08d}_{entry.images[0]}"


def write_databases(
    entries: Sequence[Entry],
    root: str,
    paths: Sequence[str],
    options: DatumOptions,
    key: Callable[[int, Entry], str],
    progress: Progress = silent,
) -> None:
    """Write entries, in order, to new databases, which appear when they are complete.

    ``paths`` has one database, or, with encoded images, one for each image of an entry. Image names are relative to
    ``root``. Raises SpecError, with the line in the list, for an image that is missing, unreadable, or differs in size
    from its partner.
    """
    assert len(paths) == (1 if options.encoding is None else len(entries[0].images))
    work = partial(_try, root=root if root.endswith("/") or not root else root + "/", options=options)
    first: tuple[int, ...] | None = None
    written, skipped = 0, None
    with ExitStack() as stack:
        results = stack.enter_context(_Workers(options.workers or os.cpu_count() or 1)).ordered(work, entries)
        writers = [stack.enter_context(Writer(path, options.backend)) for path in paths]
        for number, result in enumerate(progress(results, "records", len(entries))):
            entry = entries[number]
            if isinstance(result, SpecError):
                if not options.skip:
                    raise result
                log.error("io.cpp:80", str(result))
                skipped = skipped or result
                continue
            records, shape = result
            first = first or shape
            if options.check_size and shape != first:
                message = f"gives {shape_text(shape)}, but the first line gives {shape_text(first)} (-check_size)"
                raise SpecError(f'"{entry.images[0]}" {message}', entry.where)
            for writer, record in zip(writers, records, strict=True):
                writer.put(key(number, entry).encode(), record)
            written += 1
            if written % 1000 == 0:
                log.info("convert_imageset.cpp:147", f"Processed {written} files.")
        if skipped and not written:
            raise skipped
        for writer in writers:  # all of them before the first one appears
            writer.commit()
    if written % 1000:
        log.info("convert_imageset.cpp:153", f"Processed {written} files.")
    if skipped:
        count = len(entries) - written
        log.warning("convert_imageset.cpp:121", f"Skipped {count} of {len(entries)} images, which cannot be read")


def _try(entry: Entry, root: str, options: DatumOptions) -> tuple[list[bytes], tuple[int, ...]] | SpecError:
    try:
        return _records(entry, root, options)
    except SpecError as fault:
        return fault


def _records(entry: Entry, root: str, options: DatumOptions) -> tuple[list[bytes], tuple[int, ...]]:
    """Return an entry's serialized Datums, and the shape of their values."""
    paths = [root + name for name in entry.images]
    try:
        if options.encoding is not None:
            encoded = [_encode(path, entry.label, options) for path in paths]
            return [record for record, _ in encoded], encoded[0][1]
        images = [read_image(path, options.color, options.size) for path in paths]
    except ValueError as fault:
        raise SpecError(str(fault), entry.where) from None
    shapes = [image.shape for image in images]
    if shapes[0] != shapes[-1]:
        message = f'"{paths[0]}" is {shape_text(shapes[0])}, but its partner "{paths[1]}" is {shape_text(shapes[1])}'
        raise SpecError(f"{message}; set -resize_width and -resize_height", entry.where)
    stacked = np.concatenate(images)
    return [array_to_datum(stacked, entry.label).SerializeToString()], stacked.shape


def _encode(path: str, label: int, options: DatumOptions) -> tuple[bytes, tuple[int, ...]]:
    """Return one encoded Datum. A file that already has the requested format is stored unchanged, as in Caffe.

    Unlike here, Caffe stores a color file unchanged even with -gray.
    """
    suffix = Path(path).suffix[1:].lower().replace("jpeg", "jpg")
    encoding = (options.encoding or suffix).lower().replace("jpeg", "jpg")
    if not encoding:
        raise ValueError(f'image "{path}" has no extension that gives its format; set -encode_type')
    image = read_image(path, options.color, options.size)
    if encoding == suffix and not options.size:
        file = Path(path).read_bytes()
        if decode_image(file).shape[0] == image.shape[0]:
            return encoded_datum(file, label).SerializeToString(), image.shape
    try:
        _, data = cv2.imencode(f".{encoding}", image.transpose(1, 2, 0))
    except cv2.error:
        raise ValueError(f'image "{path}" cannot be encoded as "{encoding}"; try -encode_type png') from None
    return encoded_datum(data.tobytes(), label, image.shape).SerializeToString(), image.shape


class _Workers:
    """A pool of processes; a single worker is this process."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Workers:
        if self._count > 1:
            # Fork on Linux: a spawned process could not import a script that was read from standard input. On macOS
            # a forked process can crash in system libraries that were used before.
            context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
            self._pool = ProcessPoolExecutor(self._count, context, initializer=_start_worker)
            self._pool.submit(os.getpid)  # forks now, before the progress bar has a thread
        return self

    def __exit__(self, *exception: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def ordered(self, work: Callable[[S], T], items: Iterable[S]) -> Iterator[T]:
        """Yield the results in the order of the items. The number of pending items is limited, to bound memory."""
        if self._pool is None:
            yield from map(work, items)
            return
        pending: deque[Future[T]] = deque()
        try:
            for item in items:
                pending.append(self._pool.submit(work, item))
                if len(pending) >= self._count * _AHEAD:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        except BrokenProcessPool:
            raise SpecError("a process that reads images was killed; did the machine run out of memory?") from None


def _start_worker() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent ends the pool
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(0)


def _end_with_parent() -> None:
    """End this process when its parent ends, even if the parent is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
