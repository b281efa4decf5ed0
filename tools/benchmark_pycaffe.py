#!/usr/bin/env python3
"""Time pycaffe against netspec itself: ``tools/benchmark_pycaffe.py MODEL``, or ``SOLVER --solver``.

The two run in turns, so that what else the machine does meets both alike; the ratio is that of neighboring runs. A net
runs forward, on one item unless --batch says otherwise, weights being random; a solver takes single steps.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("GLOG_minloglevel", "2")

import numpy as np
import torch

import netspec
import netspec.pycaffe as caffe


def main() -> int:
    """Print milliseconds a pass, or an iteration, and the ratio of times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="the prototxt of a net that starts from inputs, or of a solver")
    parser.add_argument("--solver", action="store_true", help="the file is a solver's")
    parser.add_argument("--batch", type=int, default=1, help="items in each input (default: 1)")
    parser.add_argument("--runs", type=int, default=20, help="passes to time (default: 20)")
    parser.add_argument("--threads", type=int, default=1, help="threads that a pass may use (default: 1)")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    try:
        runs = steps(arguments.file) if arguments.solver else passes(arguments.file, arguments.batch)
    except ValueError as fault:
        print(fault, file=sys.stderr)
        return 1
    for run in runs:
        run()  # the first pass, which also allocates
    seconds = [[measure(run) for run in runs] for _ in range(arguments.runs)]
    for k, name in enumerate(("pycaffe", "netspec")):
        print(f"{name}: {1e3 * statistics.median(row[k] for row in seconds):.2f} ms")
    print(f"ratio of times: {statistics.median(row[0] / row[1] for row in seconds):.3f}")
    return 0


def passes(model: str, batch: int) -> list[Callable[[], object]]:
    """Return forward passes of pycaffe and of netspec: of one net, on the same input."""
    shown = caffe.Net(model, caffe.TEST)
    own = netspec.load_net(model, "TEST")
    random = np.random.default_rng(0)
    inputs = {}
    for name in shown.inputs:
        shape = (batch, *shown.blobs[name].shape[1:])
        inputs[name] = random.standard_normal(shape, np.float32)
        shown.blobs[name].reshape(*shape)
        shown.blobs[name].data[...] = inputs[name]

    def forward() -> dict[str, np.ndarray]:
        with torch.inference_mode():
            return {name: blob.numpy() for name, blob in own(**inputs).items()}

    return [shown.forward, forward]


def steps(solver: str) -> list[Callable[[], object]]:
    """Return single steps of pycaffe's solver and of netspec's."""
    shown, own = caffe.get_solver(solver), netspec.load_solver(solver, device="cpu")
    return [lambda: (shown.step(1), float(shown.net.blobs[shown.net.outputs[0]].data.sum())), lambda: own.step(1)]


def measure(run: Callable[[], object]) -> float:
    """Return the seconds of a pass."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


sys.exit(main())
