"""Trainings in other numbers than float32: what stays float32, and how far their losses are from Caffe's."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from golden_cases import train
from netspec.solver.precision import BF16, FP32, TF32, computing
from netspec.solver.solver import load_solver


def losses(case: str, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the losses of the first iterations of a golden training, and Caffe's."""
    golden = np.load(f"{case}/trajectory.npz")["loss"][:20]
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel", **options)
    found = train(solver, len(golden))
    solver.close()
    assert {item.parameter.dtype for item in solver.net.learnable} == {torch.float32}
    assert {values.dtype for values in solver.history} == {torch.float32}
    assert {item.parameter.grad.dtype for item in solver.net.learnable if item.parameter.grad is not None} == {
        torch.float32
    }
    return np.array(found, np.float32), golden


@pytest.mark.slow
@pytest.mark.parametrize("case", ["sgd_step", "adam", "nesterov", "residual_bn_shared", "residual_bn_private"])
def test_in_bf16_a_training_follows_caffe_from_afar(case: str, work_in: Callable[..., Path]) -> None:
    """The losses of the first 20 iterations, to a tenth of the largest; a training in float32 is nearer."""
    work_in(f"train/{case}")
    found, golden = losses(case, precision=BF16)
    assert np.abs(found - golden).max() < 0.1 * golden.max()
    exact, _ = losses(case)
    assert np.abs(exact - golden).max() < np.abs(found - golden).max()


def test_tf32_is_for_gpus(work_in: Callable[..., Path]) -> None:
    """On a CPU it is float32, with sums in torch's order."""
    work_in("train/sgd_step")
    np.testing.assert_array_equal(losses("sgd_step", precision=TF32)[0], losses("sgd_step", exact="none")[0])


@pytest.mark.parametrize("precision", [FP32, TF32, BF16])
def test_float32_on_gpus_is_without_tf32(precision: str) -> None:
    libraries = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [library.allow_tf32 for library in libraries]
    with computing(precision, torch.device("cpu")):
        assert [library.allow_tf32 for library in libraries] == [precision == TF32] * 2
    assert [library.allow_tf32 for library in libraries] == before


def test_an_unknown_precision_is_refused(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    with pytest.raises(ValueError, match="found precision 'fp8', expected 'fp32', 'tf32', 'bf16'"):
        load_solver("sgd_step/solver.prototxt", precision="fp8")
