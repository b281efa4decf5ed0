#!/usr/bin/env python3
"""Time a net's forward pass, and compare it with OpenCV's importer: ``tools/benchmark_forward.py MODEL --opencv``.

The two run in turns, so that other load on the machine affects both equally; ratios are of consecutive runs.
OpenCV reads Caffe's files up to version 4 (opencv-python-headless<5).
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
import torch

import netspec

Run = Callable[[], dict[str, np.ndarray]]


def main() -> int:
    """Print milliseconds per pass and, with ``--opencv``, the ratio of times and the difference of outputs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="the prototxt of a net with inputs")
    parser.add_argument("--weights", help="its weights (default: random weights and BatchNorm statistics)")
    parser.add_argument("--runs", type=int, default=20, help="passes to time (default: 20)")
    parser.add_argument("--threads", type=int, default=1, help="threads per pass (default: 1)")
    parser.add_argument("--opencv", action="store_true", help="compare with OpenCV's importer (version 4)")
    parser.add_argument("--blob", nargs="+", help="the blobs to compare (default: the outputs)")
    arguments = parser.parse_args()
    importer = getattr(cv2.dnn, "readNetFromCaffe", None)
    if arguments.opencv and importer is None:
        print(f"OpenCV {cv2.__version__} does not read Caffe's files; opencv-python-headless<5 does", file=sys.stderr)
        return 1
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    try:
        net = netspec.load_net(arguments.model, "TEST", arguments.weights, seed=0)
    except netspec.SpecError as fault:
        print(fault, file=sys.stderr)
        return 1
    if not arguments.weights:
        torch.manual_seed(0)
        randomize(net)
    random = np.random.default_rng(0)
    inputs = {name: random.standard_normal(net.shapes[name], np.float32) for name in net.inputs}
    blobs = arguments.blob or net.outputs
    runs = {"netspec": ours(net, inputs, blobs)}
    if importer is not None and arguments.opencv:
        with tempfile.TemporaryDirectory() as folder:
            weights = str(Path(folder) / "weights.caffemodel")
            netspec.save_weights(net, weights)
            runs[f"OpenCV {cv2.__version__}"] = opencvs(importer(arguments.model, weights), inputs, blobs)
    outputs = [run() for run in runs.values()]  # the first pass, which also allocates
    seconds = [[measure(run) for run in runs.values()] for _ in range(arguments.runs)]
    for k, name in enumerate(runs):
        print(f"{name}: {1e3 * statistics.median(row[k] for row in seconds):.2f} ms per pass")
    if importer is not None and arguments.opencv:
        print(f"ratio of times: {statistics.median(row[0] / row[1] for row in seconds):.2f}")
        for name, value in outputs[0].items():
            scale = np.abs(outputs[1][name]).max()
            difference = np.abs(value.reshape(-1) - outputs[1][name].reshape(-1)).max() / scale
            print(f"{name}: off by {difference:.1e} of the largest value, {scale:.3g}")
    return 0


def randomize(net: netspec.Net) -> None:
    """Set BatchNorm statistics as after some training, and normally distributed weights where there is no filler."""
    for layer in net.layers:
        if layer.type == "BatchNorm":
            means, variances, weight = (blob.data for blob in layer.blobs)
            weight.fill_(50)
            means.normal_(0, 0.1).mul_(weight)
            variances.uniform_(0.5, 1.5).mul_(weight)
            continue
        for blob in layer.blobs:
            if not blob.data.any():
                blob.data.normal_(0, (2 / blob[0].numel()) ** 0.5 if blob.dim() > 1 else 0.1)


def ours(net: netspec.Net, inputs: dict[str, np.ndarray], blobs: list[str]) -> Run:
    """Return a forward pass of this project."""
    net.keep = blobs

    def run() -> dict[str, np.ndarray]:
        with torch.inference_mode():
            net(**inputs)
        return {name: net.blobs[name].numpy() for name in blobs}

    return run


def opencvs(imported: Any, inputs: dict[str, np.ndarray], blobs: list[str]) -> Run:
    """Return a forward pass of a net that OpenCV imported."""

    def run() -> dict[str, np.ndarray]:
        for name, value in inputs.items():
            imported.setInput(value, name)
        return dict(zip(blobs, imported.forward(blobs), strict=True))

    return run


def measure(run: Run) -> float:
    """Return the seconds of a pass."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


sys.exit(main())
