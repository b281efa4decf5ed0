"""Trainings in other numbers than float32: what stays float32, and how far their losses are from Caffe's."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from golden_cases import train
from netspec.errors import SpecError
from netspec.load import load_solver
from netspec.solver import training
from netspec.solver.precision import BF16, FIRST_SCALE, FP16, FP32, PATIENCE, TF32, LossScale, computing


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
@pytest.mark.parametrize(("precision", "share"), [(BF16, 0.1), (FP16, 0.02)])
@pytest.mark.parametrize("case", ["adam", "residual_bn_shared"])
def test_a_training_in_half_precision_approximates_caffe(
    case: str, precision: str, share: float, work_in: Callable[..., Path]
) -> None:
    """The losses of the first 20 iterations, to a share of the largest; a training in float32 is nearer."""
    work_in(f"train/{case}")
    found, golden = losses(case, precision=precision)
    assert np.abs(found - golden).max() < share * golden.max()
    exact, _ = losses(case)
    assert np.abs(exact - golden).max() < np.abs(found - golden).max()


@pytest.mark.slow
def test_tf32_is_for_gpus(work_in: Callable[..., Path]) -> None:
    """On a CPU it is float32, with sums in torch's order."""
    work_in("train/sgd_step")
    np.testing.assert_array_equal(losses("sgd_step", precision=TF32)[0], losses("sgd_step", exact="none")[0])


@pytest.mark.parametrize("precision", [FP32, TF32, BF16, FP16])
def test_float32_on_gpus_does_not_use_tf32(precision: str) -> None:
    libraries = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [library.allow_tf32 for library in libraries]
    with computing(precision, torch.device("cpu")):
        assert [library.allow_tf32 for library in libraries] == [precision == TF32] * 2
    assert [library.allow_tf32 for library in libraries] == before


FP16_OVERFLOWS = """
layer { name: "d" type: "DummyData" top: "x" top: "y"
  dummy_data_param { shape { dim: 64 dim: 64 } data_filler { value: 1 } data_filler { value: 1000 } } }
layer { name: "ip" type: "InnerProduct" bottom: "x" top: "ip"
  inner_product_param { num_output: 64 weight_filler { type: "constant" value: 0.1 } } }
layer { name: "loss" type: "EuclideanLoss" bottom: "ip" bottom: "y" top: "loss" }
"""


@pytest.mark.parametrize("precision", [FP32, BF16, FP16])
def test_a_training_resumes_with_its_loss_scale(
    precision: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each overflow of the first iterations halves the scale; without it, they would overflow again."""
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(FP16_OVERFLOWS)
    Path("solver.prototxt").write_text('net: "net.prototxt" base_lr: 0.001 lr_policy: "fixed" max_iter: 16')
    whole = load_solver("solver.prototxt", precision=precision)
    whole.step(8)
    _, state = whole.snapshot()
    at_8 = whole.scale.state
    whole.step(8)
    resumed = load_solver("solver.prototxt", precision=precision, snapshot=state)
    assert resumed.scale.state == at_8
    resumed.step(8)
    assert resumed.scale.state == whole.scale.state
    for mine, theirs in zip(resumed.net.learnable, whole.net.learnable, strict=True):
        assert torch.equal(mine.parameter, theirs.parameter)
    if precision == FP16:
        assert whole.scale.factor < FIRST_SCALE
        whole.restore(state)
        assert whole.scale.state == at_8
        Path(f"{state}.extra").unlink()  # as of Caffe
        whole.restore(state)
        assert whole.scale.state == [FIRST_SCALE, 0]


@pytest.mark.parametrize(("precision", "has_it", "said"), [(BF16, False, 1), (BF16, True, 0), (FP32, False, 0)])
def test_a_cpu_without_bf16_is_reported(
    precision: str,
    has_it: bool,
    said: int,
    work_in: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    work_in("train/sgd_step")
    monkeypatch.setattr(training, "has_bfloat16", lambda: has_it)
    load_solver("sgd_step/solver.prototxt", precision=precision).close()
    assert caplog.text.count("precision bf16: this CPU has no instructions for it, so it is slower than fp32") == said


def test_the_loss_scale_is_halved_after_an_overflow_and_later_doubled() -> None:
    scale = LossScale(FP16)
    assert float(scale.of(torch.tensor(3.0))) == 3 * FIRST_SCALE
    gradients = [torch.tensor([1.0, -2.0]), torch.tensor(4.0)]
    assert scale.remove([gradient * FIRST_SCALE for gradient in gradients])
    for wrong in (torch.inf, -torch.inf, torch.nan):
        assert not scale.remove([*gradients, torch.tensor([0.0, wrong])])
    assert scale.factor == FIRST_SCALE / 8
    scaled = [gradient * scale.factor for gradient in gradients]
    for k in range(PATIENCE):
        assert scale.factor == FIRST_SCALE / 8, k
        assert scale.remove(scaled if k == 0 else [torch.ones(())])
    assert scale.factor == FIRST_SCALE / 4
    assert all(torch.equal(found, gradient) for found, gradient in zip(scaled, gradients, strict=True))


def test_an_overflow_is_counted_as_an_iteration_without_update(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel", precision=FP16)
    before = [item.parameter.detach().clone() for item in solver.net.learnable]
    solver.scale.factor = 2.0**120
    solver.step(1)
    assert solver.iteration == 1
    assert solver.scale.factor == 2.0**119
    for item, values in zip(solver.net.learnable, before, strict=True):
        assert torch.equal(item.parameter, values)
    solver.scale.factor = FIRST_SCALE
    solver.step(1)
    assert any(not torch.equal(i.parameter, values) for i, values in zip(solver.net.learnable, before, strict=True))
    solver.close()


def test_gradients_that_always_overflow_end_the_training(
    work_in: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt", weights="sgd_step/init.caffemodel", precision=FP16)
    solver.scale.factor = 1.0
    remove = solver.scale.remove
    monkeypatch.setattr(solver.scale, "remove", lambda gradients: remove([torch.tensor([torch.inf])]))
    with pytest.raises(SpecError, match="the gradients overflow float16"):
        solver.step(1)
    solver.close()
