"""YOLO's detection output without detections, and the activation of its dialect."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from fresh_dialects import used_by
from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top[0, 0].numpy()


V3 = """type: 'Yolov3DetectionOutput' yolov3_detection_output_param { num_classes: 2 num_box: 3 nms_threshold: 0.45
    confidence_threshold: %s biases: 10 biases: 14 biases: 23 biases: 27 biases: 37 biases: 58 biases: 81 biases: 82
    biases: 135 biases: 169 biases: 344 biases: 319 mask: 3 mask: 4 mask: 5 mask: 0 mask: 1 mask: 2
    anchors_scale: 32 anchors_scale: 16 mask_group_num: 2 }"""


def test_output_without_detections_is_a_row_of_minus_one_per_image(build: Build) -> None:
    maps = [torch.randn(2, 21, 2, 2), torch.randn(2, 21, 4, 4)]
    found = run(build("yolo", V3 % 1.5, *(m.shape for m in maps)), *maps)
    assert found.tolist() == [[image, -1, -1, -1, -1, -1, -1] for image in (0, 1)]


def test_the_layer_type_activates_the_dialect() -> None:
    assert used_by(f"layer {{ {V3 % 1} }}") == ["yolo"]


@pytest.mark.parametrize("box", [[2, 0.5, 0.5], [-1, 0.5, 0.5], [0, 1.0, 0.5], [0, 0.5, -0.1]], ids=str)
def test_true_boxes_outside_of_the_classes_or_the_map_are_refused(box: list[float], build: Build) -> None:
    settings = "region_loss_param { num_class: 2 num: 2 biases: [0.5, 1, 2, 1.5] }"
    layer = build("yolo", f"type: 'RegionLoss' {settings}", (1, 14, 3, 3), (1, 1, 1, 5))
    with pytest.raises(SpecError, match=r"expected a class below 2 and a center from 0 to below 1"):
        layer.run(torch.zeros(1, 14, 3, 3), torch.tensor([[[[*box, 0.2, 0.3]]]]))
