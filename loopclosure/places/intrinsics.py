"""Camera intrinsics: from ``calibration.txt``, EuRoC's ``sensor.yaml``, KITTI's ``calib.txt``, or numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

FORM = "FX,FY,CX,CY or FX,FY,CX,CY,K1,K2,P1,P2 or FX,FY,CX,CY,K1,K2,P1,P2,K3"
FISHEYE = "equidistant"  # the name of the model in sensor.yaml, in CameraInfo and in calibration.txt
PINHOLE = ("radial-tangential", "radtan", "plumb_bob", "rational_polynomial", "")
FARTHEST = 20.0  # of a point in the plane at depth 1: 87 degrees from the axis
COUNTS = (0, 4, 5, 8)  # of OpenCV's coefficients for a pinhole camera; a fisheye has 4


@dataclass(frozen=True)
class Intrinsics:
    """A camera: focal lengths and principal point in pixels, OpenCV's distortion (k1 k2 p1 p2 [k3 [k4 k5 k6]]).

    ``size`` is the (width, height) in pixels of the calibrated images, None if not known. A ``fisheye`` has the
    equidistant model with k1 k2 k3 k4 (Kannala and Brandt, PAMI 2006), as TUM-VI.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    size: tuple[int, int] | None = None
    fisheye: bool = False

    def of_size(self, width: int, height: int) -> Intrinsics:
        """Return the camera for images scaled to this size; integer coordinates are pixel centers."""
        if self.size is None or self.size == (width, height):
            return self
        x, y = width / self.size[0], height / self.size[1]
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=cx, cy=cy, size=(width, height))

    def rays(self, points: np.ndarray) -> np.ndarray:
        """Convert pixels (N, 2) to undistorted points (N, 2) in the plane at depth 1.

        Pixels of a fisheye that look sideways or back have no such point; they are NaN.
        """
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        pixels = np.asarray(points, np.float64).reshape(-1, 1, 2)
        bent = np.array(self.distortion or (0.0,) * 4)
        if not self.fisheye:
            return cv2.undistortPoints(pixels, matrix, bent).reshape(-1, 2)
        if not len(pixels):
            return np.zeros((0, 2))
        points = cv2.fisheye.undistortPoints(pixels, matrix, bent).reshape(-1, 2)
        # OpenCV limits the distance from the center, as it is drawn, to that of a right angle.
        drawn = np.linalg.norm((pixels[:, 0] - (self.cx, self.cy)) / (self.fx, self.fy), axis=1, keepdims=True)
        ahead = (drawn < np.pi / 2) & (np.abs(points).max(axis=1, keepdims=True) < FARTHEST)
        return np.where(ahead, points, np.nan)


def from_text(text: str) -> Intrinsics:
    """Parse the numbers of a ``--camera`` option. Raises InputError for other text."""
    numbers = _floats(text.split(","))
    if len(numbers) not in (4, 8, 9):
        raise InputError(f'expected {FORM} in pixels, found "{text}"')
    return _checked(numbers[:4], numbers[4:], None, "")


def write_calibration(path: Path, camera: Intrinsics) -> None:
    """Write ``calibration.txt``, which :func:`read_intrinsics` reads."""
    size = camera.size or (0, 0)
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *size, *camera.distortion]
    names = " k1 k2 k3 k4 model" if camera.fisheye else " k1 k2 p1 p2 k3 k4 k5 k6"[: 3 * len(camera.distortion)]
    row = " ".join([*(f"{number:.9g}" for number in numbers), *([FISHEYE] if camera.fisheye else [])])
    write_whole(path, f"# fx fy cx cy width height{names}\n{row}\n")


def read_intrinsics(path: Path, camera: str = "") -> Intrinsics:
    """Read a calibration: ``sensor.yaml``, ``calib.txt`` (with ``camera``, P0 to P3), or ``calibration.txt``.

    ``calibration.txt`` has one row: fx fy cx cy width height, followed by k1 k2 p1 p2 [k3 [k4 k5 k6]] if there is
    distortion, or by k1 k2 k3 k4 and the word "equidistant" for a fisheye.
    Raises InputError for other files.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        raise InputError("cannot be read as text; expected the camera's calibration", path) from None
    if path.suffix == ".yaml":
        model = re.search(r"^distortion_model\s*:\s*(\S+)", text, re.MULTILINE)
        fisheye = model is not None and model[1] == FISHEYE
        if model and not fisheye and model[1] not in PINHOLE:
            expected = f"expected radial-tangential or {FISHEYE}"
            raise InputError(f"distortion model {model[1]} is not supported; {expected}", path)
        size = yaml_numbers(text, "resolution", 2, path)
        inner = yaml_numbers(text, "intrinsics", 4, path)
        found = _checked(inner, yaml_numbers(text, "distortion_coefficients", 4, path), size, path)
        return replace(found, fisheye=fisheye)
    if camera:
        matrix = kitti_projection(text, camera, path)
        return _checked([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], [], None, path)
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    fisheye = len(rows) == 1 and rows[0][-1] == FISHEYE
    numbers = _floats(rows[0][:-1] if fisheye else rows[0]) if len(rows) == 1 else []
    if len(numbers) - 6 not in ((4,) if fisheye else COUNTS):
        raise InputError("expected one row: fx fy cx cy width height, and k1 k2 p1 p2 [k3] with distortion", path)
    return replace(_checked(numbers[:4], numbers[6:], numbers[4:6], path), fisheye=fisheye)


def yaml_numbers(text: str, key: str, count: int, path: Path) -> list[float]:
    """Return the ``count`` numbers in brackets behind ``key:`` in a YAML text, on one line or several."""
    found = re.search(rf"^[ \t]*{key}[ \t]*:\s*\[([^\]]*)\]", text, re.MULTILINE)
    numbers = _floats(found[1].split(",")) if found else []
    if len(numbers) != count:
        raise InputError(f'expected "{key}: [...]" with {count} numbers, as in the sensor.yaml of EuRoC', path)
    return numbers


def kitti_projection(text: str, camera: str, path: Path) -> np.ndarray:
    """Return the projection (3, 4) of a ``camera``, P0 to P3, from the text of KITTI's ``calib.txt``."""
    found = re.search(rf"^{camera}\s*:(.*)$", text, re.MULTILINE)
    numbers = _floats(found[1].split()) if found else []
    known = len(numbers) == 12 and np.all(np.isfinite(numbers))
    matrix = np.array(numbers).reshape(3, 4) if known else np.zeros((3, 4))
    if not (matrix[0, 0] > 0 and np.linalg.matrix_rank(matrix[:, :3]) == 3):
        raise InputError(f'expected "{camera}:" and the twelve numbers of a projection, as in KITTI\'s calib.txt', path)
    return matrix


def _floats(parts: Sequence[str]) -> list[float]:
    """Parse numbers; return an empty list if one of them is not a number."""
    try:
        return [float(part) for part in parts]
    except ValueError:
        return []


def _checked(
    inner: Sequence[float], distortion: Sequence[float], size: Sequence[float] | None, path: str | Path
) -> Intrinsics:
    values = [*inner, *distortion, *(size or ())]
    if not np.all(np.isfinite(values)) or min(inner[:2]) <= 0:
        raise InputError(f"a camera has focal lengths above 0, not {inner[0]:g} and {inner[1]:g}", path)
    known = (int(size[0]), int(size[1])) if size is not None and min(size) > 0 else None
    return Intrinsics(inner[0], inner[1], inner[2], inner[3], tuple(distortion), known)
