"""Runs programs written for other libraries: Caffe's Python interface and OpenCV's ``cv2.dnn``."""
