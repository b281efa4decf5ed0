"""How fast netspec is, beside hand-written PyTorch, OpenCV 4, onnxruntime, OpenVINO and, where it is at hand, Caffe."""
