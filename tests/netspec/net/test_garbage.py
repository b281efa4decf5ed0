"""Python's garbage collector is disabled while a net is built, and restored afterwards."""

import gc
from collections.abc import Callable

import pytest

from netspec.errors import SpecError
from netspec.files.limits import no_collection
from netspec.net.net import Net

UNKNOWN = 'layer { name: "relu" type: "ReLU" bottom: "nothing" top: "relu" }'


def test_a_net_is_built_without_collections(net_of: Callable[..., Net]) -> None:
    during: list[bool] = []
    net_of(UNKNOWN, report=lambda _: during.append(gc.isenabled()))
    assert set(during) == {False}
    assert gc.isenabled()


def test_the_collector_is_enabled_again_after_an_error(net_of: Callable[..., Net]) -> None:
    with pytest.raises(SpecError, match="nothing"):
        net_of(UNKNOWN)
    assert gc.isenabled()


def test_a_collector_that_was_disabled_stays_disabled(net_of: Callable[..., Net]) -> None:
    with no_collection():
        net_of('layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }')
        assert not gc.isenabled()
    assert gc.isenabled()
