"""Trainings by prepared kernels go as those by autograd, to the last bit."""

from pathlib import Path

import pytest
import torch

from netspec.run.training import TrainingStep
from netspec.solver.solver import Solver, load_solver

DATA = """
layer { name: "d" type: "DummyData" top: "x" top: "label" dummy_data_param {
  shape { dim: 6 dim: 3 dim: 10 dim: 10 } shape { dim: 6 }
  data_filler { type: "gaussian" } data_filler { type: "constant" value: 1 } } }
"""
FILLED = 'weight_filler { type: "xavier" } bias_filler { type: "uniform" }'
TYPICAL = f"""{DATA}
layer {{ name: "c" type: "Convolution" bottom: "x" top: "c" param {{ lr_mult: 1 }} param {{ lr_mult: 2 decay_mult: 0 }}
  convolution_param {{ num_output: 5 kernel_size: 3 pad: 1 {FILLED} }} }}
layer {{ name: "p" type: "Pooling" bottom: "c" top: "p" pooling_param {{ kernel_size: 3 stride: 2 }} }}
layer {{ name: "r" type: "ReLU" bottom: "p" top: "p" }}
layer {{ name: "q" type: "Pooling" bottom: "p" top: "q" pooling_param {{ kernel_size: 2 stride: 2 pool: AVE }} }}
layer {{ name: "n" type: "LRN" bottom: "q" top: "n" lrn_param {{ local_size: 3 }} }}
layer {{ name: "f" type: "InnerProduct" bottom: "n" top: "f" inner_product_param {{ num_output: 12 {FILLED} }} }}
layer {{ name: "fr" type: "ReLU" bottom: "f" top: "f" }}
layer {{ name: "fd" type: "Dropout" bottom: "f" top: "f" }}
layer {{ name: "g" type: "InnerProduct" bottom: "f" top: "g" inner_product_param {{ num_output: 4 {FILLED} }} }}
layer {{ name: "a" type: "Accuracy" bottom: "g" bottom: "label" top: "a" }}
layer {{ name: "l" type: "SoftmaxWithLoss" bottom: "g" bottom: "label" top: "l" loss_weight: 0.5 }}
"""
SHARED = f"""{DATA}
layer {{ name: "s" type: "Slice" bottom: "x" top: "x0" top: "x1" top: "x2" }}
layer {{ name: "f0" type: "InnerProduct" bottom: "x0" top: "f0" param {{ name: "w" }} param {{ name: "b" }}
  inner_product_param {{ num_output: 6 {FILLED} }} }}
layer {{ name: "f1" type: "InnerProduct" bottom: "x1" top: "f1" param {{ name: "w" }} param {{ name: "b" }}
  inner_product_param {{ num_output: 6 {FILLED} }} }}
layer {{ name: "t0" type: "TanH" bottom: "f0" top: "t0" }}
layer {{ name: "t1" type: "Sigmoid" bottom: "f1" top: "t1" }}
layer {{ name: "c" type: "Concat" bottom: "t0" bottom: "t1" top: "c" }}
layer {{ name: "e" type: "Eltwise" bottom: "t0" bottom: "t1" top: "e" }}
layer {{ name: "l" type: "ContrastiveLoss" bottom: "t0" bottom: "t1" bottom: "label" top: "l" }}
layer {{ name: "m" type: "EuclideanLoss" bottom: "e" bottom: "t0" loss_weight: 3 }}
layer {{ name: "z" type: "Silence" bottom: "c" }}
layer {{ name: "y" type: "Silence" bottom: "x2" }}
"""
OVERWRITTEN = f"""{DATA}
layer {{ name: "f" type: "InnerProduct" bottom: "x" top: "f" inner_product_param {{ num_output: 6 {FILLED} }} }}
layer {{ name: "r" type: "ReLU" bottom: "f" top: "f" }}
layer {{ name: "s" type: "Sigmoid" bottom: "f" top: "f" }}
layer {{ name: "t" type: "TanH" bottom: "f" top: "t" }}
layer {{ name: "u" type: "ReLU" bottom: "t" top: "t" relu_param {{ negative_slope: 0.1 }} }}
layer {{ name: "w" type: "Power" bottom: "t" top: "t" power_param {{ power: 2 shift: 1 }} }}
layer {{ name: "g" type: "InnerProduct" bottom: "t" top: "g" param {{ lr_mult: 0 }} param {{ lr_mult: 1 }}
  inner_product_param {{ num_output: 4 {FILLED} }} }}
layer {{ name: "l" type: "SoftmaxWithLoss" bottom: "g" bottom: "label" top: "l" top: "p" }}
"""
TOWER = """
layer {{ name: "c{i}" type: "Convolution" bottom: "x{i}" top: "c{i}" param {{ name: "w" }}
  convolution_param {{ num_output: 24 kernel_size: 3 pad: 1 bias_term: false weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "n{i}" type: "BatchNorm" bottom: "c{i}" top: "c{i}" param {{ name: "n0" lr_mult: 0 }}
  param {{ name: "n1" lr_mult: 0 }} param {{ name: "n2" lr_mult: 0 }} }}
layer {{ name: "s{i}" type: "Scale" bottom: "c{i}" top: "c{i}" param {{ name: "s0" }} param {{ name: "s1" }}
  scale_param {{ bias_term: true }} }}
layer {{ name: "r{i}" type: "ReLU" bottom: "c{i}" top: "c{i}" }}
layer {{ name: "d{i}" type: "Convolution" bottom: "c{i}" top: "d{i}" param {{ name: "v" }}
  convolution_param {{ num_output: 24 kernel_size: 3 pad: 1 bias_term: false weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "m{i}" type: "BatchNorm" bottom: "d{i}" top: "m{i}" }}
layer {{ name: "e{i}" type: "Eltwise" bottom: "c{i}" bottom: "m{i}" top: "e{i}" }}
layer {{ name: "o{i}" type: "BatchNorm" bottom: "e{i}" top: "e{i}" }}
layer {{ name: "q{i}" type: "ReLU" bottom: "e{i}" top: "e{i}" }}
layer {{ name: "p{i}" type: "Pooling" bottom: "e{i}" top: "p{i}" pooling_param {{ kernel_size: 5 stride: 5 }} }}
layer {{ name: "u{i}" type: "BatchNorm" bottom: "p{i}" top: "p{i}" }}
layer {{ name: "t{i}" type: "Scale" bottom: "p{i}" top: "p{i}" param {{ name: "t0" }} }}
layer {{ name: "f{i}" type: "InnerProduct" bottom: "p{i}" top: "f{i}" param {{ name: "f" }}
  inner_product_param {{ num_output: 5 bias_term: false weight_filler {{ type: "xavier" }} }} }}
"""
RESIDUAL = f"""{DATA.replace("dim: 6 dim: 3", "dim: 6 dim: 6")}
layer {{ name: "s" type: "Slice" bottom: "x" top: "x0" top: "x1" }}
{TOWER.format(i=0)}{TOWER.format(i=1)}
layer {{ name: "l" type: "ContrastiveLoss" bottom: "f0" bottom: "f1" bottom: "label" top: "l" }}
"""
SINGLE = RESIDUAL.replace("dim: 6 dim: 6", "dim: 1 dim: 6").replace("shape { dim: 6 }", "shape { dim: 1 }")
FAR = TYPICAL.replace(
    'layer { name: "c"',
    """layer { name: "far" type: "Power" bottom: "x" top: "far" power_param { shift: 100 } }
layer { name: "b" type: "BatchNorm" bottom: "far" top: "b" }
layer { name: "bs" type: "Scale" bottom: "b" top: "b" }
layer { name: "c\"""",
).replace('bottom: "x" top: "c"', 'bottom: "b" top: "c"')
NETS = {
    "typical": TYPICAL,
    "shared": SHARED,
    "overwritten": OVERWRITTEN,
    "residual": RESIDUAL,
    "single image": SINGLE,
    "far": FAR,
}


