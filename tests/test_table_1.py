"""From sequences of two rooms to the paper's Table I and its Figure 5: examples/table_1.py and figure_5.py."""

import csv
import json
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
    assert said.count("validation pairs") == said.count("test pairs") == 3
    return folder


def run(folder: Path, script: str, *words: str) -> str:
    """Run an example in a folder; return what it prints."""
    done = forked.run(forked.script, ROOT / "examples" / script, words, folder=folder, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_tables_list_the_nets_of_all_trainings(folder: Path) -> None:
    for name in ("all_rooms", "without_hall", "without_kitchen"):
        with (folder / "table_1" / name / "table.csv").open() as file:
            (row,) = csv.DictReader(file)
        assert 0 <= float(row["ROC AUC"]) <= 1
    pairs = folder / "table_1" / "without_kitchen"
    assert "kitchen/" not in (pairs / "pairs" / "train.txt").read_text().partition("seed:")[2]
    assert "hall" not in (pairs / "test" / "test.txt").read_text().partition("seed:")[2]


def test_the_solver_has_the_papers_proportions(folder: Path) -> None:
    net = folder / "table_1/all_rooms/siamese_8"
    solver = read_solver(net / "seed_1" / "solver.prototxt")
    assert [round(value, 6) for value in (solver.base_lr, solver.gamma, solver.momentum)] == [0.01, 0.1, 0.9]
    assert (solver.stepsize, solver.max_iter, solver.solver_mode, list(solver.test_iter)) == (1, 2, 0, [1])
    batches = [
        layer.data_param.batch_size for layer in read_net(net / "train_val.prototxt").layer if layer.type == "Data"
    ]
    assert batches == [8, 50]


def test_complete_steps_are_kept_and_trainings_resume(folder: Path) -> None:
    out = folder / "table_1" / "all_rooms"
    (out / "table.csv").unlink()
    for file in (out / "siamese_8" / "seed_1").glob("siamese_8_iter_2*"):
        file.unlink()
    said = run(folder, "table_1.py", *ROOMS, *SMALL, "--nets", "siamese_8", "--seeds", "2", "--leave-one-out")
    assert said.count("$") == 1
    assert "Resuming from" in (out / "siamese_8.log").read_text()
    assert (out / "siamese_8" / "seed_2" / "siamese_8_iter_2.caffemodel").exists()
    assert (out / "table.csv").exists()


def test_figure_5(folder: Path) -> None:
    names = ("all_rooms", "without_hall")
    weights = [f"table_1/{name}/siamese_8/seed_1/siamese_8_iter_2.caffemodel" for name in names]
    given = ("--weights", *weights, "--vocabulary", "kitchen")
    words = ("hall", "hall_again", "--net", "siamese_8", "--size", "32", "--start", "0.5", *given)
    run(folder, "figure_5.py", *words)
    report = json.loads((folder / "figure_5" / "report" / "report.json").read_text())
    assert report["queries"] == 120
    assert 0 < report["queries_with_a_loop"] <= report["wide_angle"]["queries_with_a_loop"]
    figures = {method["name"]: method["figures"]["best match of each query"] for method in report["methods"]}
    others = ["FAB-MAP 2.0, words of kitchen", "thumbnails"]
    assert [*figures] == [*(f"net, {name.replace('_', ' ')}" for name in names), *others]
    assert figures["thumbnails"]["recall at 1"] > 0.8  # the halves of a sequence and of its copy
    assert (folder / "figure_5" / "report" / "matrices.png").exists()
