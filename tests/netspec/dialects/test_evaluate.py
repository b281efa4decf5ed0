"""SSD's DetectionEvaluate, its average precision, and a small SSD that is trained and tested by commands."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from annotated_records import annotated, write
from netspec import load_solver, use_dialect
from netspec.cli import main
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


def evaluate(build: Build, settings: str = "", found: list[tuple[float, ...]] = FOUND) -> np.ndarray:
    bottoms = [torch.tensor([[rows]], dtype=torch.float32) for rows in (found, TRUTH)]
    classes = "" if "num_classes" in settings else "num_classes: 3"
    text = f"type: 'DetectionEvaluate' detection_evaluate_param {{ {classes} {settings} }}"
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


def test_overlap_threshold_separates_true_from_false_positives(build: Build) -> None:
    found = [(0, 1, 0.9, 0.1, 0.1, 0.5, 0.45)]  # overlap 0.875
    assert evaluate(build, "overlap_threshold: 0.87", found)[2, 3:].tolist() == [1, 0]
    assert evaluate(build, "overlap_threshold: 0.88", found)[2, 3:].tolist() == [0, 1]


def test_boxes_are_compared_in_whole_pixels_with_name_size_file(build: Build, tmp_path: Path) -> None:
    (tmp_path / "sizes.txt").write_text("a 10 20\nb 10 20\nc 10 20\n")
    settings = f"name_size_file: '{tmp_path / 'sizes.txt'}' overlap_threshold: "
    found = [(0, 1, 0.9, 0.1, 0.1, 0.5, 0.4)]  # (8 + 1) (3 + 1) of (8 + 1) (4 + 1) pixels
    assert evaluate(build, settings + "0.79", found)[2, 3:].tolist() == [1, 0]
    assert evaluate(build, settings + "0.81", found)[2, 3:].tolist() == [0, 1]
    (tmp_path / "sizes.txt").write_text("a 10\n")
    with pytest.raises(SpecError, match=r'sizes\.txt:1:1: found "a 10", expected a name, a height and a width'):
        evaluate(build, settings + "0.5")


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


def test_average_precision_of_each_version_equals_hand_computed_values() -> None:
    use_dialect("ssd")
    from netspec.dialects.ssd.evaluate import average_precision

    found = np.array([(0.9, 1, 0), (0.8, 0, 1), (0.7, 1, 0), (0.6, 0, 1)])  # of 4: recall 1/4 at 1, 1/2 at 2/3
    assert average_precision(found, 4, "Integral") == pytest.approx(1 / 4 * 1 + 1 / 4 * 2 / 3)
    assert average_precision(found, 4, "MaxIntegral") == pytest.approx(1 / 4 * 1 + 1 / 4 * 2 / 3)
    assert average_precision(found, 4, "11point") == pytest.approx((3 * 1 + 3 * 2 / 3) / 11)
    found = np.array([(0.9, 0, 1), (0.8, 1, 0), (0.7, 1, 0)])
    assert average_precision(found, 2, "Integral") == pytest.approx(1 / 2 * 1 / 2 + 1 / 2 * 2 / 3)
    assert average_precision(found, 2, "MaxIntegral") == pytest.approx(2 / 3)
    assert average_precision(found[:0], 2) == average_precision(found, 0) == 0


NET = """
name: "small_ssd"
layer {{ name: "data" type: "AnnotatedData" top: "data" top: "label" include {{ phase: {phase} }}
  transform_param {{ {mirror} mean_value: 100 mean_value: 100 mean_value: 100 scale: 0.01
    resize_param {{ height: 32 width: 32 }} emit_constraint {{ emit_type: CENTER }} }}
  data_param {{ source: "{source}" batch_size: 8 backend: LMDB }}
  annotated_data_param {{ {samplers} label_map_file: "labelmap.prototxt" }} }}
