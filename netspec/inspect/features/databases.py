"""Features as Caffe's own tool writes them: one float Datum per record, one database per blob.

Caffe: tools/extract_features.cpp
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import torch

from netspec import log
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum
from netspec.errors import SpecError, Where
from netspec.graph import check_blobs
from netspec.net.net import Net

COMMITTED = 1000  # records between two commits; each commit is logged


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
                _tell(written + rows, blobs)
            written += rows
    if written % COMMITTED:
        _tell(written, blobs)
    log.error("extract_features.cpp:181", "Successfully extracted the features!")


def _tell(count: int, blobs: Sequence[str]) -> None:
    for name in blobs:
        log.error("extract_features.cpp:176", f"Extracted features of {count} query images for feature blob {name}")
