"""How the tests of single layers build one from text, and check its gradient."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from contexts import context
from netspec.errors import Where
from netspec.layers import Layer, Random
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=["none", "all"])
def exact(request: pytest.FixtureRequest) -> str:
    """Whose sums are Caffe's to the last bit. The tests of a layer run twice, since it sums up in two ways."""
    return request.param


def _at(*path: str | int) -> Where:
    """Say where a fault is by the path to it: an error reads ``convolution_param.pad.1: ...``."""
    return Where(".".join(map(str, path)))


@pytest.fixture
def build(exact: str) -> Callable[..., Layer]:
    """``build(text, *bottom_shapes, tops=1, phase=TEST, seed=0, ...)``: a layer from the text of a LayerParameter.

    The text holds no bottoms and tops; their names are made up, one bottom for each shape. Other keywords are fields of
    the layer's Context.
    """

    def build_layer(
        text: str, *shapes: tuple[int, ...], tops: int = 1, phase: int = TEST, seed: int = 0, **facts: Any
    ) -> Layer:
        known = {"phase": phase, "random": Random(seed), "at": _at, "exact": exact}
        return make_layer(text, shapes, context(**{**known, **facts}), tops)

    return build_layer
