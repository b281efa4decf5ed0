"""Images, cameras and poses from messages of ROS 1 and ROS 2: those of a bag, or those that a node receives."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics
from netspec.files.opencv import cv2

BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
}
TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR, **BAYER}
CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, **dict.fromkeys(BAYER, 1)}


def image_of(message: Any) -> np.ndarray:
    """Return the image (H, W, 3) uint8 BGR of an Image or CompressedImage. Raises InputError for other encodings."""
    if not hasattr(message, "encoding"):
        image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError("a compressed image that cannot be read")
        return image
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise InputError(f'images in "{message.encoding}"; known: {", ".join(CHANNELS)}')
    data = np.frombuffer(message.data, np.uint8)
    if message.step < message.width * channels or data.size < message.height * message.step:
        size = f"{message.width}x{message.height}"
        raise InputError(
            f"an image of {size} in {message.encoding} has rows of {message.step} bytes, {data.size} in all"
        )
    rows = data[: message.height * message.step].reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if message.encoding in TO_BGR:
        return cv2.cvtColor(image, TO_BGR[message.encoding])
    return np.repeat(image, 3, axis=2) if channels == 1 else image


def camera_of(message: Any) -> Intrinsics | None:
    """Return the camera of a CameraInfo; None if it is not calibrated, or not a pinhole camera."""
    k, d = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)  # ROS 1, 2
    pinhole = message.distortion_model in ("plumb_bob", "") and len(d) in (0, 4, 5)
    if not (k[0] > 0 and pinhole):
        return None
    bent = tuple(float(value) for value in d) if np.any(d) else ()
    size = (int(message.width), int(message.height))
    return Intrinsics(float(k[0]), float(k[4]), float(k[2]), float(k[5]), bent, size)


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
