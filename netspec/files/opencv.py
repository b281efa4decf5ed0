"""OpenCV with a limit of 2^27 pixels per image, because a small file can decompress to gigabytes.

OpenCV reads the limit from the environment when it is loaded. If other code has loaded it before, its limit is kept.
"""

from __future__ import annotations

from netspec.files.environment import environment

MOST_PIXELS = 1 << 27

with environment({"OPENCV_IO_MAX_IMAGE_PIXELS": str(MOST_PIXELS)}):
    import cv2
    from cv2 import dnn

__all__ = ["cv2", "dnn"]
