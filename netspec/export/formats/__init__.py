"""Export of nets as ONNX, PyTorch source, torch.export or safetensors. Each layer defines its own export."""
