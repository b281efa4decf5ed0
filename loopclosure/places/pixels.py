"""Converts images of any encoding to BGR, and those of 16 bits to 8, as cv_bridge names the encodings of ROS."""

from __future__ import annotations

from typing import Any

import numpy as np

from loopclosure.errors import InputError
from netspec.files.opencv import cv2

BITS = (8, 10, 12, 14, 16)  # of cameras
BAYER = {
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
TO_BGR = {"mono": cv2.COLOR_GRAY2BGR, "rgb": cv2.COLOR_RGB2BGR, "rgba": cv2.COLOR_RGBA2BGR, "bgr": None}
TO_BGR |= {"bgra": cv2.COLOR_BGRA2BGR, **BAYER}
CHANNELS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}  # the others have one
UNSIGNED = {"C1": "mono", "C3": "bgr", "C4": "bgra"}  # 8UC3 is bgr8, as cv_bridge takes it
# Each encoding: the colors of its pixels, and their bits.
ENCODINGS = {f"{colors}{bits}": (colors, bits) for bits in (8, 16) for colors in TO_BGR}
ENCODINGS |= {f"{bits}U{name}": (colors, bits) for bits in (8, 16) for name, colors in UNSIGNED.items()}
# Colors that two pixels share: interleaved, or in a plane of their own.
PACKED = {
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
}
PLANAR = {"nv12": cv2.COLOR_YUV2BGR_NV12, "nv21": cv2.COLOR_YUV2BGR_NV21}
_NAMES = {name.lower(): name for name in (*ENCODINGS, *PACKED, *PLANAR)}


def bits_of(image: np.ndarray) -> int:
    """Return how many bits the values of an image use: cameras of 10, 12 or 14 bits write the low bits of 16."""
    brightest = int(image.max(initial=0))
    return next(bits for bits in BITS if brightest < 1 << bits)


def eight_bits(image: np.ndarray, least: int = 8) -> np.ndarray:
    """Convert pixels of 16 bits to 8 bits.

    least  how many bits other images of the same camera use: a dark image uses fewer, and must stay dark
    """
    if image.dtype != np.uint16:
        return image
    return (image >> (max(least, bits_of(image)) - 8)).astype(np.uint8)


def raw_pixels(message: Any) -> np.ndarray:
    """Return the pixels (H, W, 3) BGR, uint8 or uint16, of a message Image.

    Raises InputError if its encoding is not known, or if it is too short.
    """
    name = _NAMES.get(message.encoding.strip().lower())
    if name is None:
        raise InputError(f'images in "{message.encoding}"; known: {", ".join(_NAMES.values())}')
    height, width, step = message.height, message.width, message.step
    planar = name in PLANAR
    colors, bits = ENCODINGS.get(name, ("", 8))
    channels = 2 if name in PACKED else CHANNELS.get(colors, 1)
    rows, wide = height * 3 // 2 if planar else height, width * channels * bits // 8
    data = np.frombuffer(message.data, np.uint8)
    if step < wide or data.size < rows * step:
        raise InputError(
            f"an image of {width}x{height} in {message.encoding} has rows of {step} bytes, {data.size} in all"
        )
    pixels = np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :wide])
    if bits == 16:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    if name in PACKED or planar:
        return cv2.cvtColor(pixels if planar else pixels.reshape(height, width, 2), (PACKED | PLANAR)[name])
    return _bgr(pixels.reshape(height, width, channels), colors)


def compressed_pixels(message: Any) -> np.ndarray:
    """Return the pixels (H, W, 3) BGR, uint8 or uint16, of a message CompressedImage.

    Its ``format`` is "jpeg", or "ENCODING; jpeg compressed TARGET": the pixels were converted to TARGET, or are still
    in ENCODING if there is none. A mosaic of Bayer's is then coded as a gray image.
    Raises InputError if it cannot be decoded.
    """
    before, _, after = message.format.partition(";")
    target = after.rpartition("compressed")[2].strip().lower()
    if "compresseddepth" in after.lower():
        raise InputError(f'depth, not images ("{message.format}")')
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError("a compressed image that cannot be read")
    colors = ENCODINGS.get(_NAMES.get(target or before.strip().lower(), ""), ("", 0))[0]
    if image.ndim == 2:
        return _bgr(image[..., None], colors if colors in BAYER else "mono")
    return _bgr(image, "bgra" if image.shape[2] == 4 else "bgr")


def _bgr(image: np.ndarray, colors: str) -> np.ndarray:
    """Convert pixels (H, W, channels) to BGR."""
    code = TO_BGR[colors]
    return np.ascontiguousarray(image if code is None else cv2.cvtColor(image, code))
