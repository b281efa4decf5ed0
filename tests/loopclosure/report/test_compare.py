"""Reports side by side."""

import json
import re

import numpy as np
import pytest

from given_scores import GivenScores
from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.evaluate import evaluate
from loopclosure.places.datasets import load_sequence
from loopclosure.places.sequences import read_sequence
from loopclosure.report.compare import read_reports, table, text, warnings
from loopclosure.report.files import write_files

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def reports(two_laps, tmp_path_factory):
    """Two runs: "net" is perfect in the second, "other" is in the first only."""
    data = load_sequence(read_sequence(two_laps, "tum"))
    perfect = np.where(data.truth.hard, 1.0, 0.0)
    noise = np.random.default_rng(0).normal(size=(40, 40))
    paths = []
    for label, methods in (
        ("old", [("net", GivenScores(noise)), ("<other>", GivenScores(noise))]),
        ("new", [("net", GivenScores(perfect))]),
    ):
        folder = tmp_path_factory.mktemp("runs") / label
        folder.mkdir()
        write_files(evaluate(data, methods), folder)
        paths.append(folder / "report.json")
    return paths


def test_table_and_curves_are_on_one_page(reports, tmp_path, capsys):
    out = tmp_path / "made" / "page.html"
    assert main(["compare", *map(str, reports), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    page = out.read_text()
    assert set(re.findall(r'(?:src|href)="([^:]*:)', page)) == {"data:"}
    assert "&lt;other&gt;" in page
    assert "<other>" not in page
    assert page.count('class="group') == 2
    for words in ("net", "old", "new", "difference", "soft zone", "all pairs"):
        assert words in page
        assert words in printed


def test_figures_are_those_of_the_reports(reports):
    old, new = read_reports(reports)
    rows = {(row.method, row.report): row.cells for row in table([old, new])}
    assert list(rows) == [("net", "old"), ("net", "new"), ("net", "difference"), ("<other>", "old")]
    figures = json.loads(reports[0].read_text())["methods"][0]["figures"]["all pairs"]
    assert rows["net", "old"][0] == f"{figures['average precision']:.3f}"
    assert set(rows["net", "new"]) == {"1.000"}
    assert float(rows["net", "difference"][0]) == pytest.approx(1 - figures["average precision"], abs=1e-3)
    curve = new.curves["net"]["all pairs"]
    assert (curve["recall"][-1], curve["precision"][-1]) == (1.0, 1.0)
    assert warnings([old, new]) == []


def test_reports_that_cannot_be_compared_are_reported(reports, tmp_path):
    found = json.loads(reports[1].read_text())
    found["truth_and_exclusion"] = "other limits"
    for method in found["methods"]:
        del method["curves"]
    (tmp_path / "report.json").write_text(json.dumps(found))
    said = text(read_reports([reports[0], tmp_path / "report.json"]))
    assert "the reports are of different truth" in said
    assert "has no curves: it is of an earlier version" in said


@pytest.mark.parametrize(
    ("content", "message"),
    [("{", "is not JSON"), ("[]", "is not a report.json"), ('{"methods": [{"name": 1}]}', "is not a report.json")],
)
def test_other_files_are_refused(reports, tmp_path, content, message):
    (tmp_path / "x.json").write_text(content)
    with pytest.raises(InputError, match=message):
        read_reports([reports[0], tmp_path / "x.json"])


def test_wrong_options_are_refused(reports, tmp_path, capsys):
    assert main(["compare", str(reports[0]), str(tmp_path / "none.json")]) == 1
    assert "none.json: cannot be read" in capsys.readouterr().err
    assert main(["compare", str(reports[0]), str(reports[0])]) == 1
    assert "is given twice" in capsys.readouterr().err
    assert main(["compare", str(reports[0])]) == 2
