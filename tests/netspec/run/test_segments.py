"""Layers that torch.compile makes one function of: the same numbers, and what runs layer by layer all the same."""

import gc
import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from golden_cases import train
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN
from netspec.run.segments import missing_tool
from netspec.solver.solver import Solver, load_solver

NET = """
    layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 4 dim: 3 dim: 11 dim: 11 } } }
    layer { name: "conv" type: "Convolution" bottom: "x" top: "c" param { name: "w" }
            convolution_param { num_output: 4 kernel_size: 3 bias_term: false weight_filler { type: "gaussian" } } }
    layer { name: "bn" type: "BatchNorm" bottom: "c" top: "c" }
    layer { name: "scale" type: "Scale" bottom: "c" top: "c" scale_param { bias_term: true } }
    layer { name: "relu" type: "ReLU" bottom: "c" top: "c" }
    layer { name: "max" type: "Pooling" bottom: "c" top: "m" pooling_param { kernel_size: 2 stride: 2 } }
    layer { name: "far" type: "Power" bottom: "x" top: "f" power_param { shift: 100 } }
    layer { name: "ave" type: "Pooling" bottom: "f" top: "a" pooling_param { pool: AVE kernel_size: 4 stride: 2 } }
    layer { name: "far_bn" type: "BatchNorm" bottom: "a" top: "a" }
    layer { name: "ip" type: "InnerProduct" bottom: "m" top: "i"
            inner_product_param { num_output: 3 weight_filler { type: "gaussian" std: 0.1 } } }
    layer { name: "conv_p" type: "Convolution" bottom: "a" top: "c_p" param { name: "w" }
            convolution_param { num_output: 4 kernel_size: 3 bias_term: false } }
    layer { name: "abs" type: "AbsVal" bottom: "c_p" top: "d" }
    layer { name: "sum_d" type: "Reduction" bottom: "d" top: "loss_d" loss_weight: 0.1 }
    layer { name: "sum_i" type: "Reduction" bottom: "i" top: "loss_i" reduction_param { operation: SUMSQ }
            loss_weight: 1 }"""
POOLED = """
    layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 dim: 7 dim: 7 } } }
    layer { name: "ave" type: "Pooling" bottom: "x" top: "a"
            pooling_param { pool: AVE kernel_size: 4 stride: 2 pad: 1 } }
    layer { name: "max" type: "Pooling" bottom: "x" top: "m" pooling_param { kernel_size: 2 stride: 2 } }"""
TRAINED: dict[str, Any] = {"phase": TRAIN, "exact": "none", "accumulate_in_place": True}


@pytest.fixture(params=["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Compile by this backend: "aot_eager" traces as "inductor" does, and needs no C++ compiler."""
    if request.param == "inductor" and (lack := missing_tool(torch.device("cpu"))):
        pytest.skip(lack)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=request.param))
    return request.param


@pytest.fixture
def traced_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))


def segments(net: Net) -> list[str]:
    """Return the segments, as "first-last"; those that were run have a "!"."""
    names = [node.name for node in net.plan.nodes]
    return [f"{names[i]}-{names[one.last]}{'!' * bool(one.compiled)}" for i, one in net.eager.segments.items()]


def random(*shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


def passed(net: Net, data: torch.Tensor) -> list[torch.Tensor]:
    """Run twice, as statistics and gradients add up; return losses, learnable blobs and gradients."""
    losses = []
    for _ in range(2):
        loss, _ = net.forward_loss(x=data)
        loss.backward()
        losses.append(loss.detach())
    gradients = [item.parameter.grad for item in net.learnable if item.parameter.grad is not None]
    return [*losses, *(item.parameter.detach() for item in net.learnable), *gradients]


def assert_same(found: Sequence[torch.Tensor], expected: Sequence[torch.Tensor]) -> None:
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-3 * float(theirs.nan_to_num().abs().max()))


@pytest.mark.slow
def test_losses_statistics_and_gradients_stay(backend: str, net_of: Callable[..., Net]) -> None:
    """With shared filters, a pooling beyond the rim, and values far from 0."""
    compiled, plain = net_of(NET, compiled=True, **TRAINED), net_of(NET, **TRAINED)
    assert_same(passed(compiled, random(4, 3, 11, 11)), passed(plain, random(4, 3, 11, 11)))
    assert segments(compiled) == ["x_in_0_split-far_bn!", "conv_p-abs!"]


@pytest.mark.slow
def test_poolings_treat_nan_and_the_rim_as_caffe_does(backend: str, net_of: Callable[..., Net]) -> None:
    data = random(1, 3, 7, 7)
    data[0, 0, 0, 0], data[0, 0, 2:4, 2:4], data[0, 1, 6, 6] = torch.nan, torch.nan, -torch.inf
    found = []
    for compiled in (True, False):
        net, given = net_of(POOLED, compiled=compiled, **TRAINED), data.clone().requires_grad_()
        tops = net(x=given)
        (tops["m"].sum() + tops["a"].nan_to_num(neginf=0).sum()).backward()
        found.append([*tops.values(), given.grad])
        assert segments(net) == ["x_in_0_split-max!"] * compiled
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, equal_nan=True)


@pytest.mark.slow
def test_torchs_logs_are_as_they_were(net_of: Callable[..., Net]) -> None:
    names = ("torch._dynamo", "torch._inductor", "torch")
    before = [logging.getLogger(name).level for name in names]
    net_of(NET, phase=TRAIN, compiled=True).forward_loss(x=random(4, 3, 11, 11))
    assert [logging.getLogger(name).level for name in names] == before


