"""SSD's layers beside plain loops over single boxes."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec.dialects import use_dialect
from netspec.dialects.boxes import CENTER_SIZE, decode, suppress
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Layer
from netspec.net.build import build_net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text
from netspec.solver.solver import load_solver

Build = Callable[..., Layer]
Gradcheck = Callable[..., None]
Box = tuple[float, float, float, float]


def run(layer: Layer, *bottoms: torch.Tensor) -> np.ndarray:
    (top,) = layer.run(*bottoms)
    return top.detach().numpy()


# ---- Permute, Normalize ----


@pytest.mark.parametrize(("order", "axes"), [((0, 2, 3, 1), (0, 2, 3, 1)), ((2,), (2, 0, 1, 3)), ((), (0, 1, 2, 3))])
def test_permute(build: Build, gradcheck: Gradcheck, order: tuple[int, ...], axes: tuple[int, ...]) -> None:
    x = torch.randn(2, 3, 4, 5)
    text = " ".join(f"order: {axis}" for axis in order)
    layer = build("ssd", f"type: 'Permute' permute_param {{ {text} }}", x.shape)
    assert layer.top_shapes == [tuple(x.shape[axis] for axis in axes)]
    np.testing.assert_array_equal(run(layer, x), x.numpy().transpose(axes))
    gradcheck(layer, x)


def test_permute_refuses_an_axis_twice_or_beyond(build: Build) -> None:
    for order, column in (("order: 0 order: 0", 42), ("order: 4 order: 0", 33)):
        with pytest.raises(SpecError, match=rf"^<layer>:1:{column}: .*expected each of 0 to 3 at most once"):
            build("ssd", f"type: 'Permute' permute_param {{ {order} }}", (2, 3, 4, 5))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("across", [False, True])
def test_normalize(build: Build, gradcheck: Gradcheck, shared: bool, across: bool) -> None:
    x = torch.randn(2, 3, 4, 5)
    settings = (
        f"across_spatial: {across} channel_shared: {shared} eps: 0.1 scale_filler {{ type: 'uniform' min: 2 max: 9 }}"
    )
    layer = build("ssd", f"type: 'Normalize' norm_param {{ {settings} }}", x.shape)
    assert layer.blob_shapes == [() if shared else (3,)]
    scale = np.broadcast_to(layer.blobs[0].detach().numpy(), (3,))
    expected = np.empty(x.shape, np.float32)
    for n, c, i, j in np.ndindex(*x.shape):
        counted = x[n] if across else x[n, :, i, j]
        expected[n, c, i, j] = scale[c] * x[n, c, i, j] / math.sqrt(float((counted**2).sum()) + 0.1)
    np.testing.assert_allclose(run(layer, x), expected, rtol=1e-5)
    if not shared:  # the gradient of the bottom is not the derivative
        layer.blobs[0].data.fill_(3.0)
    gradcheck(layer, x)


def test_the_gradient_of_normalize_leaves_the_scales_out_of_the_sum(build: Build) -> None:
    """The fork's gradient with a scale for each channel (normalize_layer.cpp), which every SSD300 was trained with."""
    text = "norm_param { across_spatial: false channel_shared: false scale_filler { type: 'uniform' min: 2 max: 9 } }"
    x, dy = torch.randn(2, 3, 4, 5, requires_grad=True), torch.randn(2, 3, 4, 5)
    layer = build("ssd", f"type: 'Normalize' {text}", tuple(x.shape))
    layer.run(x)[0].backward(dy)
    scale = layer.blobs[0].detach()[:, None, None]
    plain = x.detach().requires_grad_()
    (plain / (plain.square().sum(1, keepdim=True) + 1e-10).sqrt()).backward(dy)
    assert x.grad is not None
    assert plain.grad is not None
    torch.testing.assert_close(x.grad, plain.grad * scale)


def test_normalize_begins_with_scale_1(build: Build) -> None:
    assert build("ssd", "type: 'Normalize'", (2, 3, 4, 5)).blobs[0] == 1


# ---- PriorBox ----


def priors(
    size: tuple[int, int],
    image: tuple[int, int],
    step: tuple[float, float],
    boxes: list[tuple[float, float]],
    offset: float = 0.5,
) -> list[Box]:
    """Sizes of ``boxes`` are width and height in pixels, the pairs are (vertical, horizontal)."""
    found = []
    for i, j in np.ndindex(*size):
        y, x = (i + offset) * step[0], (j + offset) * step[1]
        for w, h in boxes:
            box = ((x - w / 2) / image[1], (y - h / 2) / image[0], (x + w / 2) / image[1], (y + h / 2) / image[0])
            found.append(box)
    return found


