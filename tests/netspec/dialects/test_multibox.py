"""MultiBoxLoss beside the loss summed up prior by prior, and its oddities one by one."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.layers import Layer

pytestmark = pytest.mark.slow

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]

IMAGES, PRIORS, CLASSES = 3, 16, 4
TRUTH = [  # image, label, instance, xmin, ymin, xmax, ymax, difficult
    (0, 1, 0, 0.10, 0.10, 0.40, 0.45, 0),
    (0, 3, 1, 0.50, 0.40, 0.90, 0.95, 0),
    (0, 3, 2, 0.20, 0.15, 0.45, 0.50, 1),
    (2, 2, 0, 0.30, 0.05, 0.80, 0.60, 0),
    (-1, 0, 0, 0.00, 0.00, 0.00, 0.00, 0),
]


class Oracle:
    """The loss in plain Python; settings as in the prototxt, defaults the fork's."""

    def __init__(self, **settings: Any) -> None:
        self.s: dict[str, Any] = {
            "loc_loss_type": "SMOOTH_L1",
            "conf_loss_type": "SOFTMAX",
            "loc_weight": 1.0,
            "share_location": True,
            "match_type": "PER_PREDICTION",
            "overlap_threshold": 0.5,
            "use_prior_for_matching": True,
            "background_label_id": 0,
            "use_difficult_gt": True,
            "neg_pos_ratio": 3.0,
            "neg_overlap": 0.5,
            "code_type": "CORNER",
            "encode_variance_in_target": False,
            "ignore_cross_boundary_bbox": False,
            "bp_inside": False,
            "mining_type": "MAX_NEGATIVE",
            "sample_size": 64,
            **settings,
        }

    def encode(self, box: Any, prior: Any, variance: Any) -> list[float]:
        w, h = prior[2] - prior[0], prior[3] - prior[1]
        if self.s["code_type"] == "CENTER_SIZE":
            code = [
                (box[0] + box[2] - prior[0] - prior[2]) / 2 / w,
                (box[1] + box[3] - prior[1] - prior[3]) / 2 / h,
                math.log((box[2] - box[0]) / w),
                math.log((box[3] - box[1]) / h),
            ]
        else:
            sizes = (w, h, w, h) if self.s["code_type"] == "CORNER_SIZE" else (1, 1, 1, 1)
            code = [(b - p) / size for b, p, size in zip(box, prior, sizes, strict=True)]
        scale = (1, 1, 1, 1) if self.s["encode_variance_in_target"] else variance
        return [c / v for c, v in zip(code, scale, strict=True)]

    def decode(self, code: Any, prior: Any, variance: Any) -> list[float]:
        scale = (1, 1, 1, 1) if self.s["encode_variance_in_target"] else variance
        c = [a * b for a, b in zip(code, scale, strict=True)]
        w, h = prior[2] - prior[0], prior[3] - prior[1]
        if self.s["code_type"] == "CENTER_SIZE":
            x, y = (prior[0] + prior[2]) / 2 + c[0] * w, (prior[1] + prior[3]) / 2 + c[1] * h
            half_w, half_h = math.exp(c[2]) * w / 2, math.exp(c[3]) * h / 2
            return [x - half_w, y - half_h, x + half_w, y + half_h]
        sizes = (w, h, w, h) if self.s["code_type"] == "CORNER_SIZE" else (1, 1, 1, 1)
        return [p + a * size for p, a, size in zip(prior, c, sizes, strict=True)]

    def match(self, boxes: Any, truth: list[Any]) -> tuple[dict[int, int], dict[int, float], set[int]]:
        """Prior -> index of its true box; prior -> overlap; priors that take no part."""
        out = set()
        if self.s["ignore_cross_boundary_bbox"]:
            out = {p for p, box in enumerate(boxes) if any(v < 0 or v > 1 for v in box)}
        table = {
            (p, g): iou(box, true[3:7])
            for p, box in enumerate(boxes)
            for g, true in enumerate(truth)
            if p not in out and iou(box, true[3:7]) > 1e-6
        }
        best = {p: max((v for (q, _), v in table.items() if q == p), default=0.0) for p in range(len(boxes))}
        found: dict[int, int] = {}
        free = dict(table)
        while free:
            p, g = max(free, key=lambda pair: free[pair])
            found[p], best[p] = g, free[p, g]
            free = {pair: v for pair, v in free.items() if pair[0] != p and pair[1] != g}
        if self.s["match_type"] == "PER_PREDICTION":
            for p in range(len(boxes)):
                own = {g: v for (q, g), v in table.items() if q == p and v >= self.s["overlap_threshold"]}
                if p not in found and own:
                    found[p] = max(own, key=lambda g: own[g])
        return found, best, out

    def box_loss(self, code: Any, true: Any, prior: Any, variance: Any) -> float:
        target = self.encode(true[3:7], prior, variance)
        where = prior if self.s["use_prior_for_matching"] else self.decode(code, prior, variance)
        total = 0.0
        for k in range(4):
            if self.s["bp_inside"] and not 0 <= where[k] <= 1:
                continue
            d = (code[k] - target[k]) / (variance[k] if self.s["encode_variance_in_target"] else 1)
            smooth = self.s["loc_loss_type"] == "SMOOTH_L1" and abs(d) >= 1
            total += abs(d) - 0.5 if smooth else 0.5 * d * d
        return total

    def confidence_loss(self, scores: Any, labels: set[int]) -> float:
        if self.s["conf_loss_type"] == "SOFTMAX":
            (label,) = labels or {self.s["background_label_id"]}
            return math.log(sum(math.exp(v - scores[label]) for v in scores))
        return sum(math.log1p(math.exp(v)) - (v if c in labels else 0) for c, v in enumerate(scores))

    def loss(self, loc: Any, conf: Any, priors: Any, variances: Any, truth: list[Any], divide: str = "VALID") -> float:
        mining, background = self.s["mining_type"], self.s["background_label_id"]
        box_total = confidence_total = 0.0
        matches = 0
        displaced = mining == "NONE" and self.s["conf_loss_type"] == "LOGISTIC"
        hot_at: set[int] = set()  # without mining the fork lets image i begin at i p, instead of at i p num_classes
        for i in range(len(loc)):
            own = [t for t in truth if t[0] == i and (self.s["use_difficult_gt"] or not t[7])]
            labels: dict[int, set[int]] = {}
            pairs: list[tuple[int, int, int]] = []  # kind, prior, true box
            eligible: list[int] = []
            best: dict[int, float] = {}
            kinds = [0] if self.s["share_location"] else [c for c in range(CLASSES) if c != background]
            for kind in kinds if own else ():
                boxes = priors
                within = list(range(len(own)))
                if not self.s["use_prior_for_matching"]:
                    boxes = [self.decode(loc[i][p][kind], priors[p], variances[p]) for p in range(len(priors))]
                    if not self.s["share_location"]:
                        within = [g for g in within if own[g][1] == kind]
                found, best, out = self.match(boxes, [own[g] for g in within])
                for p, g in sorted(found.items()):
                    if self.s["share_location"] or own[within[g]][1] == kind:
                        pairs.append((kind, p, within[g]))
                        labels.setdefault(p, set()).add(own[within[g]][1])
                eligible = [p for p in range(len(priors)) if p not in found and p not in out]
            trained = set(range(len(priors)))
            hot = {p: labels.get(p, set() if mining == "NONE" else {background}) for p in trained}
            if mining == "MAX_NEGATIVE":
                hard = [p for p in eligible if best[p] < self.s["neg_overlap"]]
                hard.sort(key=lambda p: -self.confidence_loss(conf[i][p], hot[p]))
                trained = set(labels) | set(hard[: int(len(pairs) * self.s["neg_pos_ratio"])])
            elif mining == "HARD_EXAMPLE":
                cost = {p: self.confidence_loss(conf[i][p], hot[p]) for p in trained}
                for _, p, g in pairs:
                    cost[p] += self.box_loss(loc[i][p][0], own[g], priors[p], variances[p])
                chosen = set(sorted(cost, key=lambda p: -cost[p])[: self.s["sample_size"]]) if own else set()
                pairs = [pair for pair in pairs if pair[1] in chosen]
                trained = chosen & (set(labels) | set(eligible))
            matches += len(pairs)
            box_total += sum(self.box_loss(loc[i][p][k], own[g], priors[p], variances[p]) for k, p, g in pairs)
            if displaced:
                start = i * len(priors)
                hot_at |= {start + p * CLASSES + label for p, own_labels in labels.items() for label in own_labels}
                continue
            confidence_total += sum(self.confidence_loss(conf[i][p], hot[p]) for p in trained)
        for i, p in np.ndindex(len(loc), len(priors)) if displaced else ():
            first = (i * len(priors) + p) * CLASSES
            confidence_total += self.confidence_loss(conf[i][p], {c for c in range(CLASSES) if first + c in hot_at})
        count = {"VALID": matches, "FULL": len(loc) * len(priors), "BATCH_SIZE": len(loc), "NONE": 1}[divide]
        return (self.s["loc_weight"] * box_total + confidence_total) / max(1, count)


