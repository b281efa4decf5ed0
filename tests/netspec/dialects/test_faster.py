"""Faster R-CNN's Python layers, built in: compared with plain loops, and a training whose losses fall."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

import netspec
import netspec.pycaffe as caffe
from netspec.dialects.rcnn import faster
from netspec.dialects.rcnn.faster import settings
from netspec.dialects.rcnn.proposals import all_anchors, base_anchors
from netspec.errors import SpecError
from netspec.layers import Layer
from netspec.net.build import build_net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]

PYTHON = "type: 'Python' python_param {{ module: '{}' layer: '{}' param_str: \"{}\" }}"
ANCHORS = PYTHON.format("rpn.anchor_target_layer", "AnchorTargetLayer", "'feat_stride': 16")
REGIONS = PYTHON.format("rpn.proposal_target_layer", "ProposalTargetLayer", "'num_classes': 4")
TRUTH = torch.tensor([[20.0, 30, 120, 150, 2], [150, 40, 400, 300, 3], [10, 10, 40, 40, 1]])
IMAGE = torch.tensor([[320.0, 480, 1.5]])


def iou(a: np.ndarray, b: np.ndarray) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0]) + 1
    height = min(a[3], b[3]) - max(a[1], b[1]) + 1
    if width <= 0 or height <= 0:
        return 0.0
    area, other = ((c[2] - c[0] + 1) * (c[3] - c[1] + 1) for c in (a, b))
    return width * height / (area + other - width * height)


def apply_delta(box: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Return the box that a target describes, as proposals are computed from predictions."""
    sizes = box[2:] - box[:2] + 1
    center = box[:2] + sizes / 2 + delta[:2] * sizes
    half = np.exp(delta[2:]) * sizes / 2
    return np.array([*(center - half), *(center + half - 1)])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("'feat_stride': 16", {"feat_stride": 16}),
        ("'feat_stride': 16 \n'scales': !!python/tuple [4, 8.5]", {"feat_stride": 16, "scales": [4, 8.5]}),
        ("{'feat_stride': 8, 'scales': (2, 4), 'allowed_border': 0}", {"scales": [2, 4], "allowed_border": 0}),
        ("feat_stride: 16\n", {"feat_stride": 16}),
    ],
    ids=["one_line", "tuple_tag", "braces", "without_quotes"],
)
def test_param_str_is_read(build: Build, text: str, found: dict[str, object]) -> None:
    escaped = text.replace("\n", "\\n")
    param = PYTHON.format("rpn.anchor_target_layer", "AnchorTargetLayer", escaped)
    layer = build("rcnn", param, (1, 18, 20, 30), (3, 5), (1, 3), tops=4)
    assert found.items() <= settings(layer, "feat_stride", "scales", "ratios", "allowed_border").items()


def test_ratios_determine_the_anchors_and_an_unknown_setting_is_refused(build: Build) -> None:
    text = ANCHORS.replace("'feat_stride': 16", "'feat_stride': 16, 'ratios': [0.5, 1]")
    layer = build("rcnn", text, (1, 12, 20, 30), (3, 5), (1, 3), tops=4)
    anchors: Any = layer.anchors
    assert len(anchors) == 6
    with pytest.raises(SpecError, match="param_str has ration, which is not read here; it may have"):
        build("rcnn", text.replace("ratios", "ration"), (1, 18, 20, 30), (3, 5), (1, 3), tops=4)