layer {{ name: "conv1" type: "Convolution" bottom: "data" top: "conv1"
  convolution_param {{ num_output: 8 kernel_size: 5 stride: 4 pad: 2 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "relu1" type: "ReLU" bottom: "conv1" top: "conv1" }}
layer {{ name: "conv2" type: "Convolution" bottom: "conv1" top: "conv2"
  convolution_param {{ num_output: 16 kernel_size: 3 stride: 2 pad: 1 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "relu2" type: "ReLU" bottom: "conv2" top: "conv2" }}
layer {{ name: "loc" type: "Convolution" bottom: "conv2" top: "loc"
  convolution_param {{ num_output: 4 kernel_size: 3 pad: 1 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "loc_perm" type: "Permute" bottom: "loc" top: "loc_perm"
  permute_param {{ order: 0 order: 2 order: 3 order: 1 }} }}
layer {{ name: "mbox_loc" type: "Flatten" bottom: "loc_perm" top: "mbox_loc" }}
layer {{ name: "conf" type: "Convolution" bottom: "conv2" top: "conf"
  convolution_param {{ num_output: 2 kernel_size: 3 pad: 1 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "conf_perm" type: "Permute" bottom: "conf" top: "conf_perm"
  permute_param {{ order: 0 order: 2 order: 3 order: 1 }} }}
layer {{ name: "mbox_conf" type: "Flatten" bottom: "conf_perm" top: "mbox_conf" }}
layer {{ name: "mbox_priorbox" type: "PriorBox" bottom: "conv2" bottom: "data" top: "mbox_priorbox"
  prior_box_param {{ min_size: 16 clip: false variance: 0.1 variance: 0.1 variance: 0.2 variance: 0.2 }} }}
{end}
"""
TRAIN_END = """
layer { name: "mbox_loss" type: "MultiBoxLoss" bottom: "mbox_loc" bottom: "mbox_conf" bottom: "mbox_priorbox"
  bottom: "label" top: "mbox_loss" include { phase: TRAIN } loss_param { normalization: VALID }
  multibox_loss_param { num_classes: 2 overlap_threshold: 0.4 code_type: CENTER_SIZE neg_overlap: 0.4 } }
"""
TEST_END = """
layer { name: "mbox_conf_reshape" type: "Reshape" bottom: "mbox_conf" top: "mbox_conf_reshape"
  reshape_param { shape { dim: 0 dim: -1 dim: 2 } } }
layer { name: "mbox_conf_softmax" type: "Softmax" bottom: "mbox_conf_reshape" top: "mbox_conf_softmax"
  softmax_param { axis: 2 } }
layer { name: "mbox_conf_flatten" type: "Flatten" bottom: "mbox_conf_softmax" top: "mbox_conf_flatten" }
layer { name: "detection_out" type: "DetectionOutput" bottom: "mbox_loc" bottom: "mbox_conf_flatten"
  bottom: "mbox_priorbox" top: "detection_out" include { phase: TEST }
  detection_output_param { num_classes: 2 nms_param { nms_threshold: 0.45 top_k: 400 } code_type: CENTER_SIZE
    keep_top_k: 20 confidence_threshold: 0.01 } }
layer { name: "detection_eval" type: "DetectionEvaluate" bottom: "detection_out" bottom: "label" top: "detection_eval"
  include { phase: TEST }
  detection_evaluate_param { num_classes: 2 overlap_threshold: 0.5 evaluate_difficult_gt: false } }
"""
SOLVER = """
train_net: "train.prototxt" test_net: "test.prototxt" test_iter: 3 test_interval: 80 max_iter: 80 display: 40
base_lr: 0.02 momentum: 0.9 lr_policy: "fixed" random_seed: 3 solver_mode: CPU snapshot_prefix: "ssd"
eval_type: "detection" ap_version: "11point" test_initialization: true show_per_class_result: true
"""


@pytest.mark.slow
def test_a_small_ssd_learns_to_find_squares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Train and test prototxts in the form of SSD's, over one database; the score is the mean average precision."""
    use_dialect("ssd")
    chance = np.random.default_rng(0)
    records = []
    for _ in range(24):
        image = chance.integers(60, 140, (40, 60, 3), np.uint8)
        x, y = chance.integers(0, 35), chance.integers(0, 18)
        image[y : y + 20, x : x + 25] = 250
        records.append(annotated(image, [(1, (x / 60, y / 40, (x + 25) / 60, (y + 20) / 40), False)]))
    samplers = """batch_sampler { max_sample: 1 max_trials: 1 }
        batch_sampler { sampler { min_scale: 0.8 max_scale: 1 }
                        sample_constraint { min_jaccard_overlap: 0.1 } max_sample: 1 max_trials: 5 }"""
    parts = {"source": write(tmp_path, *records)}
    train = NET.format(phase="TRAIN", mirror="mirror: true", samplers=samplers, end=TRAIN_END, **parts)
    (tmp_path / "train.prototxt").write_text(train)
    (tmp_path / "test.prototxt").write_text(NET.format(phase="TEST", mirror="", samplers="", end=TEST_END, **parts))
    (tmp_path / "solver.prototxt").write_text(SOLVER)
    monkeypatch.chdir(tmp_path)
    assert main(["check", "train.prototxt", "--plugin", "ssd", "--phase", "TRAIN"]) == 0
    assert main(["check", "test.prototxt", "--plugin", "ssd"]) == 0
    assert main(["train", "--solver", "solver.prototxt", "--plugin", "ssd", "--scores", "scores.json"]) == 0
    log = capsys.readouterr().err
    assert "has no effect" not in log
    assert "class1: " in log
    first, last = (test["outputs"]["detection_eval"] for test in json.loads(Path("scores.json").read_text())["tests"])
    assert len(first) == len(last) == 1
    assert first[0] < 0.3 < 0.8 < last[0] <= 1
    weights = ["--weights", "ssd_iter_80.caffemodel", "--iterations", "3", "--plugin", "ssd"]
    assert main(["test", "--model", "test.prototxt", *weights]) == 0
    log = capsys.readouterr().err
    assert "caffe.cpp:321] detection_eval = 1\n" in log
    assert "Batch 0, detection_eval" not in log
