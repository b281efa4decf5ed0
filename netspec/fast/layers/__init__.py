"""The kernels of layer types: a file for each module of netspec/layers, and one for the layers of dialects."""
