"""Reads images, videos and cameras, and selects frames."""

from __future__ import annotations

import queue
import re
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.bags import bag_frames, is_bag
from loopclosure.places.pixels import bits_of, eight_bits
from netspec.files.environment import environment
from netspec.files.image_list import IMAGE_ENDINGS, list_images
from netspec.files.kinds import is_cut_png, nearest_existing, unreadable
from netspec.files.opencv import cv2
from netspec.files.whole_file import write_whole

VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")
FIRST_BYTES = 4096  # of a file tell whether it is text

DEPTH_PER_M = 5000  # of depth images, as TUM RGB-D has them
BESIDE = 16  # at most so many images of a folder show how many bits its camera uses


@dataclass(frozen=True)
class Selection:
    """Selects frames: from ``start`` to ``stop`` (exclusive), every ``stride``-th, at most ``limit`` of them.

    ``start`` and ``stop`` are frame numbers from 0, or a share of the frames such as "60%".
    """

    start: int | str = 0
    stop: int | str | None = None
    stride: int = 1
    limit: int | None = None

    def numbers(self, count: int) -> np.ndarray:
        """Return the numbers of the selected frames of ``count``. Raises InputError if none is left."""
        if self.stride < 1:
            raise InputError(f"a stride of {self.stride} takes no frame; expected 1 or more")
        if self.limit is not None and self.limit < 1:
            raise InputError(f"a limit of {self.limit} takes no frame; expected 1 or more")
        start = _frame_number(self.start, count)
        stop = count if self.stop is None else min(_frame_number(self.stop, count), count)
        taken = np.arange(start, stop, self.stride)[: self.limit]
        if not len(taken):
            raise InputError(
                f"no frame is left of {count} from {self.start} to {count if stop == count else self.stop}"
            )
        return taken


ALL_FRAMES = Selection()


def _frame_number(position: int | str, count: int) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*%|(\d+)", str(position).strip())
    if not match:
        raise InputError(f'"{position}" is not a frame; expected a number from 0, or a share of the frames such as 60%')
    if match[1] is None:
        return int(match[2])
    return round(float(match[1]) / 100 * count)


def image_paths(source: str | Path) -> list[Path]:
    """Return the images of a folder or list in order (docs/images.md). Raises InputError if there are none."""
    return list(list_images(source).paths)


def read_bgr(path: str | Path) -> np.ndarray:
    """Read an image (H, W, 3) uint8, BGR. Raises InputError if it cannot be read.

    Of 16 bits, those that it or images beside it use are kept: see :func:`~loopclosure.places.pixels.eight_bits`.
    """
    image, path = read_pixels(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH), Path(path)
    if image.dtype == np.uint16:
        return eight_bits(image, _bits_beside(path.parent, _letters(path.name)))
    return image if image.dtype == np.uint8 else read_pixels(path, cv2.IMREAD_COLOR)


def _letters(name: str) -> str:
    """Return a name without its digits, in which the images of one camera differ."""
    return re.sub(r"\d", "", name)


