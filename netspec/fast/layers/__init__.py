"""The kernels of layer types: a file for each room of netspec/layers, and one for the layers of dialects."""
