"""Nets and images for tests of pycaffe."""

from pathlib import Path

import numpy as np

INPUT = 'force_backward: true input: "data" input_shape { dim: 1 dim: 3 dim: 12 dim: 12 }\n'
# The shape of MTCNN's first net: fully convolutional, run on an image pyramid.
PYRAMID = (Path(__file__).parent / "netspec/compat/pycaffe/nets/pyramid.prototxt").read_text()

CLASSES = 7
# Made data, a learned layer of each common kind, and a loss.
SMALL = f"""
name: "small" force_backward: true
layer {{ name: "numbers" type: "DummyData" top: "data" top: "label"
  dummy_data_param {{
    shape {{ dim: 4 dim: 3 dim: 5 dim: 6 }} shape {{ dim: 4 }}
    data_filler {{ type: "gaussian" std: 1 }} data_filler {{ type: "constant" }} }} }}
layer {{ name: "filters" type: "Convolution" bottom: "data" top: "maps"
  param {{ decay_mult: 1 }} param {{ decay_mult: 0 }}
  convolution_param {{ num_output: 8 kernel_size: 3 pad: 1
    weight_filler {{ type: "gaussian" std: 1 }} bias_filler {{ type: "constant" value: 2 }} }} }}
layer {{ name: "scores" type: "InnerProduct" bottom: "maps" top: "score"
  inner_product_param {{ num_output: {CLASSES}
    weight_filler {{ type: "gaussian" std: 0.1 }} bias_filler {{ type: "constant" value: -3 }} }} }}
layer {{ name: "cost" type: "SoftmaxWithLoss" bottom: "score" bottom: "label" top: "cost" }}
"""


def image(*shape: int) -> np.ndarray:
    """Return numbers that depend on the shape alone."""
    return np.random.default_rng(len(shape) + sum(shape)).standard_normal(shape).astype(np.float32)