def iou(a: Any, b: Any) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    both = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1])
    return width * height / (both - width * height)


def scene(kinds: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Predicted boxes, confidences, priors (some beyond the image), variances."""
    rng = np.random.default_rng(3)
    centre, half = rng.uniform(0.1, 0.9, (PRIORS, 2)), rng.uniform(0.1, 0.3, (PRIORS, 2))
    priors = np.concatenate([centre - half, centre + half], axis=1)
    variances = np.tile([0.1, 0.15, 0.2, 0.25], (PRIORS, 1))
    loc, conf = rng.normal(size=(IMAGES, PRIORS, kinds, 4)), rng.normal(size=(IMAGES, PRIORS, CLASSES))
    return tuple(a.astype(np.float32) for a in (loc, conf, priors, variances))  # type: ignore[return-value]


def bottoms(
    loc: np.ndarray, conf: np.ndarray, priors: np.ndarray, variances: np.ndarray, truth: Any
) -> list[torch.Tensor]:
    rows = torch.tensor(truth, dtype=torch.float32).reshape(1, 1, -1, 8)
    prior = torch.from_numpy(np.stack([priors.reshape(-1), variances.reshape(-1)])[None])
    flat = [torch.from_numpy(a.reshape(len(a), -1)) for a in (loc, conf)]
    return [*flat, prior, rows]


def layer_of(build: Build, settings: dict[str, Any], given: list[torch.Tensor], more: str = "") -> Layer:
    words = {"loc_loss_type", "conf_loss_type", "match_type", "code_type", "mining_type"}
    text = " ".join(f"{k}: {v if k in words else str(v).lower()}" for k, v in settings.items())
    param = f"type: 'MultiBoxLoss' multibox_loss_param {{ num_classes: {CLASSES} {text} }} {more}"
    return build("ssd", param, *(b.shape for b in given), phase=0)


SETTINGS: list[dict[str, Any]] = [
    {},
    {"code_type": "CENTER_SIZE"},
    {"code_type": "CORNER_SIZE", "loc_loss_type": "L2", "loc_weight": 2.5},
    {"match_type": "BIPARTITE", "neg_pos_ratio": 1.5},
    {"overlap_threshold": 0.2, "neg_overlap": 0.1},
    {"use_prior_for_matching": False, "overlap_threshold": 0.3, "code_type": "CENTER_SIZE"},
    {"use_difficult_gt": False, "overlap_threshold": 0.3},
    {"ignore_cross_boundary_bbox": True, "overlap_threshold": 0.3},
    {"bp_inside": True, "overlap_threshold": 0.3},
    {"bp_inside": True, "use_prior_for_matching": False, "overlap_threshold": 0.3},
    {"encode_variance_in_target": True, "code_type": "CENTER_SIZE", "overlap_threshold": 0.3},
    {"conf_loss_type": "LOGISTIC"},
    {"mining_type": "NONE"},
    {"mining_type": "NONE", "conf_loss_type": "LOGISTIC"},
    {"mining_type": "NONE", "share_location": False, "overlap_threshold": 0.3},
    {"mining_type": "NONE", "share_location": False, "use_prior_for_matching": False, "conf_loss_type": "LOGISTIC"},
    {"mining_type": "HARD_EXAMPLE", "sample_size": 5, "overlap_threshold": 0.2},
    {"mining_type": "HARD_EXAMPLE", "conf_loss_type": "LOGISTIC", "overlap_threshold": 0.2, "sample_size": 3},
    {"mining_type": "HARD_EXAMPLE", "loc_loss_type": "L2", "ignore_cross_boundary_bbox": True, "sample_size": 7},
]


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: " ".join(f"{k}={v}" for k, v in s.items()) or "defaults")
def test_loss_and_gradient(build: Build, gradcheck: Gradcheck, settings: dict[str, Any]) -> None:
    loc, conf, priors, variances = scene(1 if settings.get("share_location", True) else CLASSES)
    given = bottoms(loc, conf, priors, variances, TRUTH)
    layer = layer_of(build, settings, given)
    expected = Oracle(**settings).loss(loc.tolist(), conf.tolist(), priors.tolist(), variances.tolist(), TRUTH)
    (loss,) = layer.run(*given)
    assert loss.shape == ()
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    if not settings.get("encode_variance_in_target"):
        gradcheck(layer, *given, fixed=(2, 3))


@pytest.mark.parametrize("divide", ["VALID", "FULL", "BATCH_SIZE", "NONE"])
def test_what_the_sum_is_divided_by(build: Build, divide: str) -> None:
    loc, conf, priors, variances = scene()
    given = bottoms(loc, conf, priors, variances, TRUTH)
    (loss,) = layer_of(build, {}, given, f"loss_param {{ normalization: {divide} }}").run(*given)
    expected = Oracle().loss(loc.tolist(), conf.tolist(), priors.tolist(), variances.tolist(), TRUTH, divide)
    assert loss.item() == pytest.approx(expected, rel=1e-5)


def test_a_batch_without_true_boxes_has_no_loss_and_no_gradient(build: Build) -> None:
    given = bottoms(*scene(), TRUTH[-1:])
    for settings in ({}, {"mining_type": "HARD_EXAMPLE"}):
        loc, conf = (g.clone().requires_grad_() for g in given[:2])
        (loss,) = layer_of(build, settings, given).run(loc, conf, *given[2:])
        assert loss == 0
        loss.backward()
        assert loc.grad is not None
        assert conf.grad is not None
        assert not loc.grad.any()
        assert not conf.grad.any()


def test_parts_that_are_not_propagated_do_not_count(build: Build) -> None:
    scenery = scene()
    given = bottoms(*scenery, TRUTH)
    down = "propagate_down: {} propagate_down: {} propagate_down: false propagate_down: false"
    (both,) = layer_of(build, {}, given).run(*given)
    (boxes,) = layer_of(build, {}, given, down.format("true", "false")).run(*given)
    (confidences,) = layer_of(build, {}, given, down.format("false", "true")).run(*given)
    assert boxes > 0
    assert confidences > 0
    torch.testing.assert_close(boxes + confidences, both)


def test_with_the_variance_in_the_target_the_gradient_is_not_divided_by_it(build: Build) -> None:
    given = bottoms(*scene(), TRUTH)
    settings = {"encode_variance_in_target": True, "loc_loss_type": "SMOOTH_L1", "conf_loss_type": "SOFTMAX"}
    loc = given[0].clone().requires_grad_()
    layer_of(build, settings, given, "loss_param { normalization: NONE }").run(loc, *given[1:])[0].backward()
    assert loc.grad is not None
    assert loc.grad.abs().max() == 1  # where |d| > 1; 1 / 0.25 at least if it were divided


def test_objects_of_any_label_are_one_class(build: Build) -> None:
    loc, conf, priors, variances = scene()
    given = bottoms(loc, conf[..., :2], priors, variances, TRUTH)
    text = "type: 'MultiBoxLoss' multibox_loss_param { num_classes: 2 map_object_to_agnostic: true }"
    (loss,) = build("ssd", text, *(b.shape for b in given)).run(*given)
    relabelled = [(t[0], min(t[1], 1), *t[2:]) for t in TRUTH]
    (expected,) = build(
        "ssd", "type: 'MultiBoxLoss' multibox_loss_param { num_classes: 2 }", *(b.shape for b in given)
    ).run(*bottoms(loc, conf[..., :2], priors, variances, relabelled))
    assert loss == expected


def test_hard_examples_that_overlap_one_of_greater_loss_are_suppressed(build: Build) -> None:
    # Two priors nearly alike, of which only that of greater loss is trained, one apart, and one next to nothing.
    boxes = [[0.1, 0.1, 0.4, 0.4], [0.11, 0.1, 0.4, 0.4], [0.6, 0.6, 0.9, 0.9], [0.5, 0.5, 0.502, 0.502]]
    priors = np.array(boxes, np.float32)
    variances = np.full((4, 4), 0.1, np.float32)
    conf = np.array([[[0, 1, 0, 0], [0, 3, 0, 0], [0, 2, 0, 0], [0, 2.5, 0, 0]]], np.float32)
    given = bottoms(np.zeros((1, 4, 1, 4), np.float32), conf, priors, variances, [(0, 1, 0, 0.0, 0.5, 0.05, 0.55, 0)])
    trained = []
    for nms in ("nms_param { nms_threshold: 0.5 top_k: 10 }", "nms_param { nms_threshold: 0.5 top_k: 1 }", ""):
        words = "mining_type: HARD_EXAMPLE use_prior_for_nms: true " + nms
        text = f"type: 'MultiBoxLoss' multibox_loss_param {{ num_classes: 4 {words} }}"
        scores = given[1].clone().requires_grad_()
        build("ssd", text, *(b.shape for b in given)).run(given[0], scores, *given[2:])[0].backward()
        assert scores.grad is not None
        trained.append(scores.grad.reshape(4, 4).abs().sum(1).gt(0).tolist())
    assert trained == [[False, True, True, False], [False, True, False, False], [True, True, True, True]]


def test_suppression_without_a_top_k_leaves_nothing(build: Build) -> None:
    given = bottoms(*scene(), TRUTH)
    text = "num_classes: 4 mining_type: HARD_EXAMPLE nms_param { nms_threshold: 0.5 }"
    (loss,) = build("ssd", f"type: 'MultiBoxLoss' multibox_loss_param {{ {text} }}", *(b.shape for b in given)).run(
        *given
    )
    assert loss == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("", "num_classes must be given"),
        ("num_classes: 4 background_label_id: 4", "background_label_id 4 is not one of the 4 classes"),
        ("num_classes: 4 map_object_to_agnostic: true", "map_object_to_agnostic needs num_classes: 2"),
        ("num_classes: 4 share_location: false", "mining needs share_location: true"),
        ("num_classes: 4 do_neg_mining: false", "do_neg_mining is outdated and contradicts mining_type"),
        ("num_classes: 4 mining_type: HARD_EXAMPLE sample_size: 0", "sample_size must be at least 1"),
    ],
)
def test_settings_that_are_refused(build: Build, settings: str, message: str) -> None:
    given = bottoms(*scene(), TRUTH)
    with pytest.raises(SpecError, match=message):
        build("ssd", f"type: 'MultiBoxLoss' multibox_loss_param {{ {settings} }}", *(b.shape for b in given))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((0, 0, 0, 0.1, 0.1, 0.4, 0.4, 0), "found a true box of label 0, expected 0 to 3 and not the background's, 0"),
        ((0, 4, 0, 0.1, 0.1, 0.4, 0.4, 0), "found a true box of label 4"),
        ((0, 1, 0, 0.4, 0.1, 0.4, 0.4, 0), "expected xmin < xmax and ymin < ymax"),
    ],
)
def test_true_boxes_that_are_refused(build: Build, row: tuple[float, ...], message: str) -> None:
    given = bottoms(*scene(), [row])
    layer = layer_of(build, {"code_type": "CENTER_SIZE"}, given)
    with pytest.raises(SpecError, match=message):
        layer.run(*given)


def test_bottoms_that_do_not_suit_the_priors(build: Build) -> None:
    given = bottoms(*scene(), TRUTH)
    for i, shape, message in ((0, (3, 60), "expected .3, 64. for 16 priors"), (3, (1, 1, 5, 7), "rows of 8 numbers")):
        shapes = [tuple(b.shape) for b in given]
        shapes[i] = shape
        with pytest.raises(SpecError, match=message):
            build("ssd", "type: 'MultiBoxLoss' multibox_loss_param { num_classes: 4 }", *shapes)
