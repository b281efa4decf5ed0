"""From image sequences to labeled pairs, and from pairs to databases for Data layers."""

import os

# The most pixels of an image, which is read when OpenCV is loaded: a small file may unpack to gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
