"""Images, cameras and poses from messages of ROS 1 and ROS 2: those of a bag, or those that a node receives."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.intrinsics import COUNTS, FISHEYE, PINHOLE, Intrinsics
from loopclosure.places.pixels import eight_bits
from netspec.files.opencv import cv2

# Names of OpenCV's types for encodings of ROS.
_ENCODINGS = {"8uc1": "mono8", "8uc3": "bgr8", "8uc4": "bgra8", "16uc1": "mono16", "16uc3": "bgr16", "16uc4": "bgra16"}
_HALF = ("nv12", "nv21")  # of half the resolution, in a plane below the gray values: colors
MISSING = "the library rosbags-image is not installed: pip install 'netspec-caffe[bag]'"


def image_of(message: Any, least: int = 8) -> np.ndarray:
    """Return the image (H, W, 3) uint8 BGR of a message; of 16 bits, those that it uses, and at ``least`` so many."""
    return eight_bits(pixels_of(message), least)


def pixels_of(message: Any) -> np.ndarray:
    """Return the pixels (H, W, 3) BGR, uint8 or uint16, of an Image or CompressedImage.

    Raises InputError if they cannot be decoded.
    """
    try:
        from rosbags.image import image as library
    except ImportError:
        raise InputError(MISSING) from None
    encoding = message.format if hasattr(message, "format") else message.encoding
    name: Any = _ENCODINGS.get(encoding.strip().lower(), encoding.strip().lower())
    try:
        if hasattr(message, "format"):
            if "compresseddepth" in encoding.lower():
                raise ValueError("depth, not an image")
            found = library.message_to_cvimage(message)
            return found if found.ndim == 3 else cv2.cvtColor(found, cv2.COLOR_GRAY2BGR)
        bits, _, kind, channels = library.to_cvtype(name)
        lines, wide = message.height * (3 if name in _HALF else 2) // 2, message.width * channels
        rows = np.frombuffer(message.data, np.uint8)[: lines * message.step].reshape(lines, message.step)
        data = np.ascontiguousarray(rows[:, : wide * np.dtype(kind).itemsize])  # a row may be longer than its pixels
        tight: Any = SimpleNamespace(encoding=name, height=lines, width=message.width, data=data)
        tight.is_bigendian = bool(message.is_bigendian)
        return library.message_to_cvimage(tight, "bgr16" if bits == 16 else "bgr8")
    except (library.ImageError, AssertionError, TypeError, ValueError, cv2.error) as fault:
        reason = " ".join(str(fault).split()) or "it is damaged"
        raise InputError(f'an image in "{encoding}" that cannot be read ({reason})') from None


def is_rectified(topic: str) -> bool:
    """Return whether the images of a topic are rectified, as ``/camera/image_rect``."""
    return bool(re.search(r"[/_]rect(?![a-z])|rectified", topic))


def camera_of(message: Any, rectified: bool = False) -> Intrinsics | None:
    """Return the camera of the images that a CameraInfo belongs to.

    Of ``rectified`` images, P has the camera, without distortion; of others, K and D. Both are those of the whole
    sensor, of which the images may be a part, with pixels that are joined. None if it is not calibrated, or of another
    model than pinhole and fisheye.
    """
    names = "KDP" if hasattr(message, "K") else "kdp"  # ROS 1, or ROS 2
    k, d, p = (getattr(message, name) for name in names)
    fisheye = message.distortion_model in (FISHEYE, "fisheye") and len(d) == 4 and not rectified
    pinhole = rectified or (message.distortion_model in PINHOLE and len(d) in COUNTS)
    fx, cx, fy, cy = (float(each) for each in ((p[0], p[2], p[5], p[6]) if rectified else (k[0], k[2], k[4], k[5])))
    if not (fx > 0 and fy > 0 and (pinhole or fisheye)):
        return None
    bent = tuple(float(value) for value in d) if not rectified and (np.any(d) or fisheye) else ()
    roi, x, y = message.roi, max(1, message.binning_x), max(1, message.binning_y)
    size = (roi.width or message.width) // x, (roi.height or message.height) // y
    return Intrinsics(fx / x, fy / y, (cx - roi.x_offset) / x, (cy - roi.y_offset) / y, bent, size, fisheye)


def pose_of(message: Any) -> np.ndarray:
    """Return the pose (7,), tx ty tz qx qy qz qw, of an Odometry, a stamped pose or a stamped transform."""
    inner = getattr(message, "transform", None) or message.pose
    inner = getattr(inner, "pose", inner)  # with covariance
    place = getattr(inner, "translation", None) or inner.position
    turn = getattr(inner, "rotation", None) or inner.orientation
    return np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])


def seconds(stamp: Any) -> float:
    """Return a time of ROS 2, with ``sec`` and ``nanosec``, in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec
