"""Dialects rcnn and rfcn: pooling of regions and proposals in cases computed by hand, and refused regions."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec import use_dialect
from netspec.dialects.rcnn.proposals import base_anchors, half_up
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Layer
from netspec.net.build import build_net
from netspec.proto.text import parse_net_text

pytestmark = pytest.mark.slow

Build = Callable[..., Layer]


def test_the_first_of_equal_pixels_gets_the_gradient_of_roi_pooling(build: Build) -> None:
    maps = torch.zeros(1, 1, 3, 4)
    maps[0, 0, 1, 2] = maps[0, 0, 2, 1] = 1
    maps.requires_grad_()
    regions = torch.tensor([[0.0, 0, 0, 3, 2], [0, 2, 1, 3, 2], [0, 0, 0, 1, 1]])
    layer = build("rcnn", "type: 'ROIPooling' roi_pooling_param { pooled_h: 1 pooled_w: 1 }", maps.shape, (3, 5))
    (top,) = layer.run(maps, regions)
    assert top.flatten().tolist() == [1, 1, 0]
    top.sum().backward()
    assert maps.grad is not None
    assert maps.grad[0, 0].tolist() == [[1, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 0]]


@pytest.mark.parametrize(("dialect", "kind"), [("rcnn", "ROIPooling"), ("rfcn", "PSROIPooling")])
def test_regions_of_a_missing_image_are_refused(build: Build, dialect: str, kind: str) -> None:
    settings = {
        "ROIPooling": "roi_pooling_param { pooled_h: 1 pooled_w: 1 }",
        "PSROIPooling": "psroi_pooling_param { spatial_scale: 1 output_dim: 1 group_size: 1 }",
    }
    layer = build(dialect, f"type: '{kind}' {settings[kind]}", (2, 1, 3, 3), (1, 5))
    with pytest.raises(SpecError, match="found a region in image 2, expected 0 to 1"):
        layer.run(torch.zeros(2, 1, 3, 3), torch.tensor([[2.0, 0, 0, 1, 1]]))


def test_fields_read_by_a_dialects_layers_get_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    use_dialect("rcnn")
    use_dialect("filters")
    text = """
      layer { name: 'in' type: 'Input' top: 'x' input_param { shape { dim: 4 } } }
      layer { name: 'd' type: 'Dropout' bottom: 'x' top: 'y' dropout_param { scale_train: false } }
      layer { name: 'r' type: 'ReLU' bottom: 'y' top: 'z' roi_pooling_param { pooled_h: 2 } }
    """
    build_net(*parse_net_text(text, "f"), BuildOptions())
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "roi_pooling_param has no effect: a layer of type ReLU does not read it" in warning


# Proposal

# What py-faster-rcnn's generate_anchors gives for its defaults, as its own comments list them (x1, y1, x2, y2).
ANCHORS = [
    [-84, -40, 99, 55],
    [-176, -88, 191, 103],
    [-360, -184, 375, 199],
    [-56, -56, 71, 71],
    [-120, -120, 135, 135],
    [-248, -248, 263, 263],
    [-36, -80, 51, 95],
    [-80, -168, 95, 183],
    [-168, -344, 183, 359],
]
SETTINGS = "ratio: 1 scale: 1 feat_stride: 10 base_size: 10 min_size: 4 nms_thresh: 0.3"
ONE = f"type: 'Proposal' proposal_param {{ {SETTINGS} %s }}"


def test_anchors_equal_those_of_faster_rcnn() -> None:
    np.testing.assert_array_equal(base_anchors(16, (0.5, 1, 2), (8, 16, 32)), ANCHORS)


def test_half_a_pixel_is_rounded_to_even_in_python_and_up_in_the_forks_of_cpp() -> None:
    assert base_anchors(16, (1.1,), (8,)).tolist() == [[-52, -56, 67, 71]]  # 15 x 1.1 = 16.5
    assert base_anchors(16, (1.1,), (8,), half_up).tolist() == [[-52, -60, 67, 75]]


def proposals(build: Build, scores: list[list[float]], more: str = "", **moves: float) -> tuple[np.ndarray, np.ndarray]:
    """Regions and scores for a map of one anchor per pixel, 10 x 10 pixels each, in an image of 25 x 30."""
    objects = torch.tensor(scores, dtype=torch.float32)[None, None]
    deltas = torch.zeros(1, 4, *objects.shape[2:])
    for name, number in moves.items():
        deltas[0, ("dx", "dy", "dw", "dh").index(name), 0, 0] = number
    layer = build("rcnn", ONE % more, (1, 2, *objects.shape[2:]), tuple(deltas.shape), (1, 3), tops=2)
    regions, found = layer.run(torch.cat([1 - objects, objects], 1), deltas, torch.tensor([[25.0, 30.0, 1.0]]))
    return regions.numpy(), found.numpy()


def test_proposals_are_sorted_by_score_and_clipped_to_the_image(build: Build) -> None:
    regions, scores = proposals(build, [[0.5, 0.75, 0.125], [0.25, 1, 0.625], [0.375, 0.0625, 0.875]])
    assert scores.tolist() == [1, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0625]
    # An anchor of 10 to 19 becomes 10 to 20: its size counts both corners, the box made of it does not.
    assert regions[0].tolist() == [0, 10, 10, 20, 20]
    assert regions[1].tolist() == [0, 20, 20, 29, 24]
    assert regions[2].tolist() == [0, 10, 0, 20, 10]
    assert len(proposals(build, [[0.5, 0.75]], "post_nms_topn: 1")[0]) == 1


def test_proposals_are_moved_and_scaled_by_the_predicted_deltas(build: Build) -> None:
    regions, _ = proposals(build, [[1, 0]], dx=0.5, dy=0.2, dw=math.log(2), dh=math.log(0.5))
    # The anchor is 10 x 10 around (5, 5): around (10, 7), 20 x 5.
    np.testing.assert_allclose(regions[0], [0, 0, 4.5, 20, 9.5], atol=1e-5)


def test_only_the_best_of_overlapping_proposals_is_kept(build: Build) -> None:
    # Moved 5 pixels, the first is (5, 0, 15, 10) and shares 6 x 11 pixels with (10, 0, 20, 10): of 176, 0.375.
    regions, scores = proposals(build, [[0.5, 0.75]], dx=0.5)
    assert scores.tolist() == [0.75]
    assert len(regions) == 1
    assert len(proposals(build, [[0.5, 0.75]], "pre_nms_topn: 1")[0]) == 1


def test_proposals_below_min_size_have_score_zero(build: Build) -> None:
    _, scores = proposals(build, [[1, 0.5]], dw=math.log(0.25))
    assert scores.tolist() == [0.5, 0]


def test_regions_of_four_columns_are_refused_in_the_forward_pass(build: Build) -> None:
    layer = build(
        "rcnn", "name: 'p' type: 'ROIPooling' roi_pooling_param { pooled_w: 2 pooled_h: 2 }", (1, 3, 8, 8), (1, 4)
    )
    with pytest.raises(SpecError, match=r"found regions of shape \(1, 4\), expected \(R, 5\)"):
        layer.run(torch.zeros(1, 3, 8, 8), torch.zeros(1, 4))
