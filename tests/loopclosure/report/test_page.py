"""The report is self-contained, the same in every format, and states the rule of its truth."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from given_scores import GivenScores
from loopclosure.evaluation import Judgment, Outcome, evaluate
from loopclosure.methods.named import named_methods
from loopclosure.places.datasets import load_sequence, load_traverses
from loopclosure.places.sequences import read_sequence
from loopclosure.places.truth import Truth
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH
from loopclosure.report.files import measures_text
from loopclosure.report.page import write_report
from loopclosure.report.plots import best_true_references, decisions

pytestmark = pytest.mark.slow

COSTS = {"vocabulary": 3.0, "looking": 0.4}, ["a <note>"], ("vocabulary",)  # seconds, notes, training stages


class Tags(HTMLParser):
    """What a browser would find in a page: tags, attributes, the schemes of sources, and texts."""

    def __init__(self):
        super().__init__()
        self.names, self.attributes, self.sources, self.texts = set(), set(), set(), []

    def handle_starttag(self, tag, attributes):
        self.names.add(tag)
        self.attributes |= {name for name, _ in attributes}
        self.sources |= {value.partition(":")[0] for name, value in attributes if name == "src"}

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def evaluation(two_laps, two_laps_features):
    rng = np.random.default_rng(0)
    methods = [
        *named_methods([f"A net & more=features:{two_laps_features}"]),
        ("<noise>", GivenScores(rng.normal(size=(40, 40)), *COSTS)),
        ("silent", GivenScores(np.full((40, 40), np.nan), *COSTS)),
    ]
    return evaluate(load_sequence(read_sequence(two_laps, "tum")), methods, train="nothing")


@pytest.fixture(scope="module")
def folder(evaluation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "made" / "here"
    assert write_report(evaluation, folder, "A title", "loopclosure evaluate --x") == folder / "report.html"
    return folder


def test_the_page_is_self_contained_and_names_its_rule(evaluation, folder):
    page = (folder / "report.html").read_text()
    assert set(re.findall(r'(?:src|href)="([^:]*:)', page)) == {"data:"}
    assert "http" not in page
    assert page.count("less than 10 s apart excluded") >= 2
    for words in (ALL_PAIRS, BEST_MATCH, "A net &amp; more", "&lt;noise&gt;", "a &lt;note&gt;", "A title"):
        assert words in page
    assert "<noise>" not in page
    assert "loopclosure evaluate --x" in page


def test_malicious_names_are_escaped(two_laps, tmp_path):
    evil = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>{{ 7 * 7 }}{% raw %}$\\frac{"
    data = load_sequence(read_sequence(two_laps, "tum"))
    data = replace(data, name=evil, notes=[evil], truth=replace(data.truth, description=evil))
    scores = np.zeros((40, 40))
    methods = [(evil, GivenScores(scores, {evil: 1.0}, [evil])), (evil.upper(), GivenScores(scores, *COSTS))]
    evaluation = evaluate(data, methods, train=evil)
    page = write_report(evaluation, tmp_path, evil, f"loopclosure evaluate --title {evil}").read_text()
    reader = Tags()
    reader.feed(page)
    assert "script" not in reader.names
    assert not any(name.startswith("on") for name in reader.attributes)
    assert reader.sources == {"data"}
    assert {evil, f"loopclosure evaluate --title {evil}"} <= set(reader.texts)
    assert reader.texts.count(evil) >= 8  # title, heading, training, note of the data, name of the method, stage, note


def test_plots_are_written_and_embedded(folder):
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    for name in ("precision_recall", "matrices", "matches", "map"):
        image = cv2.imread(str(folder / f"{name}.png"))
        assert image is not None, name
        assert image.shape[0] > 300
        assert image.std() > 5


def test_pairs_are_shown_for_each_method(folder):
    page = (folder / "report.html").read_text()
    sections = page[page.index("<h2>Pairs</h2>") : page.index("<h2>Settings</h2>")].split("<h3>")[1:]
    net, noise, silent = sections
    assert net.count('class="pair found"') == 4
    assert noise.count('class="pair false"') == 4
    assert silent.count("right, highest score: none") == 1
    assert silent.count("no score") >= 4


def test_figures_are_the_same_in_json_and_text(evaluation, folder):
    outcome = evaluation.outcomes[1]
    summary = json.loads((folder / "report.json").read_text())
    of_json = summary["methods"][1]["figures"]
    for curve in (outcome.pairs, outcome.best):
        expected = curve.average_precision
        assert of_json[curve.convention]["average precision"] == pytest.approx(expected, abs=1e-6)
        assert f"{expected:.3f}" in measures_text(evaluation)
    assert summary["truth_and_exclusion"] == evaluation.data.truth.description
    assert summary["true_pairs"] == evaluation.data.truth.positives
    assert summary["queries_with_a_loop"] == 20


def test_decisions_at_the_best_f1(evaluation):
    truth = evaluation.data.truth
    found, false, missed = decisions(evaluation.outcomes[0], truth)
    assert found.tolist() == list(range(20, 40))
    assert false.tolist() == []
    assert missed.tolist() == []
    assert best_true_references(evaluation.outcomes[0], truth, found).tolist() == list(range(20))
    _, false, missed = decisions(evaluation.outcomes[2], truth)
    assert false.tolist() == []
    assert missed.tolist() == list(range(20, 40))


def test_decisions_of_a_method_that_decides_itself(evaluation):
    """Its wrong loops are drawn, however low their scores; the best threshold, chosen with the truth, is not used."""
    hard = np.zeros((12, 12), bool)
    hard[range(6), range(6)] = True
    truth = Truth(hard, hard, np.ones_like(hard), "by hand")
    scores = np.full(hard.shape, np.nan)
    scores[range(6), range(6)] = np.linspace(0.9, 0.8, 6)
    scores[7, 2], scores[8, 3] = 0.2, 0.1
    for answer, wrong in (("8 accepted", [7, 8]), ("", [])):
        judged = Judgment.of(scores, truth)
        found, false, _ = decisions(Outcome("auto", scores, judged, None, {}, (), [], answer=answer), truth)
        assert (found.tolist(), false.tolist()) == ([*range(6)], wrong)


def test_two_traverses_without_positions(tmp_path):
    for folder in ("night", "day"):
        (tmp_path / folder).mkdir()
        for i in range(6):
            cv2.imwrite(str(tmp_path / folder / f"{i}.png"), np.full((30 + i, 40, 3), 40 * i, np.uint8))
    data = load_traverses(tmp_path / "night", tmp_path / "day")
    evaluation = evaluate(data, [("one", GivenScores(-np.abs(np.subtract.outer(np.arange(6.0), np.arange(6.0)))))])
    page = write_report(evaluation, tmp_path / "out").read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not (tmp_path / "out" / "map.png").exists()
    assert "6 queries, 6 references" in page


def test_large_matrices_are_reduced_without_losing_loops():
    from loopclosure.report.plots import _greatest_of_blocks

    values = np.zeros((1001, 900))
    values[700, 333] = 1.0
    values[5, :] = np.nan
    small = _greatest_of_blocks(values, 3)
    assert small.shape == (334, 300)
    assert np.argwhere(small == 1.0).tolist() == [[233, 111]]
    assert not np.isnan(small).any()
