"""The pictures of the report: nothing drawn over the curves, and the caller's matplotlib left as it is."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.legend import Legend

from given_scores import GivenScores
from loopclosure.evaluate import Evaluation, evaluate
from loopclosure.places.datasets import DataSet
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.truth import Exclusion, sequence_truth
from loopclosure.report.plots import curves, matches, matrices
from paths import ROOT

FRAMES = 40
LONG_NAME = "a net with a name of many words, as people give them when they compare settings (euclidean, whitened)"


def evaluation_of(names: list[str]) -> Evaluation:
    """Two laps of 20 places, scored at random."""
    rng = np.random.default_rng(0)
    hard = np.eye(FRAMES, k=-FRAMES // 2, dtype=bool)
    data = DataSet(
        "synthetic",
        ImageSequence.of_files([Path(f"{i}.png") for i in range(FRAMES)]),
        None,
        sequence_truth(hard, Exclusion(5), "the rule"),
    )
    return evaluate(data, [(name, GivenScores(hard + rng.normal(size=hard.shape))) for name in names])


def legend_of(axis: Axes) -> Legend:
    legend = axis.get_legend()
    assert legend is not None
    return legend


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3, 10, 20])
def test_legends_do_not_cover_curves(count):
    figure = curves(evaluation_of([LONG_NAME, *(f"method {i}" for i in range(1, count))]))
    figure.draw_without_rendering()
    axes = [axis.get_window_extent() for axis in figure.axes]
    legends = [legend_of(axis).get_window_extent() for axis in figure.axes]
    labels = [axis.xaxis.get_tightbbox() for axis in figure.axes]
    notes = [text.get_window_extent() for text in figure.texts]
    for legend in legends:
        for other in (*axes, *labels, *notes):
            assert other is not None
            assert not legend.overlaps(other)
        assert figure.bbox.x0 <= legend.x0 < legend.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= legend.y0 < legend.y1 <= figure.bbox.y1
    assert not legends[0].overlaps(legends[1])
    for box in axes:  # the curves keep their size however many there are
        assert box.height / figure.dpi == pytest.approx(3.25, abs=0.25)
        assert box.width / figure.dpi > 3.5


@pytest.mark.slow
def test_every_curve_of_twenty_looks_different():
    axis = curves(evaluation_of([str(i) for i in range(20)])).axes[0]
    lines = legend_of(axis).get_lines()
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 20


@pytest.mark.slow
def test_a_dollar_sign_in_a_name_is_text():
    evaluation = evaluation_of([r"$\nonsense{$", "_hidden"])
    for draw in (curves, matrices, matches):
        draw(evaluation).draw_without_rendering()
    labels = [text.get_text() for text in legend_of(curves(evaluation).axes[0]).get_texts()]
    assert [label.split()[1] for label in labels] == [r"$\nonsense{$", "_hidden"]


@pytest.mark.slow
def test_the_backend_of_the_caller_is_kept(two_laps, tmp_path):
    code = f"""
import sys, matplotlib
matplotlib.use("svg")
import loopclosure.report.table_one
from loopclosure.cli import main
assert main(["evaluate", {str(two_laps)!r}, "--method", "thumbnails", "--out", {str(tmp_path)!r}]) == 0
assert matplotlib.get_backend() == "svg", matplotlib.get_backend()
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