ROOT2, ROOT3 = math.sqrt(2), math.sqrt(3)


@pytest.mark.parametrize(
    ("settings", "boxes", "image", "step"),
    [
        ("min_size: 30", [(30, 30)], (60, 90), (30, 30)),
        (
            "min_size: 30.9 max_size: 60 aspect_ratio: 2 aspect_ratio: 1 aspect_ratio: 0.5",
            [(30, 30), (math.sqrt(1800),) * 2, (30 * ROOT2, 30 / ROOT2), (30 / ROOT2, 30 * ROOT2)],
            (60, 90),
            (30, 30),
        ),
        (
            "min_size: 10 min_size: 20 aspect_ratio: 3 flip: false img_size: 100 step: 8 offset: 0.25",
            [(10, 10), (10 * ROOT3, 10 / ROOT3), (20, 20), (20 * ROOT3, 20 / ROOT3)],
            (100, 100),
            (8, 8),
        ),
        ("min_size: 10 img_h: 50 img_w: 40 step_h: 5 step_w: 4", [(10, 10)], (50, 40), (5, 4)),
        ("min_size: 10 img_h: 50 img_w: 40", [(10, 10)], (50, 40), (25, 40 / 3)),
    ],
)
def test_prior_box(
    build: Build, settings: str, boxes: list[tuple[float, float]], image: tuple[int, int], step: tuple[float, float]
) -> None:
    bottoms = torch.randn(2, 4, 2, 3), torch.randn(2, 3, 60, 90)
    layer = build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", *(b.shape for b in bottoms))
    expected = priors((2, 3), image, step, boxes, 0.25 if "offset" in settings else 0.5)
    assert layer.top_shapes == [(1, 2, 4 * len(expected))]
    top = run(layer, *bottoms)
    np.testing.assert_allclose(top[0, 0].reshape(-1, 4), expected, rtol=1e-5, atol=1e-6)
    assert np.array_equal(top[0, 1], np.full(4 * len(expected), 0.1, np.float32))


def test_sizes_that_are_cut_are_named_since_forks_differ(build: Build, caplog: pytest.LogCaptureFixture) -> None:
    settings = "min_size: 9.2 min_size: 12 max_size: 11.5 max_size: 20 img_size: 60"
    build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", (1, 1, 2, 2))
    cut, other = caplog.messages
    place = '<layer>:1:36: layer "" (PriorBox): '
    assert cut.startswith(f"{place}min_size is cut to whole pixels, as in SSD: 9.2 to 9; OpenCV and some forks keep it")
    assert "max_size is cut to whole pixels, as in SSD: 11.5 to 11" in other
    caplog.clear()
    build("ssd", "type: 'PriorBox' prior_box_param { min_size: 30 img_size: 60 }", (1, 1, 2, 2))
    assert not caplog.messages


def test_prior_boxes_are_clipped_and_have_their_variances(build: Build) -> None:
    settings = "min_size: 50 clip: true img_size: 60 variance: 0.1 variance: 0.2 variance: 0.3 variance: 0.4"
    maps = torch.randn(1, 1, 2, 2)
    (top,) = build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", maps.shape).run(maps)
    expected = np.clip(priors((2, 2), (60, 60), (30, 30), [(50, 50)]), 0, 1)
    np.testing.assert_allclose(top[0, 0].reshape(-1, 4).numpy(), expected, rtol=1e-5)
    np.testing.assert_array_equal(top[0, 1].numpy(), np.tile(np.array([0.1, 0.2, 0.3, 0.4], np.float32), 4))


# ---- DetectionOutput ----


def overlap(a: Box, b: Box) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / union


def decoded(code: Box, prior: Box, variance: Box, kind: str) -> Box:
    w, h = prior[2] - prior[0], prior[3] - prior[1]
    a, b, c, d = (v * s for v, s in zip(code, variance, strict=True))
    if kind == "CORNER":
        return prior[0] + a, prior[1] + b, prior[2] + c, prior[3] + d
    if kind == "CORNER_SIZE":
        return prior[0] + a * w, prior[1] + b * h, prior[2] + c * w, prior[3] + d * h
    x, y = a * w + (prior[0] + prior[2]) / 2, b * h + (prior[1] + prior[3]) / 2
    w, h = math.exp(c) * w, math.exp(d) * h
    return x - w / 2, y - h / 2, x + w / 2, y + h / 2


