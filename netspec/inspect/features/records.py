"""Computing blobs of a net for the records of its data layer, as arrays or, like Caffe's tool, in databases.

Caffe: tools/extract_features.cpp
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
import torch

from netspec import log
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.errors import SpecError, Where, check_blobs
from netspec.net.net import Net

Progress = Callable[[Iterable[int]], Iterable[int]]  # like tqdm: wraps an iterable


def with_sources(net: Any, source: Any, sources: dict[str, str]) -> Any:
    """Return a copy of the net in which the named data layers read other databases (layer name -> path)."""
    changed = type(net)()
    changed.CopyFrom(net)
    for name, path in sources.items():
        layers = [layer for layer in changed.layer if layer.name == name and layer.HasField("data_param")]
        if not layers:
            readers = [layer.name for layer in net.layer if layer.HasField("data_param")]
            known = ", ".join(dict.fromkeys(readers)) or "none"
            raise SpecError(f'no data layer "{name}" in this net; its data layers: {known}', Where(source.file))
        for layer in layers:
            layer.data_param.source = path
    return changed


def extract_records(
    net: Net, blobs: Sequence[str], iterations: int | None = None, progress: Progress = iter
) -> dict[str, np.ndarray]:
    """Return each blob for the records of the net's data layer, flattened to (N, D) float32.

    Also returns ``keys`` (N,), ``seconds_per_record`` (for reading and the net) and ``parameters`` (their number).

    Runs ``iterations`` batches; by default, as many as needed to read every record once (repeated ones are dropped).
    Raises SpecError if the net reads no records or lacks a blob.
    """
    readers = [layer for layer in net.data_layers if layer.num_records]
    if not readers:
        raise SpecError("no layer of this net reads records; use image files instead", Where(net.plan.source.file))
    check_blobs(blobs, net.shapes, net.plan.source.file)
    reader: Any = readers[0]
    batch = reader.top_shapes[0][0]
    records, first = reader.num_records, reader.iteration
    rounds = -(-records // batch) if iterations is None else iterations
    rows = min(records, rounds * batch) if iterations is None else rounds * batch
    net.keep = list(blobs)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in blobs}
    begin = time.perf_counter()
    with torch.no_grad():
        for _ in progress(range(rounds)):
            net()
            for name in blobs:
                value = net.blobs[name]
                if value.dim() == 0 or value.shape[0] != batch:
                    message = (
                        f'blob "{name}" has shape {tuple(value.shape)}, expected one row per record ({batch} per batch)'
                    )
                    raise SpecError(message, Where(net.plan.source.file))
                parts[name].append(value.reshape(batch, -1).cpu().numpy())
    arrays = {name: np.concatenate(part)[:rows] for name, part in parts.items()}
    arrays["seconds_per_record"] = np.array((time.perf_counter() - begin) / (rounds * batch))
    arrays["parameters"] = np.array(sum(learnable.parameter.numel() for learnable in net.learnable))
    keys = [key for i in range(first, first + rounds) for key in reader.keys(i)]
    arrays["keys"] = np.array(keys[:rows])
    return arrays


COMMITTED = 1000  # records per commit; each commit is logged


def extract_features(net: Net, blobs: Sequence[str], databases: Sequence[str], batches: int, backend: str) -> None:
    """Run ``batches`` mini-batches and write each blob's rows to its database, under keys ``%010d``.

    A row (C, H, W) keeps its shape; a row of fewer axes gets axes of size 1 at the end. Raises SpecError if there are
    not as many databases as blobs, or if the net lacks a blob.
    """
    where = Where(net.plan.source.file)
    if len(blobs) != len(databases):
        message = f"found {len(blobs)} blob names and {len(databases)} databases, expected one database per blob"
        raise SpecError(message, where)
    check_blobs(blobs, net.shapes, net.plan.source.file)
    for name in blobs:
        if not 1 <= len(net.shapes[name]) <= 4:
            raise SpecError(f'blob "{name}" has shape {net.shapes[name]}, expected 1 to 4 axes', where)
    net.keep = list(blobs)
    log.error("extract_features.cpp:133", "Extracting Features")
    written = 0
    with ExitStack() as stack, torch.no_grad():
        writers = [stack.enter_context(Writer(path, backend)) for path in databases]
        for _ in range(batches):
            net()
            rows = 0
            for name, writer in zip(blobs, writers, strict=True):
                values = net.blobs[name].cpu().numpy()
                rows = len(values)
                shape = (*values.shape[1:], 1, 1, 1)[:3]
                for n, value in enumerate(values):
                    datum = array_to_datum(value.reshape(shape))
                    writer.put(b"%010d" % (written + n), datum.SerializeToString())
            if (written + rows) // COMMITTED > written // COMMITTED:
                _log_count(written + rows, blobs)
            written += rows
    if written % COMMITTED:
        _log_count(written, blobs)
    log.error("extract_features.cpp:181", "Successfully extracted the features!")


def _log_count(count: int, blobs: Sequence[str]) -> None:
    for name in blobs:
        log.error("extract_features.cpp:176", f"Extracted features of {count} query images for feature blob {name}")
