"""Images, cameras and poses from messages of ROS 1 and ROS 2: those of a bag, or those that a node receives."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopclosure.places.intrinsics import COUNTS, FISHEYE, PINHOLE, Intrinsics
from loopclosure.places.pixels import compressed_pixels, eight_bits, raw_pixels


def pixels_of(message: Any) -> np.ndarray:
    """Return the pixels (H, W, 3) BGR, uint8 or uint16, of an Image or CompressedImage.

    Raises InputError for other encodings.
    """
    return raw_pixels(message) if hasattr(message, "encoding") else compressed_pixels(message)


def image_of(message: Any, least: int = 8) -> np.ndarray:
    """Return the image (H, W, 3) uint8 BGR of a message; of 16 bits, those that it uses, and at ``least`` so many."""
    return eight_bits(pixels_of(message), least)


def camera_of(message: Any) -> Intrinsics | None:
    """Return the camera of a CameraInfo; None if it is not calibrated, or of another model than pinhole and fisheye."""
    k, d = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)  # ROS 1, 2
    fisheye = message.distortion_model in (FISHEYE, "fisheye") and len(d) == 4
    pinhole = message.distortion_model in PINHOLE and len(d) in COUNTS
    if not (k[0] > 0 and (pinhole or fisheye)):
        return None
    bent = tuple(float(value) for value in d) if np.any(d) or fisheye else ()
    size = (int(message.width), int(message.height))
    return Intrinsics(float(k[0]), float(k[4]), float(k[2]), float(k[5]), bent, size, fisheye)


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
