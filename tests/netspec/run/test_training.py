"""Trainings by prepared kernels go as those by autograd, to the last bit."""

from pathlib import Path

import pytest
import torch

from golden_cases import train
from netspec.fast.training import TrainingStep
from netspec.load import load_solver
from netspec.solver.solver import Solver

NETS = {path.stem: path.read_text() for path in sorted((Path(__file__).parent / "trainings").glob("*.prototxt"))}
NETS["single image"] = NETS["residual"].replace("dim: 6 dim: 6", "dim: 1 dim: 6").replace("{ dim: 6 }", "{ dim: 1 }")


def made(folder: Path, net: str, exact: str = "small", more: str = "") -> Solver:
    (folder / "net.prototxt").write_text(net)
    (folder / "solver.prototxt").write_text(
        f'net: "{folder}/net.prototxt" base_lr: 0.05 lr_policy: "fixed" max_iter: 9 weight_decay: 0.01 '
        f"random_seed: 3 solver_mode: CPU snapshot_after_train: false {more}"
    )
    return load_solver(folder / "solver.prototxt", exact=exact)


def is_prepared(solver: Solver) -> bool:
    return isinstance(solver.net._trainer, TrainingStep)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("exact", "more"),
    [("none", "momentum: 0.9"), ("all", 'type: "Adam" iter_size: 2'), ("small", 'type: "AdaGrad" clip_gradients: 0.1')],
)
@pytest.mark.parametrize("net", NETS)
def test_training_kernels_equal_autograd(tmp_path: Path, net: str, exact: str, more: str) -> None:
    results = []
    for prepares in (False, True):
        solver = made(tmp_path, NETS[net], exact, more)
        if not prepares:
            solver.net._trainer = "as by autograd"
        losses = train(solver, 4)
        outputs = {name: values.clone() for name, values in solver.net.blobs.items()}
        assert is_prepared(solver) == prepares
        weights = [item.parameter.detach().clone() for item in solver.net.learnable]
        gradients = [item.parameter.grad for item in solver.net.learnable]
        results.append((losses, outputs, weights, gradients, [each.clone() for each in solver.history]))
    (losses, *expected), (found_losses, *found) = results
    assert found_losses == losses
    for mine, theirs in zip(found, expected, strict=True):
        pairs = (
            zip(mine.values(), theirs.values(), strict=True)
            if isinstance(mine, dict)
            else zip(mine, theirs, strict=True)
        )
        for a, b in pairs:
            assert (a is None) == (b is None)
            assert a is None or torch.equal(a, b)


def test_hooks_get_the_values_of_autograd(tmp_path: Path) -> None:
    """Hooks, blobs to keep, and debug_info; afterward the kernels go on."""
    plain, watched = made(tmp_path, NETS["typical"]), made(tmp_path, NETS["typical"])
    seen = []
    plain.step(3)
    watched.step(1)
    layer = next(layer for layer in watched.net.layers if layer.type == "Convolution")
    hook = layer.register_forward_hook(lambda layer, bottoms, top: seen.append(top[0].requires_grad))
    watched.step(1)
    hook.remove()
    watched.net.keep = "all"
    watched.step(1)
    assert seen == [True]
    assert "c" in watched.net.blobs
    assert watched.loss == plain.loss
    for mine, theirs in zip(watched.net.learnable, plain.net.learnable, strict=True):
        assert torch.equal(mine.parameter, theirs.parameter)


def test_changes_of_the_weights_are_noticed(tmp_path: Path) -> None:
    """Values that are written, memory that is replaced, gradients that are dropped, blobs that are frozen."""
    results = []
    for prepares in (False, True):
        solver = made(tmp_path, NETS["typical"], more="momentum: 0.9")
        if not prepares:
            solver.net._trainer = "as by autograd"
        convolution, inner, *_ = (layer for layer in solver.net.layers if len(layer.blobs))
        solver.step(2)
        with torch.no_grad():
            convolution.blobs[0].mul_(0.5)
        solver.step(1)
        inner.blobs[0].data = inner.blobs[0].data * 2
        solver.step(1)
        solver.net.zero_grad()
        solver.step(1)
        inner.blobs[1].requires_grad_(False)
        solver.step(1)
        results.append([item.parameter.detach().clone() for item in solver.net.learnable])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_the_reason_for_not_being_prepared_is_given(tmp_path: Path) -> None:
    rows = "".join(
        f'layer {{ name: "b{i}" type: "Bias" bottom: "x" top: "x" param {{ name: "w" }} }}\n' for i in (0, 1)
    )
    solver = made(tmp_path, NETS["typical"].replace('layer { name: "c"', f'{rows}layer {{ name: "c"'))
    solver.step(1)
    assert solver.net._trainer == '"b0" shares parameters, and only autograd adds up their gradients'
