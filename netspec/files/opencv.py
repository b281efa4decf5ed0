"""OpenCV, which refuses images of more than 2^27 pixels: a small file may unpack to gigabytes.

It reads the limit from the environment when it is loaded. Where something else has loaded it, its own limit stays.
"""

from __future__ import annotations

from netspec.files.environment import environment

MOST_PIXELS = 1 << 27

with environment({"OPENCV_IO_MAX_IMAGE_PIXELS": str(MOST_PIXELS)}):
    import cv2
    from cv2 import dnn

__all__ = ["cv2", "dnn"]