def made(folder: Path, net: str, exact: str = "small", more: str = "") -> Solver:
    (folder / "net.prototxt").write_text(net)
    (folder / "solver.prototxt").write_text(
        f'net: "{folder}/net.prototxt" base_lr: 0.05 lr_policy: "fixed" max_iter: 9 weight_decay: 0.01 '
        f"random_seed: 3 solver_mode: CPU snapshot_after_train: false {more}"
    )
    return load_solver(folder / "solver.prototxt", exact=exact)


def is_prepared(solver: Solver) -> bool:
    return isinstance(solver.net._training, TrainingStep)


@pytest.mark.slow
@pytest.mark.parametrize("more", ["momentum: 0.9", 'type: "Adam" iter_size: 2', 'type: "AdaGrad" clip_gradients: 0.1'])
@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("net", NETS)
def test_trains_as_autograd_does(tmp_path: Path, net: str, exact: str, more: str) -> None:
    results = []
    for prepares in (False, True):
        solver = made(tmp_path, NETS[net], exact, more)
        if not prepares:
            solver.net._training = "as by autograd"
        losses = []
        solver.on_iteration = lambda losses=losses, solver=solver: losses.append(solver.loss)
        solver.step(4)
        outputs = {name: values.clone() for name, values in solver.net.blobs.items()}
        assert is_prepared(solver) == prepares
        weights = [item.parameter.detach().clone() for item in solver.net.learnable]
        gradients = [item.parameter.grad for item in solver.net.learnable]
        results.append((losses, outputs, weights, gradients, [each.clone() for each in solver.history]))
    (losses, *expected), (found_losses, *found) = results
    if net in ("residual", "single image") and exact != "all" and "iter_size" in more:
        # Of a Scale whose blobs are shared, autograd adds the towers' gradients first, kernels one by one, as Caffe.
        assert found_losses == pytest.approx(losses, rel=1e-5)
        return
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


def test_who_looks_at_a_pass_sees_autograds(tmp_path: Path) -> None:
    """Hooks, blobs to keep, and debug_info; afterward the kernels go on."""
    plain, watched = made(tmp_path, TYPICAL), made(tmp_path, TYPICAL)
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


def test_follows_what_is_done_to_the_weights(tmp_path: Path) -> None:
    """Values that are written, memory that is replaced, gradients that are dropped, blobs that are frozen."""
    results = []
    for prepares in (False, True):
        solver = made(tmp_path, TYPICAL, more="momentum: 0.9")
        if not prepares:
            solver.net._training = "as by autograd"
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


def test_says_why_it_is_not_prepared(tmp_path: Path) -> None:
    rows = "".join(
        f'layer {{ name: "b{i}" type: "PReLU" bottom: "x" top: "x" param {{ name: "w" }} }}\n' for i in (0, 1)
    )
    solver = made(tmp_path, TYPICAL.replace('layer { name: "c"', f'{rows}layer {{ name: "c"'))
    solver.step(1)
    assert solver.net._training == '"b0" shares parameters, and only autograd adds up their gradients'
