"""SSD's DetectionEvaluate in special cases; its golden cases are in test_ssd_golden.py."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec import load_solver
from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]

TRUTH = [  # image, label, instance, xmin, ymin, xmax, ymax, difficult
    (0, 1, 0, 0.1, 0.1, 0.5, 0.5, 0),
    (0, 1, 1, 0.6, 0.6, 0.9, 0.9, 1),
    (0, 2, 0, 0.1, 0.1, 0.5, 0.5, 0),
    (1, 2, 0, 0.2, 0.2, 0.6, 0.6, 0),
]
FOUND = [  # image, label, confidence, box
    (0, 1, 0.7, 0.1, 0.1, 0.5, 0.5),  # taken by the next, which is more confident
    (0, 1, 0.9, 0.1, 0.1, 0.5, 0.45),
    (0, 1, 0.8, 0.6, 0.6, 0.9, 0.9),  # a difficult one
    (0, 2, 0.6, 0.7, 0.7, 0.9, 0.9),
    (1, 1, 0.5, 0.2, 0.2, 0.6, 0.6),  # no box of this label
    (1, 2, 0.4, 0.2, 0.2, 0.6, 0.6),
    (2, -1, -1, -1, -1, -1, -1),
]


def evaluate(build: Build, settings: str = "") -> np.ndarray:
    bottoms = [torch.tensor([[rows]], dtype=torch.float32) for rows in (FOUND, TRUTH)]
    text = f"type: 'DetectionEvaluate' detection_evaluate_param {{ num_classes: 3 {settings} }}"
    layer = build("ssd", text, *(bottom.shape for bottom in bottoms))
    (top,) = layer.run(*bottoms)
    assert layer.top_shapes == [tuple(top.shape)]
    return top[0, 0].numpy()


def test_each_detection_is_a_true_or_false_positive_or_not_counted(build: Build) -> None:
    expected = [
        (-1, 1, 1, -1, -1),
        (-1, 2, 2, -1, -1),
        (0, 1, 0.9, 1, 0),
        (0, 1, 0.8, 0, 0),
        (0, 1, 0.7, 0, 1),
        (0, 2, 0.6, 0, 1),
        (1, 1, 0.5, 0, 1),
        (1, 2, 0.4, 1, 0),
    ]
    np.testing.assert_allclose(evaluate(build, "evaluate_difficult_gt: false"), expected)
    expected[0], expected[3] = (-1, 1, 2, -1, -1), (0, 1, 0.8, 1, 0)
    np.testing.assert_allclose(evaluate(build), expected)


def test_a_line_of_name_size_file_without_a_width_is_refused(build: Build, tmp_path: Path) -> None:
    (tmp_path / "sizes.txt").write_text("a 10\n")
    with pytest.raises(SpecError, match=r'sizes\.txt:1:1: found "a 10", expected a name, a height and a width'):
        evaluate(build, f"name_size_file: '{tmp_path / 'sizes.txt'}'")


def test_resuming_continues_at_the_next_line_of_name_size_file(build: Build, tmp_path: Path) -> None:
    (tmp_path / "sizes.txt").write_text("a 10 20\nb 1 1\n")
    settings = f"num_classes: 3 name_size_file: '{tmp_path / 'sizes.txt'}'"
    text = f"type: 'DetectionEvaluate' detection_evaluate_param {{ {settings} }}"
    bottoms = [torch.tensor([[rows]], dtype=torch.float32) for rows in (FOUND[:1], TRUTH)]
    first, second = (build("ssd", text, *(bottom.shape for bottom in bottoms)) for _ in range(2))
    first.run(*bottoms)
    second.restore(first.running_state())
    assert second.running_state() == {"image": 1}
    with pytest.raises(SpecError, match="found image -1 to go on from"):
        second.restore({"image": -1})


def test_a_test_of_no_batch_has_no_score(tmp_path: Path) -> None:
    net = """
    layer { name: "found" type: "DummyData" top: "found" top: "true" include { phase: TEST }
      dummy_data_param { shape { dim: [1, 1, 1, 7] } shape { dim: [1, 1, 1, 8] } } }
    layer { name: "map" type: "DetectionEvaluate" bottom: "found" bottom: "true" top: "map" include { phase: TEST }
      detection_evaluate_param { num_classes: 3 } }
    layer { name: "x" type: "DummyData" top: "x" top: "t" include { phase: TRAIN }
      dummy_data_param { shape { dim: [1, 1] } shape { dim: [1, 1] } } }
    layer { name: "loss" type: "EuclideanLoss" bottom: "x" bottom: "t" include { phase: TRAIN } }
    """
    (tmp_path / "net.prototxt").write_text(net)
    settings = "base_lr: 0 lr_policy: 'fixed' test_iter: 0 test_interval: 1 test_compute_loss: true"
    (tmp_path / "solver.prototxt").write_text(f"net: '{tmp_path}/net.prototxt' {settings}")
    solver = load_solver(tmp_path / "solver.prototxt")
    solver.step(2)
    assert solver.iteration == 2
