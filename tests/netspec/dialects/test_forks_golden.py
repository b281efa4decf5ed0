"""Results of the forks themselves: single layers, and trainings of nets with them.

tests/golden/forks/README.md says which forks, how they were built, and where a fork is odd. Their oddities are
repeated, but for the faults listed below. Each case agrees or is such a fault.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path

import numpy as np
import pytest

import netspec
from benchmarks.pages import write
from dialect_numbers import NUMBERS
from fresh_dialects import fresh_dialects
from golden_cases import LayerCase, layer_distances, parameters, set_parameters, train
from netspec import use_dialect
from netspec.dialects import known
from paths import GOLDEN, ROOT

FORKS = GOLDEN / "forks"
CLOSE = 1e-4  # of the largest value
# Faults of the forks, which netspec does not repeat.
FAULTS = {
    "happy__cosine": "happynear's Cosine omits the top's gradient",
    "hed__sigmoid_loss_three": "labels other than 0 and 1 add no loss, but have a gradient",
    "intel__roi_pooling_2x5_outside": "a region with x2 < x1 gets a gradient",
    "mscnn__roi_pooling_2x5_outside": "the backward pass clips regions to the image, but the forward pass does not",
    "mscnn__roi_pooling_pad_ratio": "the backward pass clips regions to the image",
}
# Cases whose files do not show whose they are: the dialect that has to be named. Without it a warning asks for it.
NAMED = {
    "happy__bn_test": "happynear",
    "happy__bn_train_momentum": "happynear",
    "happy__center_loss": "happynear",
    "happy__normalize_nothing_maps": "happynear",
    "hed__sigmoid_loss_edges": "hed",
    "hed__sigmoid_loss_three": "hed",
    "rcf__sigmoid_loss_edges": "rcf",
    "rcf__sigmoid_loss_three": "rcf",
    "normalize_nothing_tsn": "tsn",
}


def check(name: str, compared: Callable[[], dict[str, float]]) -> None:
    """Check that a case agrees, or differs by a fault of the fork's."""
    if name in NAMED:
        use_dialect(NAMED[name])
    off = {key: f"{value:.1e}" for key, value in compared().items() if value > CLOSE}
    assert bool(off) == (name in FAULTS), off or "agrees; remove it from FAULTS"


def differences(case: LayerCase) -> dict[str, float]:
    """Return how far each result is off, as a share of its largest value. Raises SpecError where a net is refused."""
    found = case.compute()
    expected = {key for key in case.golden if key.startswith(("out/", "indiff/", "paramdiff/", "param_after/"))}
    missing = expected - set(found)  # the gradients of what is not learned, which are zeros in Caffe
    assert not any(case.golden[key].any() for key in missing), missing
    return {key: difference(found[key], case.golden[key], key) for key in expected - missing}


def difference(found: np.ndarray, golden: np.ndarray, key: str) -> float:
    """Return the largest difference as a share of the largest value; a blob may have axes of 1 that the other lacks."""
    if key.startswith("param"):
        found = found.reshape(golden.shape)
    assert found.shape == golden.shape, key
    np.testing.assert_array_equal(np.isnan(found), np.isnan(golden), key)
    scale = max(float(np.nanmax(np.abs(golden), initial=0)), 1e-30)
    return float(np.nanmax(np.abs(found - golden), initial=0)) / scale


@pytest.mark.parametrize("name", sorted(os.listdir(FORKS / "layers")))
def test_layer_equals_the_forks_results(name: str) -> None:
    check(name, lambda: differences(LayerCase(FORKS / "layers" / name)))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(os.listdir(FORKS / "training")))
