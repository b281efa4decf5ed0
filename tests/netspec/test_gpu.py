"""Nets and solvers on a GPU: on a fake GPU, which shows what is on the wrong device; trainings on a real one too."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from fake_gpu import GPUS, NAME, POSSIBLE, FakeTensor, fake_gpu, gpu
from golden_cases import train
from netspec.inspect.features.describer import Describer
from netspec.load import load_solver
from paths import GOLDEN

needs_fake = pytest.mark.skipif(not POSSIBLE, reason="this torch cannot make a fake device")
QUICK = ("adadelta", "adam", "nesterov", "residual_bn_shared", "sgd_clip", "sgd_iter_size")
TRAININGS = [
    pytest.param(folder.name, marks=() if folder.name in QUICK else pytest.mark.slow)
    for folder in sorted((GOLDEN / "train").iterdir())
]


@pytest.fixture
def _gpu() -> Iterator[None]:
    with fake_gpu():
        yield


@pytest.fixture(params=GPUS)
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    with gpu(request.param) as found:
        yield found


@pytest.mark.slow
@needs_fake
@pytest.mark.usefixtures("_gpu")
def test_a_fake_gpu_refuses_what_a_gpu_refuses() -> None:
    x = torch.ones(2, 3, device=NAME)
    assert x.device == torch.device(NAME, 0)
    assert isinstance(x, FakeTensor)
    for wrong in (lambda: x + torch.ones(3), lambda: x @ torch.ones(3, 2), lambda: torch.cat([x, torch.ones(2, 3)])):
        with pytest.raises(RuntimeError, match="expected all tensors on one device"):
            wrong()
    for wrong in (x.numpy, lambda: np.float32(x.sum())):
        with pytest.raises(TypeError, match="to numpy"):
            wrong()
    assert (x + 1).sum().item() == 12
    assert (x + torch.tensor(2.0)).cpu().numpy().sum() == 18


@pytest.mark.slow
@pytest.mark.parametrize("case", TRAININGS)
def test_training_testing_snapshots_and_resuming(
    case: str, device: str, work_in: Callable[..., Path], record_property: Callable[[str, object], None]
) -> None:
    work_in(f"train/{case}")
    solver = load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel", device=device)
    golden = np.load(f"{case}/trajectory.npz")["loss"]
    found = train(solver, 8)
    record_property("losses off by", float(np.abs(found / golden[:8] - 1).max()))
    np.testing.assert_allclose(found, golden[:8], rtol=1e-3)
    assert {item.parameter.device.type for item in solver.net.learnable} == {torch.device(device).type}
    solver.test_all()
    _, state = solver.snapshot()
    weights = [item.parameter.detach().cpu() for item in solver.net.learnable]
    solver.step(2)
    solver.restore(state)
    assert solver.iteration == 8
    for item, before in zip(solver.net.learnable, weights, strict=True):
        torch.testing.assert_close(item.parameter.detach().cpu(), before, rtol=0, atol=0)
    solver.step(1)
    solver.close()


@pytest.mark.slow
@needs_fake
@pytest.mark.usefixtures("_gpu")
def test_two_devices_learn_what_one_does_from_batches_of_twice_the_size(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    weights = []
    for devices, batch in ((["cpu"], 32), ([NAME, "cpu"], 16)):
        text = Path("sgd_step/train_val.prototxt").read_text()
        Path("edited.prototxt").write_text(text.replace("batch_size: 32", f"batch_size: {batch}"))
        settings = Path("sgd_step/solver.prototxt").read_text().replace("sgd_step/train_val", "edited")
        Path("edited_solver.prototxt").write_text(settings)
        solver = load_solver("edited_solver.prototxt", weights="sgd_step/init.caffemodel", device=devices)
        solver.step(5)
        weights.append([item.parameter.detach().cpu() for item in solver.net.learnable])
        solver.close()
    for one, two in zip(*weights, strict=True):
        torch.testing.assert_close(two, one, rtol=1e-4, atol=1e-6)


@needs_fake
@pytest.mark.usefixtures("_gpu")
def test_describer(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    net = ("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel")
    found, expected = (Describer(*net, device=device)(image) for device in (NAME, "cpu"))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
