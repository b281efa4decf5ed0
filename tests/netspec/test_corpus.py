"""Public nets and solvers, as they are found: the blobs and parameters that BVLC Caffe builds or a paper states."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from netspec.inspect.check.check import ON_META, as_json, check_file
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net, parse_solver
from paths import SHARED

pytestmark = pytest.mark.slow

CORPUS = SHARED / "corpus"
FILES = sorted(str(path.relative_to(CORPUS)) for path in CORPUS.rglob("*.prototxt"))  # none where it is absent
SOLVERS = [name for name in FILES if "solver" in Path(name).name]


SHAPES = json.loads((CORPUS / "shapes.json").read_text()) if FILES else {}
WITH_DATA = [name for name in FILES if name.startswith(("BVLC", "forresti")) and name not in SHAPES]
#: What cannot be checked by itself: code to run, and nets that a script writes.
OTHERS = ("linreg.prototxt", "lenet_auto_solver.prototxt")


def given_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Return shapes for what the data layers of a net make; of images that of the labels follows."""
    if "hdf5" in name:
        return {"data": (4, 4), "label": (4,)}
    if "siamese" in name:
        return {"pair_data": (4, 2, 28, 28)}
    image = (1, 28, 28) if "mnist" in name else (3, 32, 32) if "cifar10" in name else (3, 227, 227)
    return {"data": (4, *image)}


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_net_builds_with_caffes_shapes(name: str) -> None:
    (checked,) = check_file(CORPUS / name, TEST)
    assert not checked.faults
    assert checked.net is not None
    found = as_json(checked.net)
    for part in ("blobs", "params", "inputs", "outputs"):
        assert found[part] == SHAPES[name][part], part


@pytest.mark.parametrize("name", [name for name in WITH_DATA if not name.endswith(OTHERS)])
def test_nets_with_data_layers_and_solvers_check(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    root = CORPUS / Path(name).parts[0]
    monkeypatch.chdir((CORPUS / name).parent if name.startswith("forresti") else root)  # where its paths begin
    shapes = given_shapes(name)
    for phase in (TRAIN, TEST):
        checked = check_file(CORPUS / name, phase, replace(ON_META, stages=["test-on-test"], given_shapes=shapes))
        assert [str(fault) for part in checked for fault in part.faults] == []
        assert (checked[0].net is None) == (name in SOLVERS)


@pytest.mark.parametrize("name", SOLVERS)
def test_solver_parses(name: str) -> None:
    parse_solver(CORPUS / name)


@pytest.mark.parametrize("name", [name for name in FILES if name not in SOLVERS])
def test_net_parses(name: str) -> None:
    parse_net(CORPUS / name)


SENET = SHARED / "corpus" / "hujie-frank+SENet" / "models"
# Parameters as the SENet paper has them (table 2 and section 4), in millions, without the batch norms' statistics.
PARAMETERS = {"SE-ResNet-50": 28.1, "SE-ResNet-101": 49.3, "SE-ResNet-152": 66.8, "SE-ResNeXt-50": 27.6}


@pytest.mark.parametrize("path", sorted(SENET.glob("*.prototxt")), ids=lambda path: path.stem)
def test_senet_has_the_published_number_of_parameters(path: Path) -> None:
    (checked,) = check_file(path, TEST)
    assert checked.faults == []
    assert checked.net is not None
    assert checked.net.shapes["prob"] == (1, 1000)
    learned = sum(p.parameter.numel() for p in checked.net.learnable if p.lr_mult)
    if path.stem in PARAMETERS:
        assert learned / 1e6 == pytest.approx(PARAMETERS[path.stem], abs=0.1)
