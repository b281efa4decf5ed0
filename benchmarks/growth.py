"""How the cost of a net grows with its number of layers: building it, and one training pass."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from netspec.graph.filter import with_state
from netspec.net.build import build_net
from netspec.net.options import BuildOptions
from netspec.proto.schema import TRAIN
from netspec.proto.text import parse_net_text

BLOCK = """
layer {{ name: "conv{i}" type: "Convolution" bottom: "x{i}" top: "c{i}"
  convolution_param {{ num_output: 4 kernel_size: 3 pad: 1 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "bn{i}" type: "BatchNorm" bottom: "c{i}" top: "c{i}" }}
layer {{ name: "scale{i}" type: "Scale" bottom: "c{i}" top: "c{i}" scale_param {{ bias_term: true }} }}
layer {{ name: "sum{i}" type: "Eltwise" bottom: "x{i}" bottom: "c{i}" top: "x{k}" }}
layer {{ name: "relu{i}" type: "ReLU" bottom: "x{k}" top: "x{k}" }}"""
DATA = 'layer { name: "data" type: "Input" top: "x0" input_param { shape { dim: 1 dim: 4 dim: 8 dim: 8 } } }'
LOSS = """
layer {{ name: "loss" type: "Reduction" bottom: "x{i}" top: "loss" loss_weight: 1 }}"""


def residual_net(layers: int) -> str:
    """Return the prototxt of a residual net of small maps that has about so many layers, splits not counted."""
    blocks = max(1, (layers - 2) // 5)
    return DATA + "".join(BLOCK.format(i=i, k=i + 1) for i in range(blocks)) + LOSS.format(i=blocks)


def measure(layers: int) -> tuple[int, float, float]:
    """Return how many layers the net has, the seconds to read and build it, and those of a pass there and back."""
    text = residual_net(layers)
    start = time.perf_counter()
    net, source = parse_net_text(text, "growth.prototxt")
    built = build_net(with_state(net, TRAIN), source, BuildOptions(seed=0, accumulate_in_place=True))
    seconds = time.perf_counter() - start
    data = torch.ones(1, 4, 8, 8)
    passes = []
    for _ in range(3):
        start = time.perf_counter()
        built.forward_loss(x0=data)[0].backward()
        passes.append(time.perf_counter() - start)
    return len(net.layer), seconds, min(passes)


def table(sizes: Sequence[int]) -> str:
    """Return a table of these numbers of layers, in Markdown."""
    measure(sizes[0])  # what only the first net of a process pays for
    rows = ["| layers | reading and building, s | per layer, ms | pass, s | per layer, ms |", "|---|---|---|---|---|"]
    for size in sizes:
        layers, built, run = measure(size)
        rows.append(f"| {layers} | {built:.2f} | {1e3 * built / layers:.2f} | {run:.3f} | {1e3 * run / layers:.2f} |")
    return "\n".join(rows)
