"""Public nets and solvers, as they are found: the blobs, split blobs and parameters that BVLC Caffe builds."""

import json
from pathlib import Path

import pytest
from conftest import shared

from netspec.check import as_json, check_file, is_solver
from netspec.proto.text import parse_net, parse_solver

ROOT = Path(__file__).parents[2]


def corpus() -> Path:
    return shared("corpus")


def names(ending: str) -> list[str]:
    try:
        root = corpus()
    except pytest.skip.Exception:
        return ["absent"]
    return sorted(
        str(path.relative_to(root))
        for path in root.rglob("*.prototxt")
        if ("solver" in path.name) == (ending == "solver")
    )


@pytest.mark.parametrize("name", names("net"))
def test_net_builds_with_caffes_shapes(name: str) -> None:
    root = corpus()
    expected = json.loads((root / "shapes.json").read_text()).get(name)
    assert not is_solver(root / name)
    if expected is None:
        parse_net(root / name)
        return
    (checked,) = check_file(root / name, phase=1)
    assert not checked.faults
    assert checked.net is not None
    found = as_json(checked.net)
    for part in ("blobs", "params", "inputs", "outputs"):
        assert found[part] == expected[part], part


@pytest.mark.parametrize("name", names("solver"))
def test_solver_parses(name: str) -> None:
    assert is_solver(corpus() / name)
    parse_solver(corpus() / name)
