"""Every way in which public scripts use nets, blobs, solvers and modes: each a few lines of code that must run.

The names are those of a count over 493 public scripts. What they use of caffe.io, NetSpec, caffe_pb2, Classifier and
drawing is tested with those.
"""

from collections.abc import Callable

import numpy as np
import pytest

import netspec.pycaffe as caffe
from case_files import read_cases
from each import each

pytestmark = pytest.mark.slow

NET = """
name: "usage" force_backward: true
input: "data" input_shape { dim: 2 dim: 3 dim: 12 dim: 12 }
layer { name: "conv1" type: "Convolution" bottom: "data" top: "conv1"
  convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
layer { name: "relu1" type: "ReLU" bottom: "conv1" top: "conv1" }
layer { name: "pool1" type: "Pooling" bottom: "conv1" top: "pool1"
  pooling_param { pool: MAX global_pooling: true } }
layer { name: "fc2" type: "InnerProduct" bottom: "pool1" top: "fc2"
  inner_product_param { num_output: 5 weight_filler { type: "xavier" } } }
layer { name: "prob" type: "Softmax" bottom: "fc2" top: "prob" }
"""
MEMORY = """
layer { name: "data" type: "MemoryData" top: "data" top: "label"
  memory_data_param { batch_size: 2 channels: 1 height: 2 width: 3 } }
layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc"
  inner_product_param { num_output: 3 weight_filler { type: "xavier" } } }
layer { name: "loss" type: "SoftmaxWithLoss" bottom: "fc" bottom: "label" top: "loss" }
"""
TRAINED = """
layer { name: "data" type: "DummyData" top: "data" top: "label" dummy_data_param {
  shape { dim: 4 dim: 6 } shape { dim: 4 } data_filler { type: "gaussian" std: 1 } data_filler { } } }
layer { name: "fc" type: "InnerProduct" bottom: "data" top: "fc"
  inner_product_param { num_output: 3 weight_filler { type: "xavier" } } }
layer { name: "loss" type: "SoftmaxWithLoss" bottom: "fc" bottom: "label" top: "loss" }
layer { name: "accuracy" type: "Accuracy" bottom: "fc" bottom: "label" top: "accuracy" include { phase: TEST } }
"""
SOLVER = """
net: "train.prototxt" base_lr: 0.1 lr_policy: "fixed" momentum: 0.9 max_iter: 3 test_iter: 2 test_interval: 2
snapshot_prefix: "usage"
"""
USES = read_cases("netspec/pycaffe/cases/usage.txt")


@each("use", USES)
def test_what_scripts_do(use: str, write: Callable[..., str]) -> None:
    for name, text in (("deploy", NET), ("memory", MEMORY), ("train", TRAINED), ("solver", SOLVER)):
        write(text, f"{name}.prototxt")
    net = caffe.Net("deploy.prototxt", caffe.TEST)
    net.save("usage.caffemodel")
    random = np.random.default_rng(0)
    names = {
        "caffe": caffe,
        "np": np,
        "net": net,
        "solver": caffe.SGDSolver("solver.prototxt"),
        "image": random.random((2, 3, 12, 12), np.float32),
        "images": random.random((5, 3, 12, 12), np.float32),
        "ones": np.ones((2, 5), np.float32),
    }
    exec(USES[use]["code"], names)
