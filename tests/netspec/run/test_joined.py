"""BatchNorm, Scale and ReLU run as one kernel in training, with the same results as separately."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from netspec.net.net import Net

NET = (Path(__file__).parent / "nets" / "joined.prototxt").read_text()
APART = (Path(__file__).parent / "nets" / "apart.prototxt").read_text()


@contextmanager
def calls(names: list[str], net: Net) -> Iterator[list[str]]:
    """List the layers that run by themselves."""
    seen: list[str] = []
    plain = {name: layer.run for layer in net.layers if (name := layer.param.name) in names}
    for layer in net.layers:
        if layer.param.name in plain:
            layer.run = lambda *b, n=layer.param.name: (seen.append(n), plain[n](*b))[1]  # type: ignore[method-assign]
    yield seen


def passed(net: Net, data: torch.Tensor) -> list[torch.Tensor]:
    """Run twice, as statistics add up; return the learnable blobs and their gradients."""
    for _ in range(2):
        net.forward_loss(x=data)[0].backward()
    gradients = [item.parameter.grad for item in net.learnable if item.parameter.grad is not None]
    return [*(item.parameter.detach() for item in net.learnable), *gradients]


@pytest.mark.parametrize(
    "text",
    [
        NET,
        NET.replace("ReLU", "Sigmoid"),
        NET.replace('"ReLU" ', '"ReLU" relu_param { negative_slope: 0.5 } '),
        NET.replace("bias_term: true", ""),
        NET.replace("scale_param {", "scale_param { axis: 0"),
        NET.replace('"Scale" bottom: "c" top: "c"', '"Scale" bottom: "c" top: "c" propagate_down: false'),
    ],
)
def test_joined_layers_compute_the_same_as_separate_layers(net_of, text: str) -> None:
    data = torch.randn(4, 3, 40, 40, generator=torch.Generator().manual_seed(1))
    together, alone = net_of(text, phase=0, exact="none"), net_of(text, phase=0, exact="none")
    alone.eager._runs_alone = [True] * len(alone.layers)
    for mine, theirs in zip(passed(together, data), passed(alone, data), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "keep", "hooked", "expected"),
    [
        (NET, (), "", []),
        (NET, "all", "", []),  # each wrote over the one before
        (APART, (), "", []),
        (APART, "s", "", ["relu"]),
        (APART, "all", "", ["scale", "relu"]),
        (NET, (), "forward", ["scale", "relu"]),
        (NET, (), "forward_pre", ["scale", "relu"]),
        (NET, (), "full_backward", ["scale", "relu"]),
        (NET, (), "full_backward_pre", ["scale", "relu"]),
    ],
)
def test_layers_are_joined_unless_they_have_hooks(net_of, text: str, keep, hooked: str, expected: list[str]) -> None:
    net = net_of(text, phase=0)
    net.keep = keep
    if hooked:
        getattr(net.layers[4], f"register_{hooked}_hook")(lambda *_: None)
    with calls(["scale", "relu"], net) as seen:
        net.forward_loss(x=torch.randn(4, 3, 40, 40))
    assert seen == expected


def test_small_layers_are_computed_as_caffe_does(net_of) -> None:
    net = net_of(NET.replace("40", "12"), phase=0)
    with calls(["scale", "relu"], net) as seen:
        net.forward_loss(x=torch.randn(4, 3, 12, 12))
    assert seen == ["scale", "relu"]
