"""The towers of a siamese net run together in a training under autocast, with the results of separate towers."""

from pathlib import Path
from typing import Any

import pytest
import torch

from netspec.exact.by_torch import NormalizedBatches
from netspec.net.net import Net
from netspec.run.eager import Eager

NET = (Path(__file__).parent / "nets" / "towers.prototxt").read_text()


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Join towers in float32 too, where the results can be compared closely."""
    monkeypatch.setattr(Eager, "_joins_towers", lambda _: True)
    return monkeypatch


def inputs() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {"pairs": torch.randn(3, 6, 12, 12, generator=generator), "sim": torch.tensor([1.0, 0.0, 1.0])}


def trained(net: Net) -> list[torch.Tensor]:
    """Run forward and backward twice, as statistics add up; return the loss, the learnable blobs and the gradients."""
    loss = torch.zeros(())
    for _ in range(2):
        loss, _ = net.forward_loss(**inputs())
        loss.backward()
    gradients = [item.parameter.grad for item in net.learnable if item.parameter.grad is not None]
    return [loss.detach(), *(item.parameter.detach() for item in net.learnable), *gradients]


def batches(net: Net) -> list[int]:
    """Return the sizes of the batches that the convolutions, of both towers, get in one pass."""
    sizes: list[int] = []
    plain = torch.conv2d

    def conv2d(maps: torch.Tensor, *others: Any) -> torch.Tensor:
        sizes.append(len(maps))
        return plain(maps, *others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch.nn.functional.conv2d", conv2d)
        net.forward_loss(**inputs())
    return sizes


@pytest.mark.parametrize("exact", ["none", "small", "all"])
@pytest.mark.parametrize("in_place", [False, True])
def test_joined_towers_compute_the_same_as_separate_ones(net_of, together, exact: str, in_place: bool) -> None:
    net, separate = (net_of(NET, phase=0, exact=exact, accumulate_in_place=in_place) for _ in range(2))
    found = trained(net)
    assert len(net.eager._lines.popitem()[1]) < len(net.plan.nodes) - 7
    together.setattr(Eager, "_joins_towers", lambda _: False)
    for mine, theirs in zip(found, trained(separate), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def test_towers_are_joined_under_autocast_alone(net_of) -> None:
    net = net_of(NET, phase=0, exact="none", accumulate_in_place=True)
    assert batches(net) == [3, 3, 3, 3]
    with torch.autocast("cpu", torch.bfloat16):
        assert batches(net) == [6, 6]
        with torch.no_grad():
            assert batches(net) == [3, 3, 3, 3]
    assert batches(net) == [3, 3, 3, 3]


def test_joined_towers_in_bf16_differ_from_separate_ones_by_rounding(net_of, monkeypatch) -> None:
    net, separate = (net_of(NET, phase=0, exact="none", accumulate_in_place=True) for _ in range(2))
    with torch.autocast("cpu", torch.bfloat16):
        found = trained(net)
        monkeypatch.setattr(Eager, "_joins_towers", lambda _: False)
        expected = trained(separate)
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.dtype == torch.float32
        torch.testing.assert_close(mine, theirs, rtol=0, atol=0.01 * float(theirs.abs().max()))


@pytest.mark.parametrize(
    ("changes", "sizes"),
    [
        ({}, [6, 6]),
        ({'"conv_p" param { name: "w" }': '"conv_p" param { name: "own" }'}, [3, 3, 3, 3]),
        ({'top: "pool_p" pooling_param {': 'top: "pool_p" pooling_param { pool: AVE'}, [6, 6]),
        ({'"ReLU" bottom: "conv': '"Dropout" bottom: "conv'}, [6, 3, 3]),
        ({'"deep_p" type: "Convolution" bottom: "conv_p"': '"deep_p" type: "Convolution" bottom: "deep"'}, [6, 3, 3]),
    ],
)
def test_only_layers_that_are_alike_are_joined(net_of, together, changes: dict[str, str], sizes: list[int]) -> None:
    """``sizes``: the batches of all convolutions. In the last net, one of them reads what its twin computes."""
    text = NET
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    assert sorted(batches(net_of(text, phase=0, exact="none"))) == sorted(sizes)


STILL = ('name: "bn_p" type: "BatchNorm"', 'name: "bn_p" phase: TEST type: "BatchNorm"')
HELD = ('"deep_p" type: "Convolution" bottom: "conv_p" top: "deep_p" param { name: "x"',) * 2


@pytest.mark.parametrize("change", [STILL, (HELD[0], HELD[1] + " lr_mult: 0")], ids=["phase", "lr_mult"])
def test_layers_of_another_phase_or_without_a_gradient_are_not_joined(net_of, together, change) -> None:
    """An ``lr_mult: 0`` of one tower says which of them computes the gradient, which clip_gradients counts."""
    assert NET.count(change[0]) == 1
    text = NET.replace(*change)
    net, separate = (net_of(text, phase=0, exact="all", accumulate_in_place=True) for _ in range(2))
    found = trained(net)
    together.setattr(Eager, "_joins_towers", lambda _: False)
    for mine, theirs in zip(found, trained(separate), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shapes", [((4, 3, 9, 9), (2, 3, 9, 9)), ((2, 3, 9, 9), (2, 3, 7, 9))])
def test_towers_whose_inputs_differ_in_shape_in_a_pass_run_one_by_one(net_of, together, shapes) -> None:
    text = """
        layer { name: "in" type: "Input" top: "a" top: "b"
          input_param { shape { dim: 3 dim: 3 dim: 9 dim: 9 } shape { dim: 3 dim: 3 dim: 9 dim: 9 } } }
        layer { name: "a" type: "Convolution" bottom: "a" top: "x" param { name: "w" } param { name: "v" }
          convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
        layer { name: "b" type: "Convolution" bottom: "b" top: "y" param { name: "w" } param { name: "v" }
          convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
        layer { name: "norm" type: "BatchNorm" bottom: "x" top: "x"
          param { name: "m" lr_mult: 0 } param { name: "d" lr_mult: 0 } param { name: "n" lr_mult: 0 } }
        layer { name: "norm_p" type: "BatchNorm" bottom: "y" top: "y"
          param { name: "m" lr_mult: 0 } param { name: "d" lr_mult: 0 } param { name: "n" lr_mult: 0 } }
    """
    given = [torch.randn(shape, generator=torch.Generator().manual_seed(1)) for shape in shapes]
    net, separate = (net_of(text, phase=0, exact="none") for _ in range(2))
    found = net(a=given[0], b=given[1])
    together.setattr(Eager, "_joins_towers", lambda _: False)
    expected = separate(a=given[0], b=given[1])
    for name in ("x", "y"):
        torch.testing.assert_close(found[name], expected[name], rtol=1e-4, atol=1e-5)


def test_values_to_keep_are_those_of_each_tower(net_of, together) -> None:
    net, separate = (net_of(NET, phase=0, exact="none") for _ in range(2))
    net.keep = separate.keep = "all"
    net.forward_loss(**inputs())
    together.setattr(Eager, "_joins_towers", lambda _: False)
    separate.forward_loss(**inputs())
    assert list(net.blobs) == list(separate.blobs)
    for name, value in separate.blobs.items():
        torch.testing.assert_close(net.blobs[name], value, rtol=1e-4, atol=1e-5)


def test_values_to_keep_have_their_gradients(net_of, together) -> None:
    net = net_of(NET, phase=0, exact="none")
    net.keep = ["deep", "deep_p"]
    loss, _ = net.forward_loss(**inputs())
    gradients = torch.autograd.grad(loss, [net.blobs["deep"], net.blobs["deep_p"]])
    assert all(float(gradient.abs().max()) > 0 for gradient in gradients)


@pytest.mark.parametrize("kind", ["forward", "forward_pre", "full_backward", "full_backward_pre"])
def test_hooks_see_each_tower(net_of, together, kind: str) -> None:
    net, seen = net_of(NET, phase=0, exact="none"), []
    for layer in net.layers:
        if layer.param.name in ("deep", "deep_p"):
            hook = getattr(layer, f"register_{kind}_hook")
            hook(lambda layer, values, *_: seen.append((layer.param.name, len(values[0]))))
    net.forward_loss(**inputs())[0].backward()
    assert sorted(seen) == [("deep", 3), ("deep_p", 3)]
    assert batches(net) == [6, 3, 3]


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_batches_are_normalized_one_after_the_other(kind: torch.dtype, layout: torch.memory_format) -> None:
    data = torch.randn(6, 4, 5, 5).to(kind).contiguous(memory_format=layout)
    diff = torch.randn(6, 4, 5, 5).to(kind).contiguous(memory_format=layout)
    factors, bias = torch.rand(4) + 0.5, torch.randn(4)
    leaves = [x.clone().requires_grad_() for x in (data, factors, bias)]
    top, means, variances = NormalizedBatches.apply(*leaves, 2, 1e-5)
    top.backward(diff)
    expected = [x.clone().requires_grad_() for x in (data, factors, bias)]
    tops = []
    for k, batch in enumerate(expected[0].chunk(2)):
        mean, variance = torch.zeros(2, 4).unbind()
        tops.append(torch.batch_norm(batch, expected[1], expected[2], mean, variance, True, 1.0, 1e-5, False))
        torch.testing.assert_close(means[k], mean)
        torch.testing.assert_close(variances[k], variance)
    torch.testing.assert_close(top, torch.cat(tops))
    torch.cat(tops).backward(diff)
    for mine, theirs in zip(leaves, expected, strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-5 if kind == torch.float32 else 1e-2, atol=1e-5)