def detections(
    boxes: list[list[Box]],
    scores: np.ndarray,
    background: int,
    threshold: float,
    nms: float,
    eta: float = 1.0,
    top_k: int | None = None,
    keep: int = -1,
) -> list[tuple[int, float, Box]]:
    """The detections of one image, ``boxes`` by label."""
    found: list[tuple[int, float, Box]] = []
    for label in range(scores.shape[1]):
        if label == background:
            continue
        order = sorted((p for p in range(len(scores)) if scores[p, label] > threshold), key=lambda p: -scores[p, label])
        limit, kept = nms, []
        for p in order[:top_k]:
            if all(overlap(boxes[label][p], boxes[label][q]) <= limit for q in kept):
                kept.append(p)
                limit *= eta if eta < 1 and limit > 0.5 else 1
        found += [(label, scores[p, label], boxes[label][p]) for p in kept]
    if -1 < keep < len(found):
        likely = sorted(found, key=lambda one: -one[1])[:keep]
        found = sorted(likely, key=lambda one: (one[0], -one[1]))
    return found


def some_priors(count: int, rng: np.random.Generator) -> np.ndarray:
    centre, half = rng.uniform(0.2, 0.8, (count, 2)), rng.uniform(0.05, 0.2, (count, 2))
    return np.concatenate([centre - half, centre + half], axis=1).astype(np.float32)


@pytest.mark.parametrize("kind", ["CORNER", "CENTER_SIZE", "CORNER_SIZE"])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(
    "limits",
    [
        {"threshold": 0.2, "nms": 0.3},
        {"threshold": -math.inf, "nms": 0.8, "eta": 0.9},
        {"threshold": 0.1, "nms": 0.45, "top_k": 3},
        {"threshold": 0.1, "nms": 0.45, "top_k": 6, "keep": 7},
        {"threshold": 0.1, "nms": 0.45, "top_k": -1, "keep": 0},
    ],
)
def test_detection_output(build: Build, kind: str, shared: bool, limits: dict[str, float]) -> None:
    rng = np.random.default_rng(0)
    images, count, classes = 2, 20, 3
    prior, variance = some_priors(count, rng), np.tile(np.array([0.1, 0.1, 0.2, 0.2], np.float32), (count, 1))
    loc = rng.normal(size=(images, count, 1 if shared else classes, 4)).astype(np.float32)
    scores = rng.uniform(size=(images, count, classes)).astype(np.float32)
    nms = f"nms_threshold: {limits['nms']} eta: {limits.get('eta', 1)}"
    nms += f" top_k: {limits['top_k']}" if "top_k" in limits else ""
    settings = f"num_classes: {classes} share_location: {shared} background_label_id: 1 code_type: {kind}"
    settings += f" nms_param {{ {nms} }}"
    settings += f" confidence_threshold: {limits['threshold']}" if limits["threshold"] > 0 else ""
    settings += f" keep_top_k: {limits['keep']}" if "keep" in limits else ""
    bottoms = [
        torch.from_numpy(loc.reshape(images, -1)),
        torch.from_numpy(scores.reshape(images, -1)),
        torch.from_numpy(np.stack([prior.reshape(-1), variance.reshape(-1)])[None]),
    ]
    layer = build(
        "ssd", f"type: 'DetectionOutput' detection_output_param {{ {settings} }}", *(b.shape for b in bottoms)
    )
    expected = []
    for i in range(images):
        boxes = [
            [decoded(loc[i, p, 0 if shared else label], prior[p], variance[p], kind) for p in range(count)]
            for label in range(classes)
        ]
        top_k = limits.get("top_k", -1)
        rest = {key: limits[key] for key in ("threshold", "nms", "eta", "keep") if key in limits}
        found = detections(boxes, scores[i], 1, top_k=None if top_k < 0 else int(top_k), **rest)  # type: ignore[arg-type]
        expected += [(i, label, score, *box) for label, score, box in found]
    top = run(layer, *bottoms)
    if not expected:
        expected = [(i, *[-1] * 6) for i in range(images)]
    assert top.shape == (1, 1, len(expected), 7)
    np.testing.assert_allclose(top[0, 0], expected, rtol=1e-4, atol=1e-5)


