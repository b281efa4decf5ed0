"""Pixels of all encodings become the same picture; images of 10 to 16 bits are neither black nor clipped."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from loopclosure.places.messages import camera_of, image_of, is_rectified
from loopclosure.places.pixels import eight_bits

pytest.importorskip("rosbags.image")
BAYER = ("bayer_rggb", "bayer_bggr", "bayer_gbrg", "bayer_grbg")
ENCODINGS = {
    f"{colors}{bits}": (colors, bits) for bits in (8, 16) for colors in ("mono", "rgb", "rgba", "bgr", "bgra", *BAYER)
}
ENCODINGS |= {
    f"{bits}UC{n}": (colors, bits) for bits in (8, 16) for n, colors in ((1, "mono"), (3, "bgr"), (4, "bgra"))
}
PACKED, PLANAR = ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), ("nv12", "nv21")
RNG = np.random.default_rng(5)
# Smooth, so that colors which pixels share are exact enough.
PICTURE = cv2.resize(RNG.integers(30, 220, (3, 4, 3), np.uint8), (32, 24), interpolation=cv2.INTER_CUBIC)
GRAY = cv2.cvtColor(PICTURE, cv2.COLOR_BGR2GRAY)


def mosaic(colors: str) -> np.ndarray:
    """What a sensor behind a filter of Bayer's sees: the first two letters are its first row."""
    seen = np.zeros(PICTURE.shape[:2], np.uint8)
    for k, color in enumerate(colors.removeprefix("bayer_")):
        part = (slice(k // 2, None, 2), slice(k % 2, None, 2))
        seen[part] = PICTURE[..., "bgr".index(color)][part]
    return seen


def pixels_of(colors: str) -> np.ndarray:
    if colors in BAYER:
        return mosaic(colors)
    codes = {"rgb": cv2.COLOR_BGR2RGB, "rgba": cv2.COLOR_BGR2RGBA, "bgra": cv2.COLOR_BGR2BGRA}
    return {"mono": GRAY, "bgr": PICTURE}[colors] if colors not in codes else cv2.cvtColor(PICTURE, codes[colors])


def message(encoding: str, pixels: np.ndarray, big: bool = False) -> SimpleNamespace:
    """A message Image whose rows are longer than their pixels."""
    rows = np.pad(pixels.reshape(len(pixels), -1).view(np.uint8), ((0, 0), (0, 6)))
    height, width = PICTURE.shape[:2]
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=rows.shape[1], is_bigendian=big, data=rows.ravel()
    )


def same(found: np.ndarray, colors: str, within: float) -> None:
    assert (found.dtype, found.shape) == (np.uint8, PICTURE.shape)
    wanted = cv2.cvtColor(GRAY, cv2.COLOR_GRAY2BGR) if colors == "mono" else PICTURE
    inner = (slice(2, -2), slice(2, -2))  # a mosaic has no neighbors at the border
    assert np.abs(found[inner].astype(int) - wanted[inner]).max() <= within


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_is_the_same_picture(encoding: str) -> None:
    colors, bits = ENCODINGS[encoding]
    pixels = pixels_of(colors)
    within = 40 if colors in BAYER else 0
    if bits == 8:
        for name in (encoding, encoding.upper(), f" {encoding}"):
            same(image_of(message(name, pixels)), colors, within)
        return
    wide = np.ascontiguousarray(pixels).astype(np.uint16) * 257
    same(image_of(message(encoding, wide)), colors, within)
    same(image_of(message(encoding, wide.byteswap(), big=True)), colors, within)


@pytest.mark.parametrize("encoding", [*PACKED, *PLANAR])
def test_shared_colors_are_nearly_the_same_picture(encoding: str) -> None:
    codes = {"yuv422": cv2.COLOR_BGR2YUV_UYVY, "uyvy": cv2.COLOR_BGR2YUV_UYVY}
    if encoding in PACKED:
        pixels = cv2.cvtColor(PICTURE, codes.get(encoding, cv2.COLOR_BGR2YUV_YUY2))
    else:  # the colors of four pixels, interleaved below the gray values
        planes = cv2.cvtColor(PICTURE, cv2.COLOR_BGR2YUV_I420)
        first, second = planes[24:].reshape(2, -1)[:: 1 if encoding == "nv12" else -1]
        pixels = np.concatenate([planes[:24], np.stack([first, second], axis=1).reshape(12, 32)])
    same(image_of(message(encoding, pixels)), "bgr", 40)


@pytest.mark.parametrize(
    ("form", "pixels", "colors"),
    [
        ("jpeg", PICTURE, "bgr"),
        ("png", PICTURE, "bgr"),
        ("rgb8; jpeg compressed bgr8", PICTURE, "bgr"),
        ("bayer_rggb8; jpeg compressed bgr8", PICTURE, "bgr"),
        ("mono8; png compressed ", GRAY, "mono"),
        ("mono16; png compressed ", GRAY.astype(np.uint16) * 257, "mono"),
    ],
)
def test_compressed_images_are_read_as_their_format_says(form: str, pixels: np.ndarray, colors: str) -> None:
    _, data = cv2.imencode(".jpg" if "jpeg" in form else ".png", pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])
    same(image_of(SimpleNamespace(format=form, data=data)), colors, 40 if colors in BAYER else 16 * ("jpeg" in form))