def test_training_follows_the_fork(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(FORKS / "training" / name, tmp_path / name)
    monkeypatch.chdir(tmp_path / name)
    check(name, training_differences)


@pytest.mark.parametrize("name", [name for name in NAMED if NAMED[name] not in ("hed", "rcf")])
def test_layer_of_an_unknown_fork_gets_a_warning(
    name: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in os.listdir(FORKS / "training"):
        monkeypatch.chdir(FORKS / "training" / name)
        netspec.load_solver("solver.prototxt")
    else:
        LayerCase(FORKS / "layers" / name).compute()
    assert f'"{NAMED[name]}" (' in caplog.text


def test_the_tables_contain_existing_cases_only() -> None:
    assert {*FAULTS, *NAMED} <= {*os.listdir(FORKS / "layers"), *os.listdir(FORKS / "training")}


def training_differences() -> dict[str, float]:
    """Train the net of this folder; return how far its losses and its weights at the end are off."""
    golden = dict(np.load("trajectory.npz"))
    weights = "init.caffemodel" if Path("init.caffemodel").exists() else None
    solver = netspec.load_solver("solver.prototxt", weights=weights)
    set_parameters(solver.net, golden, "init/")
    losses = np.array(train(solver, 30))
    final = parameters(solver.net, golden, "final/")
    return {"loss": difference(losses, golden["loss"], "loss"), **layer_distances(final, golden)}


STEPS = (1e-6, 1e-5, 1e-4)  # stated is the least of these that twice a difference does not exceed: CPUs round
OLDER = {"segnet": "TimoSaemann/caffe-enet", "": "senlinuc/caffe_ocr"}  # of cases without a prefix
TABLE = ROOT / "benchmarks" / "results" / "forks.json"
COLUMNS = ("layers", "dialect", "compared with", "largest difference")


def test_the_table_is_current(monkeypatch: pytest.MonkeyPatch) -> None:
    """``PYTHONPATH=.:tests python tests/netspec/dialects/test_forks_golden.py`` writes it."""
    stated = [tuple(row.values()) for row in json.loads(TABLE.read_text())["rows"]]
    found = table(monkeypatch)
    assert [row[:3] for row in stated] == [row[:3] for row in found]
    for (layers, *_, most), (*_, now) in zip(stated, found, strict=True):
        assert not now or float(now) <= float(most), f"{layers} is off by {now}"
    page = " ".join((ROOT / "docs" / "forks.md").read_text().split())
    assert not [why for why in FAULTS.values() if why not in page]


def table(monkeypatch: pytest.MonkeyPatch, margin: float = 1) -> list[tuple[str, ...]]:
    """Return the rows: layers compared with the same forks, or with loops only, and the largest difference of any."""
    worst: dict[str, float] = {}
    forks: dict[str, list[str]] = {}
    for folder, fork in golden_cases():
        name, case = folder.name, LayerCase(folder)
        if name in FAULTS:
            continue
        kind = re.findall(r'layer \{[^{]*?type: "(\w+)"', (folder / "net.prototxt").read_text())[-1]
        monkeypatch.chdir(GOLDEN / "ssd")  # name_size.txt
        with pytest.MonkeyPatch.context() as patch:
            fresh_dialects(patch)
            if name in NAMED:
                use_dialect(NAMED[name])
            off = max(differences(case).values(), default=0.0)
        worst[kind] = max(worst.get(kind, 0.0), off)
        forks.setdefault(kind, []).append(fork)
    owners = layer_types()
    loops = {case.type_name for case in NUMBERS}
    groups: dict[tuple[str, ...], list[str]] = {}
    for kind in sorted({*forks, *owners}):
        how = ", ".join(sorted(set(forks.get(kind, ())))) or ("a loop" if kind in loops else "its formula")
        groups.setdefault((", ".join(owners.get(kind, ["Caffe"])), how), []).append(kind)
    rows = []
    for (dialect, how), kinds in groups.items():
        off = max((worst.get(kind, 0.0) for kind in kinds), default=0.0)
        count = sum(len(forks.get(kind, ())) for kind in kinds)
        layers = ", ".join(f"`{kind.rpartition('.')[2]}`" for kind in kinds)
        stated = f"{next(step for step in STEPS if margin * off <= step):g}" if count else ""
        rows.append((layers, dialect, f"{how}: {count}" if count else how, stated))
    return sorted(rows, key=lambda row: (row[1], not row[3], row[0]))


def layer_types() -> dict[str, list[str]]:
    """Return the dialects that have a layer type, or put a layer in the place of one of Caffe's."""
    owners: dict[str, list[str]] = {}
    for dialect in known._found().values():
        if not Path(dialect.file).is_relative_to(ROOT / "netspec"):  # of a package, from another test
            continue
        source = Path(dialect.file).read_text()
        replaced = re.findall(r'replace\(\s*"(\w+)"', source)
        for kind in {*dialect.layer_types, *replaced}:
            owners.setdefault(kind, []).append(dialect.name)
    return owners


def golden_cases() -> Iterator[tuple[Path, str]]:
    """Yield the folder of each case of a layer, and the repository of its fork."""
    readme = (FORKS / "README.md").read_text()
    names: dict[str, str] = {}
    for prefixes, repositories in re.findall(r"^\| ([a-z0-9, ]+) \| ([^|]+/[^|]+) \|", readme, re.MULTILINE):
        names.update(zip(prefixes.split(", "), repositories.split(", "), strict=True))
    for folder in sorted((FORKS / "layers").iterdir()):
        prefix, _, rest = folder.name.partition("__")
        yield folder, names[prefix] if rest else OLDER.get(prefix.split("_")[0], OLDER[""])
    for folder in sorted((GOLDEN / "ssd" / "layers").iterdir()):
        yield folder, names["ssd"]


if __name__ == "__main__":
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in table(pytest.MonkeyPatch(), margin=2)]
    note = {"note": "differences are rounded up, so that those of other processors are not larger"}
    command = "PYTHONPATH=.:tests python tests/netspec/dialects/test_forks_golden.py"
    made = {"machine": note, "date": date.today().isoformat(), "command": command, "rows": rows}
    TABLE.write_text(json.dumps(made, indent=1) + "\n")
    write()
