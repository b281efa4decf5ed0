"""Compares the speed of netspec with PyTorch, OpenCV 4, onnxruntime, OpenVINO and, if it is available, Caffe."""
