"""Random nets in training: autograd, prepared kernels and pycaffe compute the same losses and gradients.

    NETSPEC_RANDOM_NETS=SEED:COUNT python -m pytest tests/laws/test_random_nets.py

uses other nets. A net that fails is printed with its seed.
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec.pycaffe as caffe
from drawn_nets import drawn
from netspec.errors import SpecError
from netspec.load import load_net

SEED, COUNT = map(int, os.environ.get("NETSPEC_RANDOM_NETS", "36:120").split(":"))


def _found(loss: float, blobs: Sequence[torch.Tensor], learned: Sequence[bool]) -> list[np.ndarray]:
    """Return a loss, the gradients of what learns, and the blobs: BatchNorm adds to its own."""
    learning = [blob for blob, is_one in zip(blobs, learned, strict=True) if is_one]
    gradients = [torch.zeros_like(blob) if blob.grad is None else blob.grad for blob in learning]
    return [np.array(loss), *(values.detach().numpy().copy() for values in (*gradients, *blobs))]


def _native(path: str, exact: str, prepared: bool) -> list[np.ndarray]:
    """Return the results of netspec's second pass, by prepared kernels or by autograd."""
    net = load_net(path, phase="TRAIN", seed=SEED, exact=exact)
    blobs = [blob for layer in net.layers for blob in layer.blobs]
    for _ in range(2):
        net.zero_grad()
        found = net.forward_backward() if prepared else None
        if found is None:
            found = net.forward_loss()
            found[0].backward()
    return _found(found[0].item(), blobs, [b.requires_grad for b in blobs])


def _pycaffe(path: str) -> list[np.ndarray]:
    """Return the results of pycaffe's second pass, while views of every second blob exist."""
    caffe.set_random_seed(SEED)
    net = caffe.Net(path, caffe.TRAIN)
    views = [blob.data for blob in list(net.blobs.values())[::2]]
    for _ in range(2):
        net.clear_param_diffs()
        net.forward()
        net.backward()
    del views
    blobs = [blob for layer in net.runner.net.layers for blob in layer.blobs]
    return _found(0, blobs, [b.requires_grad for b in blobs])


def _differs(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> str:
    """Return where two results differ by more than rounding, "" if nowhere."""
    largest = max(float(np.abs(values).max(initial=0)) for values in one)
    for i, (a, b) in enumerate(zip(one, other, strict=True)):
        if not np.allclose(a, b, rtol=2e-3, atol=2e-4 * max(1, float(np.abs(a).max(initial=0)), 1e-2 * largest)):
            return f"result {i} of {len(one)}, shape {a.shape}: off by {np.abs(a - b).max()}"
    return ""


def _faults(seed: int) -> Iterator[str]:
    text = drawn(seed)
    path = "random.prototxt"
    with open(path, "w") as file:
        file.write(text)
    try:
        first = _native(path, "none", prepared=False)
    except SpecError as refused:  # a filter larger than its map
        yield f"refused: {refused}"
        return
    if not all(np.abs(values).max(initial=0) < 1e6 for values in first):
        yield "refused: a pooling window beyond its map, NaN in Caffe too"
        return
    ways = {
        "prepared": lambda: _native(path, "none", prepared=True),
        "exact": lambda: _native(path, "all", prepared=False),
        "exact, prepared": lambda: _native(path, "all", prepared=True),
        "pycaffe": lambda: [first[0], *_pycaffe(path)[1:]],  # scripts add up the losses themselves
    }
    for way, run in ways.items():
        try:
            second = run()
        except Exception as fault:
            yield f"seed {seed}: {way}: {type(fault).__name__}: {fault}\n{text}"
            continue
        reported = _differs(first, second)
        if reported:
            yield f"seed {seed}: {way} differs from autograd: {reported}\n{text}"


@pytest.mark.slow
def test_losses_and_gradients_of_random_nets_agree_in_all_runners(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = [reported for seed in range(SEED, SEED + COUNT) for reported in _faults(seed)]
    faults = [reported for reported in found if not reported.startswith("refused")]
    assert not faults, "\n".join([f"{len(faults)} faults", *faults[:3]])
    assert len(found) < COUNT / 3, found[:3]
