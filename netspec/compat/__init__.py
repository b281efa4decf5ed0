"""Programs that were written for others: Caffe's Python interface, its scripts in Python 2, OpenCV's ``cv2.dnn``."""