@lru_cache(64)
def _bits_beside(folder: Path, letters: str) -> int:
    """Return how many bits some images in a folder use, of those with these letters in their names."""
    files = sorted(file for file in folder.iterdir() if _letters(file.name) == letters)
    most = 8
    for file in files[:: -(-len(files) // BESIDE)]:
        with suppress(InputError):  # whoever reads that image says so
            most = max(most, bits_of(read_pixels(file, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)))
    return most


def read_pixels(path: str | Path, mode: int) -> np.ndarray:
    """Read an image in one of OpenCV's modes (``IMREAD_...``). Raises InputError if it cannot be read."""
    # Read by Python and decoded by OpenCV, because imread prints its own warning for a missing file.
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(unreadable(path, error), path) from None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode) if data and not is_cut_png(data) else None
    except cv2.error:  # too large, for example
        image = None
    if image is None:
        raise InputError("is not a readable image", path)
    return image


def read_depth(path: str | Path, per_m: float = DEPTH_PER_M) -> np.ndarray:
    """Read a depth image of 16 bits, with ``per_m`` for a meter, as meters (H, W), 0 where not known.

    Raises InputError if it is not one.
    """
    image = read_pixels(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError("is not a depth image; expected one channel of 16 bits, as of TUM RGB-D", path)
    return image / per_m


def write_picture(path: Path, image: np.ndarray, *settings: int) -> None:
    """Write an image in the format of its suffix, with OpenCV's ``settings``. Raises SpecError if that fails."""
    # Encoded by OpenCV and written by Python, because imwrite aborts the process if a path is not UTF-8.
    _, data = cv2.imencode(path.suffix, image, settings)
    write_whole(path, data.tobytes())


def is_video(path: Path) -> bool:
    """Return whether a path is a video: by its name, or a file that is no text, no image and no bag."""
    if path.suffix.lower() in VIDEO_SUFFIXES or not path.is_file():
        return path.suffix.lower() in VIDEO_SUFFIXES
    with path.open("rb") as stream:
        first = stream.read(FIRST_BYTES)
    return b"\0" in first and path.suffix.lower() not in IMAGE_ENDINGS and not is_bag(path)


def _capture(path: str | Path) -> cv2.VideoCapture:
    try:
        str(path).encode()
    except UnicodeEncodeError:  # OpenCV would abort the process
        raise InputError("OpenCV cannot open a video if its path is not UTF-8; rename it", path) from None
    with environment({"OPENCV_FFMPEG_LOGLEVEL": "-8"}):  # read at the first video: keeps FFmpeg silent
        return cv2.VideoCapture(str(path))


def video_frames(path: str | Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (seconds from the start, image (H, W, 3) uint8 BGR) for each frame of a video file.

    The times are those of the file; its frame rate gives them if it has none.
    """
    capture = _opened(path)
    rate = capture.get(cv2.CAP_PROP_FPS)
    number, last = 0, -1.0
    try:
        while True:
            there, image = capture.read()
            if not there:
                break
            seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if not seconds > last:
                seconds = last + 1 / rate if rate > 0 else last + 1
            yield seconds, image
            number, last = number + 1, seconds
    finally:
        capture.release()
    if not number:
        raise InputError(f"opens, but no frame of it can be decoded{_advice(path)}", path)


def video_length(path: str | Path) -> int | None:
    """Return the number of frames in the header of a video file, None if it is not there.

    Raises InputError for a file that cannot be decoded.
    """
    capture = _opened(path)
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    decoded = count > 0 or capture.read()[0]
    capture.release()
    if not decoded:
        raise InputError(f"opens, but no frame of it can be decoded{_advice(path)}", path)
    return count if count > 0 else None


def _opened(path: str | Path) -> cv2.VideoCapture:
    """Open a video. Raises InputError if it is not a video or cannot be decoded."""
    capture = _capture(path)
    if not capture.isOpened():
        if Path(path).is_dir():
            raise InputError("is a folder, and neither a video nor a ROS bag (which has a metadata.yaml)", path)
        if not Path(path).is_file():
            raise InputError(f"no such video{nearest_existing(path)}", path)
        raise InputError(f"cannot be decoded as a video{_advice(path)}", path)
    return capture


def _advice(path: str | Path) -> str:
    """Return the end of an error message: what tried to decode a video, and what to do."""
    advice = f"try ffmpeg -i {Path(path).name} %06d.png, and give the folder of images"
    return f" by OpenCV {cv2.__version__}, which uses FFmpeg: it is cut, damaged, or of an unknown codec; {advice}"


def gray(image: np.ndarray) -> np.ndarray:
    """Convert a uint8 image, (H, W, 3) BGR or (H, W) gray, to gray values (H, W)."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def read_gray(path: Path) -> np.ndarray:
    """Read an image as gray values (H, W) uint8. Raises InputError if it cannot be read."""
    return gray(read_bgr(path))


def live_frames(source: str) -> Generator[tuple[float, np.ndarray], None, None]:
    """Yield (seconds from the start, image (H, W, 3) uint8 BGR) until the source ends, or the caller stops.

    source  the number of a camera; the address of a stream, as in ``rtsp://HOST/PATH``; or a video file or bag

    A camera or stream always gives its newest image. Images that arrive while the caller processes one are dropped, so
    that results are not late. Raises InputError if the source cannot be opened.
    """
    if not source.isdigit() and "://" not in source:
        yield from bag_frames(Path(source)) if is_bag(Path(source)) else video_frames(Path(source))
        return
    capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    if not capture.isOpened():
        what = f"camera {source}" if source.isdigit() else f"stream {source}"
        raise InputError(f"{what} cannot be opened; expected the number of a camera, a stream's address, or a file")
    newest: queue.Queue[tuple[float, np.ndarray] | None] = queue.Queue(1)
    stopped = threading.Event()

    def read() -> None:
        start = time.monotonic()
        while not stopped.is_set():
            there, image = capture.read()
            with suppress(queue.Empty):
                newest.get_nowait()
            newest.put((time.monotonic() - start, image) if there else None)
            if not there:
                return

    reader = threading.Thread(target=read, daemon=True, name="camera")
    reader.start()
    try:
        while (taken := newest.get()) is not None:
            yield taken
    finally:
        stopped.set()
        reader.join(2)  # if a stream hangs, its thread ends with the process
        if not reader.is_alive():
            capture.release()
