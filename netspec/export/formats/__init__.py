"""A net in another form: ONNX, PyTorch source, torch.export, safetensors. Each layer defines its own export."""
