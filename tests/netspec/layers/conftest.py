"""Fixtures that build single layers from text, with both ways to sum."""

from collections.abc import Callable
from typing import Any

import pytest

from contexts import context
from netspec.errors import Where
from netspec.layers import Layer, Random
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST


@pytest.fixture(params=["none", "all"])
def exact(request: pytest.FixtureRequest) -> str:
    """Return which layers' sums equal Caffe's bit for bit. Tests of a layer run with both, since its code differs."""
    return request.param


def _at(*path: str | int) -> Where:
    """Return a place that errors show as the path of a field, as in ``convolution_param.pad.1: ...``."""
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
