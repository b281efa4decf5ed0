"""The relative pose of two images, from points whose true places are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loopclosure.closing.relative import METRIC, ROTATION_ONLY, UP_TO_SCALE, View, relative_view
from loopclosure.detector.verification import LocalFeatures
from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics, from_text

CAMERA = Intrinsics(260, 262, 159.5, 119.5)
POINTS = 120
WRONG = 30
TURN = Rotation.from_euler("yx", [8, -3], degrees=True)


def views(step: np.ndarray, depth: bool = False) -> tuple[View, View, np.ndarray]:
    """Two views of points at 2 to 6 m; the second camera is turned and moved by ``step``. A quarter do not match."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (POINTS, 3))
    pixels, maps = [], []
    for seen in (points, TURN.inv().apply(points - step)):
        at = seen[:, :2] / seen[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        pixels.append((at + rng.normal(0, 0.3, at.shape)).astype(np.float32))
        # Each point on a small patch of its own depth, as of a surface; where patches meet, depth is not used.
        image = np.zeros((240, 320), np.float32)
        for (x, y), z in zip(np.rint(at).astype(int), seen[:, 2], strict=True):
            image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = z
        maps.append(image if depth else None)
    matches = np.stack([np.arange(POINTS)] * 2, axis=1)
    matches[:WRONG, 1] = np.roll(matches[:WRONG, 1], 7)
    none = np.zeros((POINTS, 128), np.uint8)
    first, second = (View(LocalFeatures(at, none), CAMERA, image) for at, image in zip(pixels, maps, strict=True))
    return first, second, matches


def degrees_off(pose: np.ndarray) -> float:
    return float(np.degrees((TURN.inv() * Rotation.from_quat(pose[3:])).magnitude()))


def test_depth_gives_meters() -> None:
    step = np.array([0.4, -0.1, 0.3])
    first, second, matches = views(step, depth=True)
    for one, other in ((first, second), (first, View(second.local, CAMERA)), (View(first.local, CAMERA), second)):
        found = relative_view(one, other, matches)
        assert found is not None
        assert found.kind == METRIC
        np.testing.assert_allclose(found.pose[:3], step, atol=0.03)
        assert degrees_off(found.pose) < 0.5


def test_color_gives_the_direction_without_the_length() -> None:
    step = np.array([0.4, -0.1, 0.3])
    found = relative_view(*views(step))
    assert found is not None
    assert found.kind == UP_TO_SCALE
    assert np.linalg.norm(found.pose[:3]) == pytest.approx(1)
    assert found.pose[:3] @ step / np.linalg.norm(step) > np.cos(np.radians(5))
    assert degrees_off(found.pose) < 0.5
    assert found.inliers >= 80


def test_a_camera_that_only_turned_gives_a_rotation_only() -> None:
    found = relative_view(*views(np.zeros(3)))
    assert found is not None
    assert found.kind == ROTATION_ONLY
    assert found.pose[:3].tolist() == [0, 0, 0]
    assert degrees_off(found.pose) < 0.2


def test_points_that_do_not_agree_give_nothing() -> None:
    first, second, matches = views(np.array([0.4, 0, 0]))
    assert relative_view(first, second, matches[:19]) is None
    scrambled = np.stack([matches[:, 0], np.random.default_rng(1).permutation(POINTS)], axis=1)
    assert relative_view(first, second, scrambled) is None


def test_the_camera_of_smaller_images_and_of_text() -> None:
    camera = from_text("517.3,516.5,318.6,255.3,0.26,-0.95,-0.005,0.003,1.16")
    assert camera.distortion == (0.26, -0.95, -0.005, 0.003, 1.16)
    assert camera.of_size(320, 240) == camera  # of which size it is, is not known
    full = Intrinsics(520, 520, 319.5, 239.5, size=(640, 480))
    half = full.of_size(320, 240)
    assert (half.fx, half.cx, half.cy) == (260, 159.5, 119.5)
    np.testing.assert_allclose(full.rays(np.array([[639.5, 239.5]])), half.rays(np.array([[319.5, 119.5]])))
    for wrong in ("517,516", "a,b,c,d", "0,1,2,3"):
        with pytest.raises(InputError):
            from_text(wrong)
