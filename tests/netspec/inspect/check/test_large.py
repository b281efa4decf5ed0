"""A text that describes too much, or is too long, is checked soon."""

from collections.abc import Callable

import pytest

from netspec.errors import SpecError
from netspec.graph import splits
from netspec.net.net import Net

INPUT = 'input: "data" input_dim: 1 input_dim: 3 input_dim: 8 input_dim: 8\n'


def unknown(count: int) -> str:
    layers = (f'layer {{ name: "r{i}" type: "ReLU" bottom: "b{i}" top: "r{i}" }}\n' for i in range(count))
    return INPUT + "".join(layers)


def test_an_error_in_a_large_net_names_the_last_blobs(net_of: Callable[..., Net]) -> None:
    faults: list[SpecError] = []
    net_of(unknown(100), report=faults.append)
    assert "unknown bottom blob" in str(faults[99])
    assert f"available: {100 - splits.MOST_NAMES} more, r{99 - splits.MOST_NAMES}, " in str(faults[99])


def test_similar_names_are_looked_for_only_so_often(
    net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each search takes time for each blob there is: for 10,000 unknown blobs, minutes."""
    asked: list[str] = []
    monkeypatch.setattr(splits, "did_you_mean", lambda blob, known: asked.append(blob) or "")
    net_of(unknown(100), report=lambda fault: None)
    assert len(asked) == splits.MOST_HINTS


def test_a_pyramid_of_more_windows_than_can_be_counted(net_of: Callable[..., Net]) -> None:
    spp = 'layer { name: "s" type: "SPP" bottom: "data" top: "s" spp_param { pyramid_height: 4000000000 } }'
    with pytest.raises(SpecError, match="pyramid_height must be at most 16: more windows than an int counts"):
        net_of(INPUT + spp)
