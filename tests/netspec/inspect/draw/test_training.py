"""Plots of trainings: panels, curves and ranges, and the formats of `netspec plot`."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from netspec.inspect.draw.training import training_figure
from netspec.inspect.logs.training_log import Curve, TrainingLog, read_log
from paths import GOLDEN

CAFFES = GOLDEN / "log" / "caffe_train.log"
Run_ = Callable[..., Any]


def titles(figure: Any) -> list[str]:
    return [axis.get_title("left") for axis in figure.axes]


def test_figure_has_a_panel_per_output_and_curves_per_training() -> None:
    run, other = read_log(CAFFES), read_log(CAFFES)
    other.tests[0]["accuracy"] = Curve([0, 25], [0.5, 0.75])
    figure = training_figure([run, other])
    assert titles(figure) == ["loss", "accuracy", "learning rate"]
    ids = [line.get_gid() for line in figure.axes[0].lines]
    assert ids == ["run0-raw", "run0-smooth", "run0-test", "run1-raw", "run1-smooth", "run1-test"]
    raw, test = figure.axes[0].lines[0], figure.axes[0].lines[2]
    assert list(raw.get_ydata()) == run.loss.values  # pyright: ignore[reportArgumentType]
    assert list(test.get_xdata()) == [0, 25, 50]  # pyright: ignore[reportArgumentType]
    assert [line.get_gid() for line in figure.axes[1].lines] == ["run1-test"]


def test_an_output_of_many_numbers_has_no_panel() -> None:
    run = TrainingLog("x", Curve([0], [1]))
    run.tests[0] = {f"p[{k}]": Curve([0], [1]) for k in range(100)}
    assert titles(training_figure([run])) == ["loss"]


def test_nan_losses_are_marked() -> None:
    figure = training_figure([TrainingLog("x", Curve([0, 1, 2], [1, float("nan"), float("inf")]))])
    (marks,) = [line for line in figure.axes[0].lines if line.get_gid() == "run0-nan"]
    assert list(marks.get_xdata()) == [1, 2]  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_plot_writes_png_and_svg(run: Run_) -> None:
    for ending in ("png", "svg"):
        result = run("plot", CAFFES, "--names", "<a> & $b_1$", "--out", f"x.{ending}")
        assert (result.status, result.err) == (0, "")
        assert "<a> & $b_1$: state done, iterations 60, last loss 0.0543485" in result.out
    assert cv2.imread("x.png") is not None
    texts = {text.text for text in ET.parse("x.svg").iter("{http://www.w3.org/2000/svg}text")}
    assert {"<a> & $b_1$", "loss", "learning rate", "iteration"} <= texts


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (("no.log", "--out", "x.png"), 1, "no.log: cannot be read: No such file or directory"),
        ((CAFFES, "--out", "x.jpg"), 1, "x.jpg: expected a name that ends in .png, .svg\n"),
        ((CAFFES, "--out", "no/x.png"), 1, "no/x.png: cannot be written: No such file or directory\n"),
        ((CAFFES, "--names", "a,b", "--out", "x.png"), 2, "found 2 --names and 1 logs"),
    ],
    ids=["missing_log", "format", "missing_folder", "names"],
)
def test_logs_that_cannot_be_drawn_are_refused(run: Run_, words: tuple[object, ...], status: int, said: str) -> None:
    result = run("plot", *words)
    assert result.status == status
    assert said in result.err
    assert not Path("x.png").exists()
