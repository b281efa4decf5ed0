"""In-place layers one after the other: the gradients that Caffe's shared memory gives, by plain numpy."""

import inspect
from collections.abc import Callable

import numpy as np
import pytest
import torch
from typing_extensions import override

from netspec.graph.filter import with_state
from netspec.layers.activation import ReLU
from netspec.layers.contract import registry
from netspec.layers.contract.base import Layer
from netspec.layers.recurrent import LSTM
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TRAIN
from netspec.proto.text import parse_net_text

SHAPE = (6, 4)


def chain(*layers: str) -> Net:
    """A net that copies its input x to y (Power), then runs each layer in place on y."""
    text = 'force_backward: true layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 6 dim: 4 } } }'
    text += 'layer { name: "copy" type: "Power" bottom: "x" top: "y" }'
    for i, layer in enumerate(layers):
        text += f'layer {{ name: "l{i}" bottom: "y" top: "y" {layer} }}'
    net, source = parse_net_text(text, "chain.prototxt")
    return build_net(with_state(net, TRAIN), source)


def run(net: Net) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y, a random gradient of y, and the gradient of x, in double."""
    random = np.random.default_rng(7)
    x = torch.from_numpy(random.normal(size=SHAPE)).requires_grad_()
    y = net.double()(x=x)["y"]
    diff = random.normal(size=SHAPE)
    y.backward(torch.from_numpy(diff))
    assert x.grad is not None
    return x.detach().numpy(), y.detach().numpy(), diff, x.grad.numpy()


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def batch_norm_gradient(inner: np.ndarray, top: np.ndarray, diff: np.ndarray) -> np.ndarray:
    deviation = np.sqrt(inner.var(0) + 1e-5)
    return (diff - diff.mean(0) - top * (diff * top).mean(0)) / deviation


def test_relu_before_batch_norm_passes_gradients_of_values_above_the_mean() -> None:
    x, y, diff, gradient = run(chain('type: "ReLU"', 'type: "BatchNorm"'))
    expected = batch_norm_gradient(x.clip(0), y, diff) * (y > 0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-9)
    assert ((y > 0) != (x > 0)).any()


def test_sigmoid_before_dropout_reads_the_dropped_and_scaled_values() -> None:
    x, y, diff, gradient = run(chain('type: "Sigmoid"', 'type: "Dropout" dropout_param { dropout_ratio: 0.25 }'))
    kept = y != 0
    assert kept.any()
    assert not kept.all()
    np.testing.assert_allclose(y, sigmoid(x) * kept / 0.75)
    np.testing.assert_allclose(gradient, diff * kept / 0.75 * y * (1 - y), rtol=1e-6)


def test_relu_before_dropout_has_the_gradient_of_unshared_memory() -> None:
    x, y, diff, gradient = run(chain('type: "ReLU"', 'type: "Dropout"'))
    np.testing.assert_allclose(gradient, diff * 2 * (y > 0))
    assert not (y[x <= 0]).any()


@pytest.mark.parametrize(
    ("layer", "derivative"),
    [
        ('type: "ReLU"', lambda x, y: y > 0),
        ('type: "ReLU" relu_param { negative_slope: 0.1 }', lambda x, y: np.where(y > 0, 1, 0.1)),
        ('type: "ELU" elu_param { alpha: 2 }', lambda x, y: np.where(y > 0, 1, 2 + y)),
        ('type: "Swish" swish_param { beta: 3 }', lambda x, y: 3 * y + sigmoid(3 * x) * (1 - 3 * y)),
        ('type: "TanH"', lambda x, y: 1 - y**2),
        ('type: "BNLL"', lambda x, y: sigmoid(y)),
    ],
)
def test_a_layer_reads_the_result_of_a_negative_scale(layer: str, derivative: Callable[..., np.ndarray]) -> None:
    net = chain(layer, 'type: "Scale" scale_param { filler { value: -3 } }')
    x, y, diff, gradient = run(net)
    np.testing.assert_allclose(gradient, -3 * diff * derivative(x, y), rtol=1e-6)


@pytest.mark.parametrize(
    ("layer", "derivative"),
    [
        ('type: "ReLU" relu_param { negative_slope: -0.5 }', lambda y: np.where(y > 0, 1, -0.5)),
        ('type: "ELU" elu_param { alpha: -1 }', lambda y: np.where(y > 0, 1, -1 + y)),
    ],
)
def test_a_fold_loses_the_bottoms_sign(layer: str, derivative: Callable[..., np.ndarray]) -> None:
    x, y, diff, gradient = run(chain(layer))
    assert ((y > 0) != (x > 0)).any()
    np.testing.assert_allclose(gradient, diff * derivative(y), rtol=1e-6)


@pytest.mark.parametrize("layer", ['type: "ReLU"', 'type: "ELU"', 'type: "Sigmoid"', 'type: "TanH"', 'type: "Exp"'])
def test_the_last_layer_of_a_chain_has_torchs_gradient(layer: str) -> None:
    y = chain('type: "BatchNorm"', layer)(x=torch.ones(SHAPE, requires_grad=True))["y"]
    assert y.grad_fn is not None
    assert "FromMemory" not in y.grad_fn.name()


class OwnForward(ReLU):
    """A ReLU with another forward pass: all that ReLU says of its own no longer holds."""

    @override
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 3 * super().forward(x)


def test_a_subclass_with_its_own_forward_gets_its_gradient_from_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place below BatchNorm, ReLU's gradient reads the memory; that of the subclass must not."""
    monkeypatch.setitem(registry._LAYERS, "ReLU", OwnForward)
    x, y, diff, gradient = run(chain('type: "ReLU"', 'type: "BatchNorm"'))
    inner = 3 * x.clip(0)
    np.testing.assert_allclose(gradient, batch_norm_gradient(inner, y, diff) * 3 * (x > 0), rtol=1e-6, atol=1e-9)


def test_a_subclass_with_its_own_forward_starts_from_the_defaults() -> None:
    kept = {name for name in Layer.OF_FORWARD if vars(Layer)[name] is not inspect.getattr_static(OwnForward, name)}
    assert not kept
    assert inspect.getattr_static(LSTM, "changes_itself")
