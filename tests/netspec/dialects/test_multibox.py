"""MultiBoxLoss: mining, suppression, what counts in the loss, and invalid true boxes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from netspec.errors import SpecError
from netspec.layers import Layer

pytestmark = pytest.mark.slow

Build = Callable[..., Layer]

IMAGES, PRIORS, CLASSES = 3, 16, 4
TRUTH = [  # image, label, instance, xmin, ymin, xmax, ymax, difficult
    (0, 1, 0, 0.10, 0.10, 0.40, 0.45, 0),
    (0, 3, 1, 0.50, 0.40, 0.90, 0.95, 0),
    (0, 3, 2, 0.20, 0.15, 0.45, 0.50, 1),
    (2, 2, 0, 0.30, 0.05, 0.80, 0.60, 0),
    (-1, 0, 0, 0.00, 0.00, 0.00, 0.00, 0),
]


def random_predictions(kinds: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return predicted boxes, confidences, priors (some beyond the image) and variances."""
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


def test_losses_with_propagate_down_false_are_left_out(build: Build) -> None:
    given = bottoms(*random_predictions(), TRUTH)
    down = "propagate_down: {} propagate_down: {} propagate_down: false propagate_down: false"
    (both,) = layer_of(build, {}, given).run(*given)
    (boxes,) = layer_of(build, {}, given, down.format("true", "false")).run(*given)
    (confidences,) = layer_of(build, {}, given, down.format("false", "true")).run(*given)
    assert boxes > 0
    assert confidences > 0
    torch.testing.assert_close(boxes + confidences, both)


def test_hard_examples_that_overlap_one_of_larger_loss_are_suppressed(build: Build) -> None:
    # Two priors that overlap, of which only that of larger loss is trained, one that overlaps none, and a tiny one.
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


def test_suppression_without_top_k_leaves_no_example(build: Build) -> None:
    given = bottoms(*random_predictions(), TRUTH)
    text = "num_classes: 4 mining_type: HARD_EXAMPLE nms_param { nms_threshold: 0.5 }"
    (loss,) = build("ssd", f"type: 'MultiBoxLoss' multibox_loss_param {{ {text} }}", *(b.shape for b in given)).run(
        *given
    )
    assert loss == 0


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((0, 0, 0, 0.1, 0.1, 0.4, 0.4, 0), "found a true box of label 0, expected 0 to 3 and not the background's, 0"),
        ((0, 4, 0, 0.1, 0.1, 0.4, 0.4, 0), "found a true box of label 4"),
        ((0, 1, 0, 0.4, 0.1, 0.4, 0.4, 0), "expected xmin < xmax and ymin < ymax"),
    ],
    ids=["label_of_background", "label_too_large", "empty_box"],
)
def test_invalid_true_boxes_are_refused(build: Build, row: tuple[float, ...], message: str) -> None:
    given = bottoms(*random_predictions(), [row])
    layer = layer_of(build, {"code_type": "CENTER_SIZE"}, given)
    with pytest.raises(SpecError, match=message):
        layer.run(*given)