def test_what_is_no_image_is_named() -> None:
    damaged = [message(encoding, GRAY) for encoding in ("32FC1", "", "bayer_rggb12")]
    damaged.append(message("bgr8", GRAY))  # too short
    damaged.append(SimpleNamespace(format="16UC1; compressedDepth png", data=np.zeros(20, np.uint8)))
    damaged.append(SimpleNamespace(format="jpeg", data=np.zeros(20, np.uint8)))
    for each in damaged:
        with pytest.raises(InputError, match="that cannot be read"):
            image_of(each)


RAW = {"k": [40, 0, 64, 0, 42, 48, 0, 0, 1], "d": [-0.4, 0.2, 0, 0, 0], "p": [35, 0, 31, 0, 0, 36, 23, 0, 0, 0, 1, 0]}


@pytest.mark.parametrize("rectified", [False, True])
def test_a_part_of_the_sensor_with_joined_pixels(rectified: bool) -> None:
    roi = SimpleNamespace(x_offset=32, y_offset=24, width=64, height=48)
    named = {"width": 128, "height": 96, "distortion_model": "plumb_bob", "roi": roi, "binning_x": 2, "binning_y": 0}
    camera = camera_of(SimpleNamespace(**RAW, **named), rectified)
    assert camera is not None
    found = (camera.fx, camera.fy, camera.cx, camera.cy, camera.size)
    assert found == ((17.5, 36, -0.5, -1, (32, 48)) if rectified else (20, 42, 16, 24, (32, 48)))
    assert camera.distortion == (() if rectified else tuple(RAW["d"]))


def test_the_topic_tells_rectified_images() -> None:
    topics = ("/cam/image_rect", "/cam/image_rect_color/compressed", "/left/image_raw", "/corrected/image")
    assert [is_rectified(topic) for topic in topics] == [True, True, False, False]


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
def test_an_image_of_16_bits_keeps_the_bits_that_it_uses(bits: int, suffix: str, tmp_path: Path) -> None:
    wide = (GRAY.astype(np.uint16) << (bits - 8)) + (1 << (bits - 8)) - 1
    wide[0, 0] = (1 << bits) - 1
    wanted = GRAY.copy()
    wanted[0, 0] = 255
    np.testing.assert_array_equal(eight_bits(wide), wanted)
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), wide)
    np.testing.assert_array_equal(read_bgr(tmp_path / f"a{suffix}"), cv2.cvtColor(wanted, cv2.COLOR_GRAY2BGR))


def test_a_dark_image_beside_a_bright_one_stays_dark(tmp_path: Path) -> None:
    """Of one camera of 12 bits; a depth image in the same folder uses 16 bits, and says nothing about its images."""
    bright, dark = (np.full(GRAY.shape, value, np.uint16) for value in (4000, 160))
    for name, image in (("image_1", bright), ("image_2", dark), ("depth_1", bright * 16)):
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    assert [read_bgr(tmp_path / f"image_{number}.png").max() for number in (1, 2)] == [250, 10]
    assert [image_of(message("mono16", image), least=12).max() for image in (bright, dark)] == [250, 10]