def test_anchor_targets_equal_plain_loops(build: Build) -> None:
    scores = torch.zeros(1, 18, 20, 30)
    layer = build("rcnn", ANCHORS, scores.shape, TRUTH.shape, IMAGE.shape, phase=TRAIN, tops=4)
    labels, moves, inner, outer = (top.numpy() for top in layer.run(scores, TRUTH, IMAGE))
    assert labels.shape == (1, 1, 9 * 20, 30)
    by_anchor = labels.reshape(9, 20, 30).transpose(1, 2, 0).reshape(-1)
    deltas, inside, outside = (
        a.reshape(9, 4, 20, 30).transpose(2, 3, 0, 1).reshape(-1, 4) for a in (moves, inner, outer)
    )
    anchors = all_anchors(base_anchors(16, (0.5, 1, 2), (8, 16, 32)), 16, 20, 30)
    truth = TRUTH.numpy()
    table = np.array([[iou(anchor, true) for true in truth] for anchor in anchors])
    within = (anchors[:, :2] >= 0).all(1) & (anchors[:, 2] < 480) & (anchors[:, 3] < 320)
    best = np.where(within[:, None], table, -1).max(axis=0)
    objects = within & ((table.max(axis=1) >= 0.7) | np.isclose(table, best).any(axis=1))
    assert 3 <= objects.sum() <= 128
    assert set(np.flatnonzero(by_anchor == 1)) == set(np.flatnonzero(objects))
    assert (by_anchor >= 0).sum() == min(256, int(objects.sum() + (within & ~objects & (table.max(1) < 0.3)).sum()))
    assert (by_anchor[~within] == -1).all()
    assert (table[by_anchor == 0].max(axis=1) < 0.3).all()
    for k in np.flatnonzero(objects):
        np.testing.assert_allclose(apply_delta(anchors[k], deltas[k]), truth[table[k].argmax(), :4], atol=1e-3)
    assert (inside == (by_anchor == 1)[:, None]).all()
    np.testing.assert_allclose(outside, (by_anchor >= 0)[:, None] / np.float32((by_anchor >= 0).sum()) * np.ones(4))


def test_targets_without_true_boxes_are_background(build: Build) -> None:
    scores, none = torch.zeros(1, 18, 20, 30), torch.zeros(0, 5)
    layer = build("rcnn", ANCHORS, scores.shape, (3, 5), IMAGE.shape, phase=TRAIN, tops=4)
    labels = layer.run(scores, none, IMAGE)[0]
    assert (labels == 0).sum() == 256
    assert not (labels == 1).any()
    layer = build("rcnn", REGIONS, (5, 5), (3, 5), phase=TRAIN, tops=5)
    regions, labels, *_ = layer.run(torch.tensor([[0.0, 0, 0, 9, 9]]), none)
    assert regions.shape == (1, 5)
    assert labels.tolist() == [0]


def test_proposal_targets_equal_plain_loops(build: Build) -> None:
    rng = np.random.default_rng(0)
    near = TRUTH[rng.integers(0, 3, 300), :4] + torch.from_numpy(rng.uniform(-30, 30, (300, 4)))
    low, high = torch.minimum(near[:, :2], near[:, 2:]), torch.maximum(near[:, :2], near[:, 2:])
    proposals = torch.cat([torch.zeros(300, 1), low, high], dim=1).float()
    layer = build("rcnn", REGIONS, proposals.shape, TRUTH.shape, phase=TRAIN, tops=5)
    regions, labels, moves, inner, outer = (top.numpy() for top in layer.run(proposals, TRUTH))
    assert len(regions) == 128
    assert layer.top_shapes[0] == (128, 5)
    truth = TRUTH.numpy()
    count = int((labels > 0).sum())
    assert count == 32  # a quarter
    assert not labels[count:].any()
    for k in range(128):
        table = [iou(regions[k, 1:], true) for true in truth]
        own = truth[int(np.argmax(table))]
        weights = np.zeros(16)
        if k < count:
            assert max(table) >= 0.5
            assert labels[k] == own[4]
            columns = slice(4 * int(own[4]), 4 * int(own[4]) + 4)
            weights[columns] = 1
            delta = moves[k, columns] * [0.1, 0.1, 0.2, 0.2]
            np.testing.assert_allclose(apply_delta(regions[k, 1:], delta), own[:4], atol=1e-2)
        else:
            assert max(table) < 0.5
        assert (inner[k] == weights).all()
        assert (outer[k] == weights).all()


def test_proposal_targets_of_rfcn_have_four_axes_and_need_the_forks_code() -> None:
    """OHEM adds a loss of each region (R, 1, 1, 1) to one that has the labels' shape."""
    tops = "".join(f' top: "{name}"' for name in "rlmio")
    text = f"""layer {{ name: "in" type: "Input" top: "p" top: "t" input_param {{ shape {{ dim: [1, 5] }} }} }}
        layer {{ name: "regions" bottom: "p" bottom: "t"{tops} {REGIONS} }}
        layer {{ name: "l1" type: "SmoothL1LossOHEM" bottom: "p" bottom: "p" top: "loss" top: "each" }}
        layer {{ name: "sum" type: "Eltwise" bottom: "l" bottom: "each" top: "sum" }}"""
    net = build_net(*parse_net_text(text, "n.prototxt"))
    assert (net.shapes["r"], net.shapes["sum"]) == ((1, 5, 1, 1), (1, 1, 1, 1))
    with pytest.raises(SpecError, match=r"R-FCN's choice of regions .* --allow-python-layers runs the fork's own code"):
        net(p=TRUTH[:1], t=TRUTH[:1])


