"""SSD's layers in special cases, its warnings, and a small detector that is trained."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from netspec import use_dialect
from netspec.dialects.boxes import CENTER_SIZE, decode, overlaps, suppress
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Layer
from netspec.load import load_solver
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.text import parse_net_text

Build = Callable[..., Layer]


# ---- Permute, Normalize ----


def test_normalize_scale_is_initialized_to_one(build: Build) -> None:
    assert build("ssd", "type: 'Normalize'", (2, 3, 4, 5)).blobs[0] == 1


# ---- PriorBox ----


@pytest.mark.parametrize("ratios", [[], [1.0], [1.0, 4.0]], ids=["none", "1", "1_and_4"])
def test_boxes_of_faceboxes_are_spread_over_their_size(build: Build, ratios: list[float]) -> None:
    given = "".join(f"fixed_ratio: {ratio} " for ratio in ratios) or "aspect_ratio: 4 flip: false"
    settings = f"fixed_size: 32 fixed_size: 65 density: 4 density: 2 step: 32 {given}"
    bottoms = torch.zeros(1, 1, 2, 3), torch.zeros(1, 3, 64, 96)
    layer = build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", *(x.shape for x in bottoms))
    found = layer.run(*bottoms)[0]
    expected = []
    for row, column in itertools.product(range(2), range(3)):
        for size, density in ((32, 4), (65, 2)):
            apart = size // density
            for ratio, i, j in itertools.product(ratios or [1.0, 4.0], range(density), range(density)):
                x, y = (32 * k + 16 - size // 2 + apart / 2 + apart * n for k, n in ((column, j), (row, i)))
                wide, high = size * ratio**0.5 / 2, size / ratio**0.5 / 2
                expected += [max(x - wide, 0) / 96, max(y - high, 0) / 64]
                expected += [min((x + wide) / 96, 1), min((y + high) / 64, 1)]
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-6)


def test_boxes_of_faceboxes_and_of_ssd_may_be_in_one_net(net_of: Callable[..., Net]) -> None:
    net = net_of("""
    layer { name: 'x' type: 'Input' top: 'x' input_param { shape { dim: [1, 1, 4, 4] } } }
    layer { name: 'p' type: 'Permute' bottom: 'x' top: 'p' permute_param { order: 0 order: 2 } }
    layer { name: 'f' type: 'PriorBox' bottom: 'x' bottom: 'x' top: 'f' prior_box_param { fixed_size: 2 density: 2 } }
    layer { name: 's' type: 'PriorBox' bottom: 'x' bottom: 'x' top: 's' prior_box_param { min_size: 2 } }
    """)
    assert [net.shapes[name] for name in "fs"] == [(1, 2, 4 * 16 * 4), (1, 2, 4 * 16)]


@pytest.mark.parametrize(
    ("settings", "column"),
    [("fixed_size: 2", 36), ("fixed_size: 2 density: 0", 36), ("fixed_size: 2 density: 1 fixed_ratio: 0", 61)],
    ids=["no_density", "density_0", "ratio_0"],
)
def test_wrong_boxes_of_faceboxes_are_refused(build: Build, settings: str, column: int) -> None:
    with pytest.raises(SpecError) as caught:
        build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", (1, 1, 2, 2), (1, 1, 2, 2))
    assert caught.value.where is not None
    assert (caught.value.where.type, caught.value.where.column) == ("PriorBox", column)


def test_prior_box_warns_of_sizes_cut_to_whole_pixels(build: Build, caplog: pytest.LogCaptureFixture) -> None:
    settings = "min_size: 9.2 min_size: 12 max_size: 11.5 max_size: 20 img_size: 60"
    build("ssd", f"type: 'PriorBox' prior_box_param {{ {settings} }}", (1, 1, 2, 2))
    cut, other = caplog.messages
    place = '<layer>:1:36: layer "" (PriorBox): '
    assert cut.startswith(f"{place}min_size is cut to whole pixels, as in SSD: 9.2 to 9; OpenCV and some forks keep it")
    assert "max_size is cut to whole pixels, as in SSD: 11.5 to 11" in other
    caplog.clear()
    build("ssd", "type: 'PriorBox' prior_box_param { min_size: 30 img_size: 60 }", (1, 1, 2, 2))
    assert not caplog.messages


# ---- DetectionOutput ----


def test_detection_output_with_the_variance_encoded_in_the_target(build: Build) -> None:
    settings = (
        "num_classes: 2 variance_encoded_in_target: true confidence_threshold: 0.5 nms_param { nms_threshold: 0 }"
    )
    layer = build("ssd", f"type: 'DetectionOutput' detection_output_param {{ {settings} }}", (1, 4), (1, 2), (1, 2, 4))
    prior = torch.tensor([[[0.1, 0.1, 0.5, 0.5], [9.0, 9.0, 9.0, 9.0]]])
    (top,) = layer.run(torch.full((1, 4), 0.25), torch.tensor([[0.1, 0.9]]), prior)
    np.testing.assert_allclose(top[0, 0], [[0, 1, 0.9, 0.35, 0.35, 0.75, 0.75]], rtol=1e-6)


def test_unsupported_fields_of_detection_output_get_a_warning(caplog: pytest.LogCaptureFixture) -> None:
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


# ---- A detector ----


def test_solver_fields_of_ssd_without_effect_get_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    use_dialect("ssd")
    (tmp_path / "solver.prototxt").write_text(
        'net_param { layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } } }\n'
        'base_lr: 1 lr_policy: "fixed" eval_type: "detection"'
    )
    load_solver(tmp_path / "solver.prototxt")
    assert "solver.prototxt:2:31: eval_type has no effect: it is a fork's" in caplog.text


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bound", [math.inf, 3e38, 3e19])
def test_infinite_boxes_do_not_suppress_other_boxes(bound: float) -> None:
    """A net that was not trained predicts such boxes, since it computes exp of large values."""
    without, plain = [-bound, -bound, bound, bound], [0.1, 0.1, 0.4, 0.4]
    assert suppress(np.array([without, plain, without, plain], np.float32), 0.45) == [0, 1, 2]
    codes = np.array([[bound, -bound, bound, bound]], np.float32)
    assert not np.isfinite(decode(codes, np.array([plain], np.float32), None, CENTER_SIZE)).all()


@pytest.mark.parametrize(("threshold", "eta"), [(0.45, 1.0), (0.3, 1.0), (0.9, 0.9)])
def test_boxes_in_blocks_are_kept_as_one_by_one(threshold: float, eta: float) -> None:
    random = np.random.default_rng(0)
    corners = random.uniform(0, 0.6, (150, 2))
    boxes = np.concatenate([corners, corners + random.uniform(0.05, 0.4, (150, 2))], 1).astype(np.float32)
    limit, kept = np.float32(threshold), list[int]()
    for i in range(len(boxes)):
        if all(overlaps(boxes[k], boxes[i]) <= limit for k in kept):
            kept.append(i)
            limit *= np.float32(eta) if eta < 1 and limit > 0.5 else np.float32(1)
    assert 32 < len(kept) < 150
    assert suppress(boxes, threshold, eta) == kept
