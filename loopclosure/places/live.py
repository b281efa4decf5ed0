"""Images of a camera, a stream or a video file as they come."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.frames import video_frames
from netspec.files.opencv import cv2

Image = tuple[float, np.ndarray]


def live_frames(source: str) -> Generator[Image, None, None]:
    """Yield (seconds from the start, image (H, W, 3) uint8 BGR) until the source ends, or the caller stops.

    source  the number of a camera; the address of a stream, as in ``rtsp://HOST/PATH``; or a video file

    Of cameras and streams the newest image is taken: those that come while one is looked at are dropped, so that what
    is found is not late. Raises InputError where nothing can be opened.
    """
    if not source.isdigit() and "://" not in source:
        yield from video_frames(Path(source))
        return
    capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    if not capture.isOpened():
        what = f"camera {source}" if source.isdigit() else f"stream {source}"
        raise InputError(f"{what} cannot be opened; expected the number of a camera, a stream's address, or a file")
    newest: queue.Queue[Image | None] = queue.Queue(1)
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
        reader.join(2)  # a stream that hangs is left to the end of the process
        if not reader.is_alive():
            capture.release()