def test_proposal_targets_have_the_attributes_of_their_objects(build: Build) -> None:
    attributes = torch.zeros(3, 16)
    attributes[:, 0], attributes[1, 1:3] = torch.tensor([5.0, 0, 7]), torch.tensor([9.0, 8])
    truth = torch.cat([TRUTH, attributes], dim=1)
    proposals = torch.cat([torch.zeros(3, 1), TRUTH[:, :4] + 1], dim=1)
    text = REGIONS.replace('4"', "4, 'num_attr_classes': 10, 'ignore_label': -1\"")
    *_, labels, _, _, _, found = build("rcnn", text, (3, 5), (3, 21), phase=TRAIN, tops=6).run(proposals, truth)
    assert found.shape == (32, 16)
    rows = {2: [5.0] + [-1] * 15, 3: [0.0, 9, 8] + [-1] * 13, 1: [7.0] + [-1] * 15}
    assert found[:6].tolist() == [rows[int(label)] for label in labels[:6]]
    assert (found[6:] == -1).all()


@pytest.mark.slow
def test_python_layer_proposal_layer_equals_layer_proposal(build: Build) -> None:
    text = PYTHON.format("rpn.proposal_layer", "ProposalLayer", "'feat_stride': 16")
    torch.manual_seed(1)
    bottoms = torch.rand(1, 18, 20, 30), torch.randn(1, 36, 20, 30) / 5, IMAGE
    shapes = [b.shape for b in bottoms]
    for phase, before, after in ((TEST, 6000, 300), (TRAIN, 12000, 2000)):
        plain = f"type: 'Proposal' proposal_param {{ pre_nms_topn: {before} post_nms_topn: {after} }}"
        expected = build("rcnn", plain, *shapes, phase=phase).run(*bottoms)[0]
        large = (expected[:, 3:] - expected[:, 1:3] + 1 >= 16 * IMAGE[0, 2]).all(1)
        assert torch.equal(build("rcnn", text, *shapes, phase=phase).run(*bottoms)[0], expected[large])


def test_python_layer_proposal_layer_leaves_out_boxes_below_the_minimum_size(build: Build) -> None:
    text = PYTHON.format("rpn.proposal_layer", "ProposalLayer", "'feat_stride': 16")
    layer = build("rcnn", text, (1, 18, 1, 2), (1, 36, 1, 2), (1, 3), tops=2)
    bottoms = torch.rand(1, 18, 1, 2), torch.zeros(1, 36, 1, 2)
    shapes = [[tuple(top.shape) for top in layer.run(*bottoms, torch.tensor([[40.0, w, 1.0]]))] for w in (8, 40)]
    assert shapes[0] == [(0, 5), (0, 1)]  # each box is clipped to 8 pixels
    assert shapes[1] == [(len(layer.run(*bottoms, torch.tensor([[40.0, 40, 1]]))[0]), n) for n in (5, 1)]


@pytest.mark.parametrize(
    ("sides", "scale"),
    [((600, 1000), 1), ((751, 1252), 600 / 751), ((750, 1251), 1000 / 1251), ((500, 900), 1000 / 900)],
    ids=["none", "1000.3_is_rounded_to_1000", "1000.8_is_not", "long"],
)
def test_images_are_scaled_by_the_forks_factor(sides: tuple[int, int], scale: float) -> None:
    assert faster.scaled(np.zeros((*sides, 3), np.float32))[1] == scale


