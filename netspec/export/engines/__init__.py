"""Engines: what runs a net. torch runs every net; onnxruntime and openvino run a net as exported to ONNX, in TEST.

The exported model is kept in the user's cache folder, so that a later start needs neither the export nor torch.
What an engine cannot do, torch does, and one warning says why.
"""