def test_refined_priors_and_those_that_show_no_object(build: Build) -> None:
    rng = np.random.default_rng(1)
    count, kind = 20, "CENTER_SIZE"
    prior, variance = some_priors(count, rng), np.tile(np.array([0.1, 0.1, 0.2, 0.2], np.float32), (count, 1))
    loc, steps = rng.normal(size=(2, 2, count, 4)).astype(np.float32)
    scores, objects = rng.uniform(size=(2, 2, count, 2)).astype(np.float32)
    arrays = [loc, scores, np.stack([prior.reshape(-1), variance.reshape(-1)])[None], objects, steps]
    bottoms = [torch.from_numpy(array.reshape(len(array), -1)) for array in arrays]
    bottoms[2] = torch.from_numpy(arrays[2])
    settings = f"num_classes: 2 code_type: {kind} nms_param {{ nms_threshold: 0.4 }} confidence_threshold: 0.3"
    text = f"type: 'DetectionOutput' detection_output_param {{ {settings} objectness_score: 0.4 }}"
    expected = []
    for i in range(2):
        better = [decoded(steps[i, p], prior[p], variance[p], kind) for p in range(count)]
        boxes = [decoded(loc[i, p], better[p], variance[p], kind) for p in range(count)]
        shown = np.where(objects[i, :, 1:] >= np.float32(0.4), scores[i], 0)
        expected += [(i, label, score, *box) for label, score, box in detections([boxes] * 2, shown, 0, 0.3, 0.4)]
    assert len(expected) > 5
    top = run(build("ssd", text, *(b.shape for b in bottoms)), *bottoms)
    np.testing.assert_allclose(top[0, 0], expected, rtol=1e-4, atol=1e-5)
    with pytest.raises(SpecError, match=r"found a bottom of shape \(2, 20\), expected \(2, 2 P\) for 20 priors"):
        build("ssd", text, *(b.shape for b in bottoms[:3]), (2, 20), (2, 80))


def test_detection_output_with_the_variance_in_the_target(build: Build) -> None:
    settings = (
        "num_classes: 2 variance_encoded_in_target: true confidence_threshold: 0.5 nms_param { nms_threshold: 0 }"
    )
    layer = build("ssd", f"type: 'DetectionOutput' detection_output_param {{ {settings} }}", (1, 4), (1, 2), (1, 2, 4))
    prior = torch.tensor([[[0.1, 0.1, 0.5, 0.5], [9.0, 9.0, 9.0, 9.0]]])
    top = run(layer, torch.full((1, 4), 0.25), torch.tensor([[0.1, 0.9]]), prior)
    np.testing.assert_allclose(top[0, 0], [[0, 1, 0.9, 0.35, 0.35, 0.75, 0.75]], rtol=1e-6)


def test_what_detection_output_does_not_do_is_named(caplog: pytest.LogCaptureFixture) -> None:
    use_dialect("ssd")
    text = """
      layer { name: 'in' type: 'Input' top: 'loc' top: 'conf' top: 'prior' input_param { shape { dim: 1 dim: 4 }
              shape { dim: 1 dim: 2 } shape { dim: 1 dim: 2 dim: 4 } } }
      layer { name: 'out' type: 'DetectionOutput' bottom: 'loc' bottom: 'conf' bottom: 'prior' top: 'out'
              detection_output_param { num_classes: 2 keep_top_k: 3 save_output_param { output_directory: 'x' } } }
    """
    build_net(*parse_net_text(text, "f"), BuildOptions())
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "detection_output_param.save_output_param has no effect" in warning


# ---- All together ----

