"""Training on several devices: each takes its share of the records, and together they are one larger batch."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec.load import load_solver
from netspec.net.net import Net
from netspec.solver.checks import dependence
from paths import GOLDEN

CPU = torch.device("cpu")


@pytest.mark.slow
def test_several_devices_train_like_one_with_the_whole_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rounding: float
) -> None:
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    (tmp_path / "sgd_step").mkdir()
    monkeypatch.chdir(tmp_path)
    weights = GOLDEN / "train" / "sgd_step" / "init.caffemodel"
    for name in ("solver.prototxt", "train_val.prototxt"):
        text = (GOLDEN / "train" / "sgd_step" / name).read_text()
        Path("sgd_step", name).write_text(text)
    alone = load_solver("sgd_step/solver.prototxt", weights, device="cpu")
    text = Path("sgd_step/train_val.prototxt").read_text()
    Path("sgd_step/train_val.prototxt").write_text(text.replace("batch_size: 32", "batch_size: 8"))
    together = load_solver("sgd_step/solver.prototxt", weights, device=[CPU] * 4)
    for solver in (alone, together):
        solver.step(5)
        solver.step(5)
        solver.close()
    for name, blobs in alone.net.params.items():
        for mine, theirs in zip(blobs, together.net.params[name], strict=True):
            scale = mine.detach().abs().max().item()
            assert np.allclose(mine.detach(), theirs.detach(), rtol=0, atol=1e-3 * scale + rounding)


# A training whose last bits depend on the number of threads says so, once, and offers the remedy
NET = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 1024 } } }
layer { name: "small" type: "InnerProduct" bottom: "data" top: "small" inner_product_param { num_output: 10 } }
layer { name: "large" type: "InnerProduct" bottom: "data" top: "large" inner_product_param { num_output: 1000 } }
layer { name: "relu" type: "ReLU" bottom: "large" top: "relu" }
"""


@pytest.mark.parametrize(
    ("exact", "threads", "said"),
    [
        ("small", 2, "2 threads share the sums of large; "),
        ("none", 4, "4 threads share the sums of small and 1 more; "),
        ("small", 1, ""),
        ("all", 2, ""),
    ],
)
def test_threads_that_change_results_are_reported(
    net_of: Callable[..., Net], exact: str, threads: int, said: str
) -> None:
    found = dependence(net_of(NET, exact=exact), threads)
    assert found.startswith(said)
    assert bool(found) == bool(said)
    assert ("--exact all" in found and "OMP_NUM_THREADS=1" in found) == bool(said)
