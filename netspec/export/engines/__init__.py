"""Engines that run nets. Torch runs every net. onnxruntime and openvino run nets of phase TEST, exported to ONNX.

The exported model is kept in the user's cache folder, so that a later start needs neither the export nor torch.
If an engine cannot run a net, torch does, and one warning says why.
"""