@pytest.mark.slow
@pytest.mark.usefixtures("traced_only")
def test_passes_that_are_not_repeated_run_layer_by_layer(net_of: Callable[..., Net]) -> None:
    net = net_of(NET, compiled=True, **TRAINED)
    not_run = ["x_in_0_split-far_bn", "conv_p-abs"]
    with torch.no_grad():
        net(x=random(4, 3, 11, 11))
    net.keep = "all"
    net(x=random(4, 3, 11, 11))
    assert net.blobs["f"].shape == (4, 3, 11, 11)
    assert segments(net) == not_run
    net.keep = ()
    hook = net.layers[2].register_forward_hook(lambda *_: None)
    net(x=random(4, 3, 11, 11))
    hook.remove()
    assert segments(net) == [not_run[0], "conv_p-abs!"]
    net(x=random(4, 3, 11, 11))
    assert segments(net) == ["x_in_0_split-far_bn!", "conv_p-abs!"]
    with torch.no_grad():
        net_of(NET, phase=TEST, exact="none", compiled=True, passes=())(x=random(4, 3, 11, 11))


@pytest.mark.slow
def test_each_segment_is_compiled_once(net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    keep = lambda graph, _: (made.append(graph), graph.forward)[1]  # noqa: E731
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=keep))
    net = net_of(NET, compiled=True, **TRAINED)
    for _ in range(3):
        net.forward_loss(x=random(4, 3, 11, 11))[0].backward()
        gc.collect()
    assert len(made) == len(net.eager.segments)


@pytest.mark.slow
@pytest.mark.usefixtures("traced_only")
def test_batches_of_other_shapes_run_layer_by_layer(net_of: Callable[..., Net]) -> None:
    compiled, plain = (net_of(POOLED, compiled=compiled, **TRAINED) for compiled in (True, False))
    for shape in ((1, 3, 7, 7), (2, 3, 9, 8), (1, 3, 7, 7)):
        assert_same(list(compiled(x=random(*shape)).values()), list(plain(x=random(*shape)).values()))


def test_layers_whose_gradient_reads_overwritten_memory_run_by_themselves(net_of: Callable[..., Net]) -> None:
    chain = [f'layer {{ name: "{k}" type: "{k}" bottom: "x" top: "x" }}' for k in ("AbsVal", "ReLU", "Sigmoid", "Exp")]
    net = net_of(POOLED.splitlines()[1] + "".join(chain), compiled=True, **TRAINED)
    assert segments(net) == []


def trained(case: str, **options: Any) -> Solver:
    return load_solver(f"{case}/solver.prototxt", weights=f"{case}/init.caffemodel", **options)


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "precision"), [("aot_eager", "fp32"), ("inductor", "bf16")], indirect=["backend"])
def test_a_training_with_tests_and_iter_size_stays(
    backend: str, precision: str, work_in: Callable[..., Path], edited_solver: Callable[[Path], None]
) -> None:
    edited_solver(work_in("train/sgd_iter_size"))
    found, expected = (
        trained("sgd_iter_size", exact="none", precision=precision, compiled=compiled) for compiled in (True, False)
    )
    share = 1e-5 if precision == "fp32" else 2e-2
    assert train(found, 4) == pytest.approx(train(expected, 4), rel=share)
    assert found.scores[0]["loss"] == pytest.approx(expected.scores[0]["loss"], rel=share)
    assert [segments(net) for net in (found.net, *found.test_nets)] == [["slice_pair-pool2!", "conv1_p-pool2_p!"]] * 2
    found.close()
    expected.close()


@pytest.fixture
def edited_solver() -> Callable[[Path], None]:
    """Make a training test itself after each second iteration."""

    def edit(folder: Path) -> None:
        path = folder / "solver.prototxt"
        path.write_text(path.read_text().replace("test_interval: 1000", "test_interval: 2"))

    return edit


@pytest.mark.slow
@pytest.mark.usefixtures("traced_only")
def test_a_resumed_training_goes_on_to_the_bit(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    whole, part = trained("sgd_step", compiled=True), trained("sgd_step", compiled=True)
    whole.step(4)
    part.step(2)
    part.snapshot()
    rest = load_solver("sgd_step/solver.prototxt", snapshot=part.last_snapshot, compiled=True)
    rest.step(2)
    for mine, theirs in zip(rest.net.learnable, whole.net.learnable, strict=True):
        assert torch.equal(mine.parameter, theirs.parameter)
    for solver in (whole, part, rest):
        solver.close()


def test_without_a_compiler_nothing_begins(run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "/nowhere/c++")
    told = run("train", "--solver", "sgd_step/solver.prototxt", "--compile")
    assert told.fault.endswith(
        '--compile: found no C++ compiler "/nowhere/c++"; install one, or name another in the environment variable CXX'
    )
    assert not list(Path("sgd_step").glob("*iter_1*"))


@pytest.mark.usefixtures("traced_only")
def test_what_cannot_be_compiled_is_told_in_one_line(run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("no such kernel\nand a long story")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: refuse)
    told = run("train", "--solver", "sgd_step/solver.prototxt", "--compile")
    expected = 'cannot be compiled, up to layer "pool2": no such kernel; train without --compile'
    assert told.fault.endswith(expected)
    assert "slice_pair" in told.fault
