"""From sequences of two rooms to the paper's Table I and its Figure 5: examples/table_1.py and figure_5.py."""

import json
import re
import shutil
from pathlib import Path

import pytest

import forked
from lmdb_build.walk.sequence import Walk, write_walk
from netspec.proto.text import read_net, read_solver
from paths import ROOT

pytestmark = pytest.mark.slow

ROOMS = ("--room", "hall", "hall_again", "--room", "kitchen")
SMALL = "--size 32 --iterations 2 --batch 8 --train 40 --validation 20".split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sequences of two rooms, the nets, and the table in table_1."""
    folder = tmp_path_factory.mktemp("table_1")
    for seed, name in enumerate(("hall", "kitchen")):
        list(write_walk(folder / name, Walk(frames=120, width=64, height=48, seed=seed)))
    shutil.copytree(folder / "hall", folder / "hall_again")
    (folder / "prototxt").symlink_to(ROOT / "prototxt")
    said = run(folder, "table_1.py", *ROOMS, *SMALL, "--nets", "siamese_8", "--leave-one-out")
    assert said.count("--resume") == 3
    return folder


def run(folder: Path, script: str, *words: str) -> str:
    """Run an example in a folder; return what it prints."""
    done = forked.run(forked.script, ROOT / "examples" / script, words, folder=folder, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    return done.stdout


def table(folder: Path) -> list[dict[str, str]]:
    return json.loads((folder / "table_1" / "table.json").read_text())


def test_the_table_lists_the_omitted_rooms(folder: Path) -> None:
    found = table(folder)
    assert [row["trained on"] for row in found] == ["all rooms", "without hall", "without kitchen"]
    assert {row["paper"] for row in found} == {0.695}
    for cell in (row[f"{judged} ROC AUC"] for row in found for judged in ("validation", "test")):
        low, middle, high = map(float, re.fullmatch(r"(?P<m>\S+) \((\S+) to (\S+)\)", cell).group(2, 1, 3))  # pyright: ignore
        assert 0 <= low <= middle <= high <= 1
    pairs = folder / "table_1" / "without_kitchen"
    assert "kitchen/" not in (pairs / "pairs" / "train.txt").read_text().partition("seed:")[2]
    assert "hall" not in (pairs / "test" / "test.txt").read_text().partition("seed:")[2]


def test_the_solver_has_the_papers_proportions(folder: Path) -> None:
    seed = folder / "table_1/all_rooms/siamese_8/seed_1"
    solver = read_solver(seed / "solver.prototxt")
    assert [round(value, 6) for value in (solver.base_lr, solver.gamma, solver.momentum)] == [0.01, 0.1, 0.9]
    assert (solver.stepsize, solver.max_iter, solver.solver_mode, list(solver.test_iter)) == (1, 2, 0, [1])
    batches = [
        layer.data_param.batch_size for layer in read_net(seed / "train_val.prototxt").layer if layer.type == "Data"
    ]
    assert batches == [8, 50]


def test_complete_steps_are_kept_and_trainings_resume(folder: Path) -> None:
    before, seed = table(folder), folder / "table_1" / "all_rooms" / "siamese_8" / "seed_1"
    (seed / "runs.json").unlink()
    for file in seed.glob("siamese_8_iter_2*"):
        file.unlink()
    said = run(folder, "table_1.py", *ROOMS, *SMALL, "--nets", "siamese_8", "--leave-one-out")
    assert said.count("$") == 1
    assert "Resuming from" in (seed / "siamese_8.log").read_text()
    assert table(folder) == before


def test_figure_5(folder: Path) -> None:
    names = ("all_rooms", "without_hall")
    weights = [f"table_1/{name}/siamese_8/seed_1/siamese_8_iter_2.caffemodel" for name in names]
    given = ("--weights", *weights, "--vocabulary", "kitchen")
    words = ("hall", "hall_again", "--net", "siamese_8", "--size", "32", "--start", "0.5", *given)
    said = run(folder, "figure_5.py", *words)
    assert "s for 120 images" in said
    found = {row["method"]: row for row in json.loads((folder / "figure_5" / "table.json").read_text())}
    assert [*found] == [
        *(f"net, {name.replace('_', ' ')}" for name in names),
        "FAB-MAP 2.0, words of kitchen",
        "thumbnails",
    ]
    assert found["thumbnails"]["R@1 15"] > 0.8  # the halves of a sequence and of its copy
    for row in found.values():
        assert row["images"] == 120
        assert 0 < row["with a loop 15"] <= row["with a loop 45"]
        assert 0 <= row["AP 15"] <= 1
        assert 0 <= row["AP 45"] <= 1
    assert (folder / "figure_5" / "report" / "matrices.png").exists()
