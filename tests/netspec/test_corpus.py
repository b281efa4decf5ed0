"""Public nets and solvers, as they are found: the blobs, split blobs and parameters that BVLC Caffe builds."""

import json
from pathlib import Path

import pytest

from netspec.check import as_json, check_file, is_solver
from netspec.proto.text import parse_net, parse_solver
from shared_data import SHARED

CORPUS = SHARED / "corpus"
FILES = sorted(str(path.relative_to(CORPUS)) for path in CORPUS.rglob("*.prototxt"))  # none where it is absent
SOLVERS = [name for name in FILES if "solver" in Path(name).name]


@pytest.mark.parametrize("name", [name for name in FILES if name not in SOLVERS])
def test_net_builds_with_caffes_shapes(name: str) -> None:
    expected = json.loads((CORPUS / "shapes.json").read_text()).get(name)
    assert not is_solver(CORPUS / name)
    if expected is None:
        parse_net(CORPUS / name)
        return
    (checked,) = check_file(CORPUS / name, phase=1)
    assert not checked.faults
    assert checked.net is not None
    found = as_json(checked.net)
    for part in ("blobs", "params", "inputs", "outputs"):
        assert found[part] == expected[part], part


@pytest.mark.parametrize("name", SOLVERS)
def test_solver_parses(name: str) -> None:
    assert is_solver(CORPUS / name)
    parse_solver(CORPUS / name)
