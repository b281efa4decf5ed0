"""Times nets with each part of netspec/fast and without it: ``tools/bench fast``.

A part is a pass over the layers (netspec/fast/steps.py), the kernel of a class of layers, or a function that kernels
use. Two nets of the same files are in one process; one of them was made without the part. They take turns, and the
ratio of their CPU times is the median over the pairs of turns.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.case import calm, deploy_of, training_case, with_batch
from benchmarks.detectors import HEADS, mtcnn, ssd300
from benchmarks.whole import like_trained, net_files
from netspec.graph.options import PASSES
from netspec.proto.text import parse_net_text, write_text

FORWARD = {  # the batch size, and the size of the image if it is not the net's own
    **dict.fromkeys(("siamese_8", "siamese_128", "siamese_resnet27_256", "siamese_resnet27_512"), (1,)),
    **dict.fromkeys(("alexnet", "googlenet", "squeezenet", "mobilenet", "resnet50", "ssd300"), (1,)),
    "pnet": (1, 480, 640),
    "rnet": (32,),
    "onet": (32,),
    "lenet": (64,),
    "cifar10_quick": (100,),
}
TRAINING = {"lenet": 64, "cifar10_quick": 100, "pnet": 64, "rnet": 64, "alexnet": 1, "small/siamese_8": 4}
ALL = "all of fast"
TURN_S, FEWEST_PAIRS, WARM_UPS = 0.06, 5, 3  # CPU seconds of a turn, in which a small net runs several times
Run = Callable[[], object]
Rows = Iterator[dict[str, Any]]


@dataclass(frozen=True)
class Part:
    """A part of netspec/fast.

    ``without()`` is a block in which nets are made without it. ``options`` are those of load_net that do the same.
    """

    name: str
    kind: str
    without: Callable[[], AbstractContextManager[object]] = nullcontext
    options: Mapping[str, Any] = field(default_factory=dict)


WHOLE = Part("whole", "")  # no part is missing


@dataclass(frozen=True)
class Limits:
    """How long a net is measured with and without a part: so many pairs of turns, or fewer after ``seconds``."""

    pairs: int
    seconds: float


def measure(names: Sequence[str], limits: Limits) -> Rows:
    """Yield a row for each net and part: of forward passes, then of trainings. ``names``: nets, or prototxts."""
    for name in names or FORWARD:
        yield from _forward(name, limits)
    for name, batch in TRAINING.items():
        if name in names or not names:
            yield from _training(name, batch, limits)


def _forward(name: str, limits: Limits) -> Rows:
    import torch

    import netspec

    batch, *size = FORWARD.get(name, (1,))
    with TemporaryDirectory(prefix="fast-") as folder:
        files = net_files(Path(folder), "net", _text(name, batch, size), like_trained if name == "ssd300" else calm)

        def made(part: Part) -> tuple[Any, Run]:
            net = netspec.load_net(files[0], "TEST", files[1], seed=0, **part.options)
            random = np.random.default_rng(0)
            inputs = {blob: random.standard_normal(net.shapes[blob], np.float32) for blob in net.inputs}

            def run() -> None:
                with torch.inference_mode():
                    net(**inputs)

            return net, run

        net, run = _warm(made, WHOLE)
        for part in forward_parts(net):
            measured = _compared(run, _warm(made, part)[1], limits)
            yield {"what": "forward", "net": name, "batch": batch, "kind": part.kind, "part": part.name, **measured}


def _training(name: str, batch: int, limits: Limits) -> Rows:
    import netspec

    with training_case(name, batch) as case:

        def made(part: Part) -> tuple[Any, Run]:
            solver = netspec.load_solver(case.solver, case.caffemodel)
            return solver.net, lambda: solver.step(1)

        net, run = _warm(made, WHOLE)
        for part in training_parts(net):
            other, without = _warm(made, part)
            measured = _compared(run, without, limits)
            other.close()
            yield {"what": "training", "net": name, "batch": batch, "kind": part.kind, "part": part.name, **measured}
        net.close()


def forward_parts(net: Any) -> list[Part]:
    """Return the parts that a net may use when it runs without gradients."""
    from netspec.fast import prepared, table

    def without_layouts() -> AbstractContextManager[object]:
        entry_of = table.entry_of
        return patch.object(prepared, "entry_of", lambda layer: replace(entry_of(layer), any_layout=False))

    parts = [Part(ALL, "pass", options={"passes": ()})]
    parts += [Part(each, "pass", options={"passes": [other for other in PASSES if other != each]}) for each in PASSES]
    parts.append(Part("any layout", "pass", without_layouts))
    return parts + _kernels(net, "inference")


def training_parts(net: Any) -> list[Part]:
    """Return the parts that a net may use when it trains."""
    from netspec.fast import speed

    unread = patch.object(speed.Fast, "reads_at_once", lambda *_: lambda records: None)
    parts = [Part("records at once", "function", lambda: unread)]
    if net.trainer():
        none = patch.object(speed.Fast, "trainer", lambda *_: "it is not wanted")
        parts += [Part(ALL, "pass", lambda: none), *_kernels(net, "learning")]
    return parts


def _kernels(net: Any, which: str) -> list[Part]:
    """Return the kernels for the layers of a net; ``which``: "inference" or "learning"."""
    from netspec.fast import table
    from netspec.fast.entry import Entry

    none = getattr(Entry, which)
    parts = {}
    for layer in net.layers:
        cls, entry = type(layer), table.entry_of(layer)
        if getattr(entry, which) is not none and cls in table.ENTRIES:
            missing = {cls: replace(entry, **{which: none})}
            parts[cls] = Part(layer.type, "kernel", lambda missing=missing: patch.dict(table.ENTRIES, missing))
    return list(parts.values())


def _text(name: str, batch: int, size: Sequence[int]) -> str:
    """Return the prototxt of a net for deployment; of P-net, with the size (height, width) of a whole image."""
    if name == "ssd300":
        return ssd300()
    message = parse_net_text(mtcnn(name), name)[0] if name in HEADS else deploy_of(name)
    for layer in with_batch(message, batch).layer:
        if layer.type == "Input" and size:
            layer.input_param.shape[0].dim[2:] = size
    return write_text(message)


def _warm(made: Callable[[Part], tuple[Any, Run]], part: Part) -> tuple[Any, Run]:
    """Return a net without a part, and a function that runs it, after some passes in which kernels are made."""
    with part.without():
        net, run = made(part)
        for _ in range(WARM_UPS):
            run()
    return net, run


def _compared(run: Run, without: Run, limits: Limits) -> dict[str, float]:
    """Return the CPU time of a pass in milliseconds, and the time without a part divided by it."""
    turns = max(1, int(TURN_S / _seconds(run, 1)))
    took, ratios, began = [], [], time.monotonic()
    for k in range(limits.pairs):
        if k >= FEWEST_PAIRS and time.monotonic() - began > limits.seconds:
            break
        pair = [(which, _seconds(which, turns)) for which in ((run, without) if k % 2 else (without, run))]
        seconds = dict(pair)
        took.append(seconds[run])
        ratios.append(seconds[without] / seconds[run])
    return {"CPU ms": 1e3 * statistics.median(took), "without / with": round(statistics.median(ratios), 2)}


def _seconds(run: Run, turns: int) -> float:
    """Return the CPU seconds of a pass."""
    began = time.process_time()
    for _ in range(turns):
        run()
    return (time.process_time() - began) / turns
