"""Cameras of pinhole and fisheye models: pixels and rays are inverse, and files keep them."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics, read_intrinsics, write_calibration
from loopclosure.places.messages import camera_of
from places_layouts import write_euroc

BENT = (0.02, -0.004, 0.001, 0.0005)
FISHEYE = Intrinsics(190.0, 191.0, 254.9, 256.9, BENT, (512, 512), fisheye=True)


def test_points_of_a_fisheye_are_undistorted() -> None:
    """Seen from TUM-VI's camera, of 195 degrees."""
    rays = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    # An angle t from the axis is drawn k1 t^3 + ... away from the center.
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    t = np.arctan(lengths)
    bent = t * (1 + sum(k * t ** (2 * i + 2) for i, k in enumerate(BENT)))
    pixels = rays / lengths * bent * [190.0, 191.0] + [254.9, 256.9]
    np.testing.assert_allclose(FISHEYE.rays(pixels), rays, atol=1e-4)
    half = FISHEYE.of_size(256, 256)
    np.testing.assert_allclose(half.rays((pixels + 0.5) / 2 - 0.5), rays, atol=1e-4)
    assert np.isnan(FISHEYE.rays(np.array([[600.0, 257.0]]))).all()  # sideways: it has no point ahead
    assert FISHEYE.rays(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    "camera",
    [
        FISHEYE,
        Intrinsics(300.5, 301.0, 159.5, 119.5),
        Intrinsics(300.5, 301.0, 159.5, 119.5, (0.1, -0.2, 0.001, 0.002), (320, 240)),
        Intrinsics(300.5, 301.0, 159.5, 119.5, (0.1, -0.2, 0.001, 0.002, 0.01), (320, 240)),
        Intrinsics(300.5, 301.0, 159.5, 119.5, (0.1, -0.2, 0.001, 0.002, 0.01, 0.3, 0.02, 0.001), (320, 240)),
    ],
)
def test_a_camera_is_written_and_read(camera: Intrinsics, tmp_path: Path) -> None:
    write_calibration(tmp_path / "calibration.txt", camera)
    assert read_intrinsics(tmp_path / "calibration.txt") == camera
    rays = camera.rays(np.array([[150.0, 100.0]]))
    assert np.isfinite(rays).all()


def test_a_calibration_of_another_form_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "calibration.txt"
    for row in ("1 2 3", "190 191 254 256 512 512 1 2 3 equidistant", "190 191 254 256 512 512 fisheye"):
        file.write_text(row)
        with pytest.raises(InputError, match="expected one row: fx fy cx cy width height"):
            read_intrinsics(file)


def test_tum_vi_has_a_fisheye(tmp_path: Path) -> None:
    sensor = write_euroc(tmp_path) / "mav0" / "cam0" / "sensor.yaml"
    sensor.write_text(sensor.read_text().replace("radial-tangential", "equidistant"))
    camera = read_intrinsics(sensor)
    assert camera.fisheye
    assert camera.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)


@pytest.mark.parametrize(
    ("model", "count", "fisheye"),
    [("plumb_bob", 5, False), ("rational_polynomial", 8, False), ("equidistant", 4, True), ("fisheye", 4, True)],
)
def test_models_of_a_camera_info(model: str, count: int, fisheye: bool) -> None:
    k = np.array([300.0, 0, 160, 0, 301, 120, 0, 0, 1])
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    message = SimpleNamespace(
        p=[0] * 12,
        roi=roi,
        binning_x=0,
        binning_y=0,
        distortion_model=model,
        k=k,
        d=np.full(count, 0.01),
        width=320,
        height=240,
    )
    camera = camera_of(message)
    assert camera is not None
    assert (camera.fisheye, len(camera.distortion), camera.size) == (fisheye, count, (320, 240))
    for fault in ({"distortion_model": "omni"}, {"d": np.zeros(3)}, {"k": np.zeros(9)}):
        assert camera_of(SimpleNamespace(**{**vars(message), **fault})) is None


def test_the_rational_model_is_that_of_opencv() -> None:
    bent = (0.1, -0.2, 0.001, 0.002, 0.01, 0.3, 0.02, 0.001)
    camera, matrix = Intrinsics(300.0, 301.0, 160.0, 120.0, bent), np.array([[300.0, 0, 160], [0, 301, 120], [0, 0, 1]])
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(bent))[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.rays(pixels), points[:, :2], atol=1e-4)