def test_allow_python_runs_the_forks_own_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rpn").mkdir()
    (tmp_path / "rpn" / "proposal_layer.py").write_text("raise ValueError('this is mine')")
    net = 'layer {{ name: "p" top: "x" {} }}'
    text = net.format(PYTHON.format("rpn.proposal_layer", "ProposalLayer", "'feat_stride': 16"))
    (tmp_path / "net.prototxt").write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SpecError, match="found 0 bottom blob"):
        netspec.load_net("net.prototxt")
    with pytest.raises(SpecError, match="this is mine"):
        netspec.load_net("net.prototxt", allow_python=True)


def test_set_roidb_passes_images_boxes_and_attributes(tmp_path: Path) -> None:
    text = PYTHON.format("roi_data_layer.layer", "RoIDataLayer", "'num_classes': 4")
    (tmp_path / "net.prototxt").write_text(f'layer {{ name: "d" top: "data" top: "im_info" top: "gt_boxes" {text} }}')
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((60, 80, 3)))
    net = caffe.Net(str(tmp_path / "net.prototxt"), caffe.TRAIN)
    entry = {"image": tmp_path / "0.png", "boxes": [[1, 2, 30, 40]], "gt_classes": [2]}
    net.layers[0].set_roidb([{**entry, "gt_attributes": np.ones((1, 16))}])
    net.forward()
    assert net.blobs["gt_boxes"].data.tolist() == [[10, 20, 300, 400, 2] + [1] * 16]
    net.layers[0].set_roidb([entry])
    net.forward()
    assert net.blobs["data"].data.shape == (1, 3, 600, 800)
    assert net.blobs["gt_boxes"].data.tolist() == [[10, 20, 300, 400, 2]]


def test_an_interrupted_pass_leaves_its_image_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = PYTHON.format("roi_data_layer.layer", "RoIDataLayer", "'num_classes': 4")
    (tmp_path / "net.prototxt").write_text(f'layer {{ name: "d" top: "data" top: "im_info" top: "gt_boxes" {text} }}')
    monkeypatch.setattr(faster, "SHORTEST", 12)
    entries = []
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((12, 16, 3)))
        entries.append({"image": tmp_path / f"{k}.png", "boxes": [[0, 0, 9, 9]], "gt_classes": [k + 1]})
    core, other = (caffe.Net(str(tmp_path / "net.prototxt"), caffe.TRAIN) for _ in range(2))
    for net, run in ((core, core.runner.net), (other, other.forward)):
        net.layers[0].set_roidb(entries)
        seen = [run()["gt_boxes"][0, 4]]
        with monkeypatch.context() as patched:
            patched.setattr(faster, "scaled", Mock(side_effect=KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                run()
        seen += [float(run()["gt_boxes"][0, 4]) for _ in range(3)]
        assert sorted(map(int, seen)) == [1, 2, 3, 4]


def roi_data(tmp_path: Path) -> faster.RoIData:
    text = PYTHON.format("roi_data_layer.layer", "RoIDataLayer", "'num_classes': 4")
    (tmp_path / "net.prototxt").write_text(f'layer {{ name: "d" top: "data" top: "im_info" top: "gt_boxes" {text} }}')
    return netspec.load_net(tmp_path / "net.prototxt", phase="TRAIN").layers[0]


def test_a_resumed_order_of_images_stays_if_they_are_set_later(tmp_path: Path) -> None:
    entries, layer = [{"image": "a.png", "boxes": [[0, 0, 9, 9]], "gt_classes": [1]}] * 3, roi_data(tmp_path)
    layer.restore({"waiting": "2 0"})
    layer.set_roidb(entries)
    assert layer.running_state() == {"waiting": "2 0"}
    layer.set_roidb(entries)
    assert layer.running_state() == {"waiting": ""}
    layer = roi_data(tmp_path)
    layer.restore({"waiting": "2 0"})
    layer.set_roidb(entries[:2])
    assert layer.running_state() == {"waiting": ""}


@pytest.mark.parametrize("waiting", ["3", "0 -1", "1 x"])
def test_a_saved_order_of_other_images_is_refused(tmp_path: Path, waiting: str) -> None:
    layer = roi_data(tmp_path)
    layer.set_roidb([{"image": "a.png", "boxes": [[0, 0, 9, 9]], "gt_classes": [1]}] * 3)
    with pytest.raises(SpecError, match=f'found images "{waiting}" to read next, expected numbers below 3'):
        layer.restore({"waiting": waiting})
    assert layer.running_state() == {"waiting": ""}
