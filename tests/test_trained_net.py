"""The trained nets that the project brings close the loops of a walk they never saw, better than a simple baseline."""

import json
from pathlib import Path

import pytest

from lmdb_build.cli import main as lmdb_build
from loopclosure.cli import main as loopclosure
from netspec.cli import main as netspec
from netspec.inspect.features import shipped

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", [shipped.SMALL, shipped.DEFAULT])
def test_a_shipped_net_beats_thumbnails_on_a_new_walk(tmp_path: Path, name: str) -> None:
    walk, features, out = tmp_path / "walk_1", tmp_path / "features.npz", tmp_path / "report"
    command = ["walk", str(tmp_path), "--frames", "120", "--laps", "2", "--size", "160x120", "--seed", "77"]
    assert lmdb_build(command) == 0
    folder = shipped.folder(name)
    weights = folder / f"{folder.name}.caffemodel"
    net = ["--model", str(folder / "deploy.prototxt"), "--weights", str(weights), "--strict"]
    assert netspec(["extract", *net, "--blob", "feat", "--images", str(walk), "--out", str(features)]) == 0
    methods = ["--method", "thumbnails", "--method", f"words=features:{features}"]
    assert loopclosure(["evaluate", str(walk), "--exclude-seconds", "5", *methods, "--out", str(out)]) == 0
    found = json.loads((out / "report.json").read_text())
    precision = {method["name"]: method["figures"]["all pairs"]["average precision"] for method in found["methods"]}
    assert precision["words"] > precision["thumbnails"] + 0.2
