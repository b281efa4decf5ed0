"""Engines that run nets of phase TEST, which are exported to ONNX for them; torch runs every net."""
