"""A built net, shown: as a table to read, as JSON for programs."""

from __future__ import annotations

from typing import Any

import torch

from netspec.net.net import Net


def as_json(net: Net) -> dict[str, Any]:
    """Return ``blobs`` name -> shape, ``params`` layer -> shapes, ``inputs``, ``outputs``."""
    params = {}
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        if layer.blob_shapes:
            params[node.name] = [list(shape) for shape in layer.blob_shapes]
    blobs = {name: list(shape) for name, shape in net.shapes.items()}
    return {"blobs": blobs, "params": params, "inputs": net.inputs, "outputs": net.outputs}


def table(net: Net) -> str:
    """Return a line a layer: name, type, top shapes, parameters, memory of its tops, multiply-adds; and the totals."""
    head = ("layer", "type", "tops", "parameters", "MiB", "multiply-adds")
    rows = []
    totals = [0, 0, 0]
    counted: set[int] = set()
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        parameters = sum(blob.numel() for blob in layer.blobs if id(blob) not in counted)
        shared = len(layer.blobs) > 0 and parameters == 0
        counted.update(id(blob) for blob in layer.blobs)
        memory = 4 * sum(torch.Size(shape).numel() for shape in layer.top_shapes)
        work = layer.multiply_adds()
        for k, value in enumerate((parameters, memory, work)):
            totals[k] += value
        tops = ", ".join("x".join(map(str, shape)) or "scalar" for shape in layer.top_shapes)
        count = "shared" if shared else (f"{parameters:,}" if parameters else "")
        rows.append((node.name, node.type, tops, count, f"{memory / 2**20:.2f}", f"{work:,}" if work else ""))
    rows.append(("total", "", "", f"{totals[0]:,}", f"{totals[1] / 2**20:.2f}", f"{totals[2]:,}"))
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    lines = []
    for row in (head, *rows):
        cells = [cell.ljust(w) if k < 3 else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
