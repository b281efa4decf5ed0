"""Runs programs written for other libraries: Caffe's Python interface, scripts in Python 2, OpenCV's ``cv2.dnn``."""
