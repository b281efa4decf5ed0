"""YOLO's detections beside plain loops over the cells of its maps."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.dialects import use_dialects_of
from netspec.errors import SpecError
from netspec.layers import Layer

Build = Callable[..., Layer]
Row = tuple[float, ...]


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def overlap(a: Row, b: Row) -> float:
    """Intersection over union of boxes (..., xmin, ymin, xmax, ymax)."""
    w, h = min(a[-2], b[-2]) - max(a[-4], b[-4]), min(a[-1], b[-1]) - max(a[-3], b[-3])
    shared = max(w, 0) * max(h, 0)
    areas = [(c[-2] - c[-4]) * (c[-1] - c[-3]) for c in (a, b)]
    return shared / (sum(areas) - shared)


def kept(rows: list[Row], threshold: float) -> list[Row]:
    found: list[Row] = []
    for row in sorted(rows, key=lambda r: -r[2]):
        if all(overlap(row, other) < threshold for other in found):
            found.append(row)
    return found


def box(x: float, y: float, w: float, h: float) -> Row:
    return x - w / 2, y - h / 2, x + w / 2, y + h / 2


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    assert [tuple(top.shape)] == layer.top_shapes
    return top[0, 0].numpy()


V2 = """type: 'YoloDetectionOutput' yolo_detection_output_param { num_classes: 3 num_box: 2 confidence_threshold: 0.2
    nms_threshold: 0.3 biases: 0.5 biases: 1 biases: 2 biases: 1.5 }"""


def test_version_2(build: Build) -> None:
    maps = torch.randn(1, 2 * 8, 3, 4) * 2
    expected = []
    values = maps[0].numpy().astype(float)
    for n, i, j in np.ndindex(2, 3, 4):
        v = values[n * 8 : n * 8 + 8, i, j]
        classes = np.exp(v[5:]) / np.exp(v[5:]).sum()
        w, h = math.exp(v[2]) * (0.5, 2)[n] / 4, math.exp(v[3]) * (1, 1.5)[n] / 3
        confidence = sigmoid(v[4]) * classes.max()
        if confidence >= 0.2:
            place = box((j + sigmoid(v[0])) / 4, (i + sigmoid(v[1])) / 3, w, h)
            expected.append((0, classes.argmax() + 1, confidence, *place))
    expected = kept(expected, 0.3)
    assert len(expected) > 3
    np.testing.assert_allclose(run(build("yolo", V2, maps.shape), maps), expected, rtol=1e-4, atol=1e-5)


V3 = """type: 'Yolov3DetectionOutput' yolov3_detection_output_param { num_classes: 2 num_box: 3 nms_threshold: 0.45
    confidence_threshold: %s biases: 10 biases: 14 biases: 23 biases: 27 biases: 37 biases: 58 biases: 81 biases: 82
    biases: 135 biases: 169 biases: 344 biases: 319 mask: 3 mask: 4 mask: 5 mask: 0 mask: 1 mask: 2
    anchors_scale: 32 anchors_scale: 16 mask_group_num: 2 }"""
ANCHORS = [(10, 14), (23, 27), (37, 58), (81, 82), (135, 169), (344, 319)]


def test_version_3(build: Build) -> None:
    maps = [torch.randn(2, 3 * 7, 2, 2), torch.randn(2, 3 * 7, 4, 4)]
    layer = build("yolo", V3 % 0.5, *(m.shape for m in maps))
    expected: list[Row] = []
    for image in range(2):
        rows: list[Row] = []
        for k, side in enumerate((2, 4)):
            for n, i, j in np.ndindex(3, side, side):
                v = maps[k][image, n * 7 : n * 7 + 7, i, j].tolist()
                anchor = ANCHORS[(3 - 3 * k) + n]
                size = [math.exp(v[2 + c]) * anchor[c] / (side * (32, 16)[k]) for c in (0, 1)]
                for c in (0, 1):
                    confidence = sigmoid(v[4]) * sigmoid(v[5 + c])
                    if confidence > 0.5:
                        place = box((j + sigmoid(v[0])) / side, (i + sigmoid(v[1])) / side, *size)
                        rows.append((image, c + 1, confidence, *place))
        expected += kept(rows, 0.45)
    assert len(expected) > 4
    np.testing.assert_allclose(run(layer, *maps), expected, rtol=1e-4, atol=1e-5)


def test_nothing_found_is_a_row_for_each_image(build: Build) -> None:
    maps = [torch.randn(2, 21, 2, 2), torch.randn(2, 21, 4, 4)]
    found = run(build("yolo", V3 % 1.5, *(m.shape for m in maps)), *maps)
    assert found.tolist() == [[image, -1, -1, -1, -1, -1, -1] for image in (0, 1)]


@pytest.mark.parametrize(
    ("text", "shapes", "fault"),
    [
        (V2, [(1, 15, 3, 3)], "expected .1, 16, H, W.: 2 boxes of 5 . 3 channels"),
        (V2.replace("biases: 1.5", ""), [(1, 16, 3, 3)], "found 3 biases, expected pairs"),
        (V2.replace("num_box: 2", "num_box: 3"), [(1, 24, 3, 3)], "expected a pair of biases for each of num_box 3"),
        (V3 % 1, [(1, 21, 2, 2)], "expected mask_group_num 1, the number of bottoms"),
        (
            V3.replace("mask: 5", "mask: 6") % 1,
            [(1, 21, 2, 2)] * 2,
            "expected 2 x num_box 3 numbers below 6",
        ),
    ],
)
def test_what_does_not_fit_is_refused(build: Build, text: str, shapes: list[tuple[int, ...]], fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        build("yolo", text, *shapes)


def test_the_dialect_is_found_by_the_layer_type() -> None:
    assert use_dialects_of(f"layer {{ {V3 % 1} }}", "net.prototxt") == ["yolo"]


LOSS = """type: 'RegionLoss' region_loss_param { num_class: 2 num: 2 object_scale: 5 noobject_scale: 1 class_scale: 1
    coord_scale: 1 thresh: 0.6 biases: 0.5 biases: 1 biases: 2 biases: 1.5 rescore: %d bias_match: %d }"""


def moves(maps: np.ndarray, truth: np.ndarray, rescore: bool, bias_match: bool) -> np.ndarray:
    """Return by loops the gradient times the number of images, for maps (2 (5 + 2), S, S) and true boxes (n, 5)."""
    side, anchors, found = maps.shape[-1], [(0.5, 1.0), (2.0, 1.5)], np.zeros_like(maps)

    def predicted(n: int, row: int, column: int) -> Row:
        x, y, w, h = maps[7 * n : 7 * n + 4, row, column]
        sizes = (math.exp(w) * anchors[n][0] / side, math.exp(h) * anchors[n][1] / side)
        return box((column + sigmoid(x)) / side, (row + sigmoid(y)) / side, *sizes)

    boxes = [each for each in truth.tolist() if each[3]]
    for n, row, column in np.ndindex(2, side, side):
        o = sigmoid(float(maps[7 * n + 4, row, column]))
        best = max((overlap(predicted(n, row, column), box(*each[1:])) for each in boxes), default=0)
        found[7 * n + 4, row, column] = 0 if best > 0.6 else o * o * (1 - o)
    for label, x, y, w, h in boxes:
        column, row = int(x * side), int(y * side)
        shapes = []
        for n in range(2):
            sizes = [
                a / side * (1 if bias_match else math.exp(maps[7 * n + 2 + i, row, column]))
                for i, a in enumerate(anchors[n])
            ]
            shapes.append(overlap(box(0, 0, *sizes), box(0, 0, w, h)))
        n = shapes.index(max(shapes))
        numbers, move = maps[7 * n : 7 * n + 7, row, column], found[7 * n : 7 * n + 7, row, column]
        scale = 1 if rescore else 2 - w * h
        for i, goal in ((0, x * side - column), (1, y * side - row)):
            s = sigmoid(numbers[i])
            move[i] = -scale * (goal - s) * s * (1 - s)
        for i, goal in ((2, math.log(w * side / anchors[n][0])), (3, math.log(h * side / anchors[n][1]))):
            move[i] = -scale * (goal - numbers[i])
        o, goal = sigmoid(numbers[4]), overlap(predicted(n, row, column), box(x, y, w, h)) if rescore else 1
        move[4] = -5 * (goal - o) * o * (1 - o)
        p = np.exp(numbers[5:]) / np.exp(numbers[5:]).sum()
        move[5:] = p - (np.arange(2) == label)
    return found


@pytest.mark.parametrize("bias_match", [0, 1])
@pytest.mark.parametrize("rescore", [0, 1])
def test_the_gradient_of_region_loss_is_what_it_moves_not_its_derivative(
    build: Build, rescore: int, bias_match: int
) -> None:
    maps = torch.randn(2, 14, 3, 3, requires_grad=True)
    truth = torch.zeros(2, 1, 4, 5)
    truth[0, 0, :2] = torch.tensor([[1, 0.4, 0.45, 0.5, 0.6], [0, 0.9, 0.1, 0.2, 0.3]])
    truth[1, 0, :1] = torch.tensor([[1, 0.7, 0.72, 0.6, 0.5]])
    layer = build("yolo", LOSS % (rescore, bias_match), maps.shape, truth.shape)
    (loss,) = layer.run(maps, truth)
    values = maps.detach().numpy().astype(float)
    pairs = zip(values, truth[:, 0].numpy(), strict=True)
    expected = np.stack([moves(m, t, bool(rescore), bool(bias_match)) for m, t in pairs])
    np.testing.assert_allclose(loss.item(), (expected**2).sum() / 2, rtol=1e-5)
    (found,) = torch.autograd.grad(loss, maps)
    np.testing.assert_allclose(found, expected / 2, atol=1e-5)
