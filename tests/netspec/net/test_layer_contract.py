"""A layer of the user: the shapes it returns are checked, missing methods reported; inputs by position and name."""

from collections.abc import Callable, Sequence

import pytest
import torch
from typing_extensions import override

from netspec.errors import SpecError
from netspec.layers.contract import registry
from netspec.layers.contract.base import Layer, Shape
from netspec.net.net import Net

TEXT = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "odd" type: "Odd" bottom: "data" top: "odd" }
"""


class Odd(Layer):
    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data[:1]


class Whole(Odd):
    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return 2 * data


class Shapeless(Layer):
    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data


class Idle(Layer):
    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes


class Flat(Odd):
    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes[0]  # type: ignore[return-value]


class Many(Odd):
    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [*bottom_shapes, (1,)]


@pytest.fixture
def net_with_layer(net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch) -> Callable[[type[Layer]], Net]:
    def make(cls: type[Layer]) -> Net:
        monkeypatch.setitem(registry._LAYERS, "Odd", cls)
        return net_of(TEXT)

    return make


@pytest.mark.parametrize("gradients", [False, True], ids=["no_grad", "grad"])
def test_a_top_with_an_undeclared_shape_is_refused(net_with_layer: Callable[..., Net], gradients: bool) -> None:
    net, whole = net_with_layer(Odd), net_with_layer(Whole)
    with torch.set_grad_enabled(gradients):
        for _ in range(2):
            with pytest.raises(SpecError) as found:
                net(data=torch.ones(2, 3))
        whole(data=torch.ones(2, 3))
        whole(data=torch.ones(5, 4))
    assert str(found.value) == (
        'net.prototxt:3:21: layer "odd" (Odd): forward returned a top of shape (1, 3), but reshape returned (2, 3)'
    )


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (Shapeless, "class Shapeless does not define reshape(bottom_shapes); write it"),
        (Flat, "reshape returned (2, 3), expected one shape for each top, such as [(2, 3)]"),
        (Many, "reshape returned 2 shape(s), expected 1, one for each top"),
    ],
    ids=["no_reshape", "not_a_list", "too_many"],
)
def test_a_class_without_top_shapes_is_refused(
    net_with_layer: Callable[..., Net], cls: type[Layer], message: str
) -> None:
    with pytest.raises(SpecError) as found:
        net_with_layer(cls)
    assert found.value.message == message


def test_a_class_without_forward_is_refused(net_with_layer: Callable[..., Net]) -> None:
    net = net_with_layer(Idle)
    for gradients in (False, True):
        with torch.set_grad_enabled(gradients), pytest.raises(SpecError, match="Idle does not define forward"):
            net(data=torch.ones(2, 3))


TWO = """
layer { name: "in" type: "Input" top: "a" top: "b" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "sum" type: "Eltwise" bottom: "a" bottom: "b" top: "sum" }
"""


def test_the_value_of_the_only_input_needs_no_name(net_of: Callable[..., Net]) -> None:
    net = net_of(TEXT.replace("Odd", "ReLU"))
    values = torch.randn(2, 3)
    assert torch.equal(net(values)["odd"], net(data=values)["odd"])
    with pytest.raises(SpecError, match=r"^net.prototxt: found 2 values without a name; give inputs by name: data=..."):
        net(values, values)
    with pytest.raises(SpecError, match=r"found a value without a name; give inputs by name: a=..., b=..."):
        net_of(TWO)(values)


def test_an_input_can_be_named_self(net_of: Callable[..., Net]) -> None:
    net = net_of(TEXT.replace("Odd", "ReLU").replace('"data"', '"self"'))
    values = torch.randn(2, 3)
    expected = net(values)["odd"]
    assert torch.equal(net(**{"self": values})["odd"], expected)
    assert torch.equal(net.forward(**{"self": values})["odd"], expected)
    assert torch.equal(net.forward_loss(**{"self": values})[1]["odd"], expected)