NET = """
  layer { name: 'in' type: 'Input' top: 'data' input_param { shape { dim: 2 dim: 3 dim: 64 dim: 64 } } }
  layer { name: 'conv' type: 'Convolution' bottom: 'data' top: 'conv'
          convolution_param { num_output: 8 kernel_size: 16 stride: 16 weight_filler { type: 'xavier' } } }
  layer { name: 'norm' type: 'Normalize' bottom: 'conv' top: 'norm'
          norm_param { across_spatial: false channel_shared: false scale_filler { type: 'constant' value: 20 } } }
  layer { name: 'loc' type: 'Convolution' bottom: 'norm' top: 'loc'
          convolution_param { num_output: 16 kernel_size: 3 pad: 1 weight_filler { type: 'xavier' } } }
  layer { name: 'loc_perm' type: 'Permute' bottom: 'loc' top: 'loc_perm'
          permute_param { order: 0 order: 2 order: 3 order: 1 } }
  layer { name: 'loc_flat' type: 'Flatten' bottom: 'loc_perm' top: 'loc_flat' }
  layer { name: 'conf' type: 'Convolution' bottom: 'norm' top: 'conf'
          convolution_param { num_output: 12 kernel_size: 3 pad: 1 weight_filler { type: 'xavier' } } }
  layer { name: 'conf_perm' type: 'Permute' bottom: 'conf' top: 'conf_perm'
          permute_param { order: 0 order: 2 order: 3 order: 1 } }
  layer { name: 'conf_flat' type: 'Flatten' bottom: 'conf_perm' top: 'conf_flat' }
  layer { name: 'prior' type: 'PriorBox' bottom: 'norm' bottom: 'data' top: 'prior'
          prior_box_param { min_size: 20 max_size: 40 aspect_ratio: 2
                            variance: 0.1 variance: 0.1 variance: 0.2 variance: 0.2 } }
  layer { name: 'conf_reshape' type: 'Reshape' bottom: 'conf_flat' top: 'conf_reshape'
          reshape_param { shape { dim: 0 dim: -1 dim: 3 } } include { phase: TEST } }
  layer { name: 'prob' type: 'Softmax' bottom: 'conf_reshape' top: 'prob' softmax_param { axis: 2 }
          include { phase: TEST } }
  layer { name: 'prob_flat' type: 'Flatten' bottom: 'prob' top: 'prob_flat' include { phase: TEST } }
  layer { name: 'out' type: 'DetectionOutput' bottom: 'loc_flat' bottom: 'prob_flat' bottom: 'prior' top: 'out'
          include { phase: TEST }
          detection_output_param { num_classes: 3 nms_param { nms_threshold: 0.45 top_k: 400 } code_type: CENTER_SIZE
                                   keep_top_k: 20 confidence_threshold: 0.01 } }
  layer { name: 'label' type: 'Input' top: 'label' input_param { shape { dim: 1 dim: 1 dim: 2 dim: 8 } }
          include { phase: TRAIN } }
  layer { name: 'loss' type: 'MultiBoxLoss' bottom: 'loc_flat' bottom: 'conf_flat' bottom: 'prior' bottom: 'label'
          top: 'loss' include { phase: TRAIN }
          multibox_loss_param { num_classes: 3 code_type: CENTER_SIZE } }
"""


@pytest.mark.slow
def test_a_small_detector_learns_where_two_squares_are() -> None:
    use_dialect("ssd")
    net, source = parse_net_text(NET, "f")
    net.state.phase = TRAIN
    train = build_net(net, source, BuildOptions(seed=1))
    net.state.phase = TEST
    test = build_net(net, source, BuildOptions(seed=1))
    image = torch.zeros(2, 3, 64, 64)
    image[0, :, 10:40, 5:35] = 1
    image[1, 1, 30:60, 30:50] = 1
    truth = torch.tensor(
        [[0, 1, 0, 5 / 64, 10 / 64, 35 / 64, 40 / 64, 0], [1, 2, 0, 30 / 64, 30 / 64, 50 / 64, 60 / 64, 0]]
    ).reshape(1, 1, 2, 8)
    optimizer = torch.optim.Adam([p.parameter for p in train.learnable], lr=0.01)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss, _ = train.forward_loss(data=image, label=truth)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    test.share_weights_with(train)
    out = test(data=image)["out"][0, 0]
    for i, row in enumerate(truth[0, 0]):
        best = max(out[out[:, 0] == i], key=lambda found: float(found[2]))
        assert best[1] == row[1]
        assert overlap(tuple(best[3:].tolist()), tuple(row[3:7].tolist())) > 0.7


def test_what_the_solver_of_ssd_has_more_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    use_dialect("ssd")
    (tmp_path / "solver.prototxt").write_text(
        'net_param { layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } } }\n'
        'base_lr: 1 lr_policy: "fixed" eval_type: "detection"'
    )
    load_solver(tmp_path / "solver.prototxt")
    assert "solver.prototxt:2:31: eval_type has no effect: it is a fork's" in caplog.text


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bound", [math.inf, 3e38, 3e19])
def test_boxes_without_bounds_suppress_none(bound: float) -> None:
    """What a net that was not trained predicts: exp of anything."""
    without, plain = [-bound, -bound, bound, bound], [0.1, 0.1, 0.4, 0.4]
    assert suppress(np.array([without, plain, without, plain], np.float32), 0.45) == [0, 1, 2]
    codes = np.array([[bound, -bound, bound, bound]], np.float32)
    assert not np.isfinite(decode(codes, np.array([plain], np.float32), None, CENTER_SIZE)).all()
