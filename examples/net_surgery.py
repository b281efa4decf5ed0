"""Net surgery: turn InnerProduct into Convolution, so that a classifier of small images covers a large image."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P


def net(size, fully_convolutional):
    """Return the prototxt for images of a size."""
    n = caffe.NetSpec()
    n.data = L.Input(shape={"dim": [1, 3, size, size]})
    n.conv1 = L.Convolution(n.data, kernel_size=5, num_output=8, weight_filler={"type": "xavier"})
    n.relu1 = L.ReLU(n.conv1, in_place=True)
    n.pool1 = L.Pooling(n.relu1, kernel_size=2, stride=2, pool=P.Pooling.MAX)
    if fully_convolutional:
        n["fc2-conv"] = L.Convolution(n.pool1, kernel_size=6, num_output=10)
        n.prob = L.Softmax(n["fc2-conv"])
    else:
        n.fc2 = L.InnerProduct(n.pool1, num_output=10, weight_filler={"type": "xavier"})
        n.prob = L.Softmax(n.fc2)
    return str(n.to_proto())


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
Path("small.prototxt").write_text(net(16, fully_convolutional=False))
Path("large.prototxt").write_text(net(32, fully_convolutional=True))
caffe.set_random_seed(1)
small = caffe.Net("small.prototxt", caffe.TEST)
small.params["fc2"][1].data[...] = np.linspace(-1, 1, 10)
small.save("small.caffemodel")

large = caffe.Net("large.prototxt", "small.caffemodel", caffe.TEST)  # conv1 is copied by its name
for fc, conv in zip(small.params["fc2"], large.params["fc2-conv"], strict=True):
    print(f"{fc.data.shape} -> {conv.data.shape}")
    conv.data.flat = fc.data.flat  # the weights lie in memory in the same order
large.save("large.caffemodel")

image = np.random.RandomState(1).rand(3, 32, 32)
large.blobs["data"].data[...] = image
found = large.forward()["prob"][0]  # (classes, rows, columns)
print(f"a map of {found.shape[1]} by {found.shape[2]} places, one each 2 pixels")
small.blobs["data"].data[...] = image[:, 4:20, 8:24]
difference = np.abs(small.forward()["prob"][0] - found[:, 2, 4]).max()
print(f"the small net says the same of the window there: within {difference:.0e}")
assert difference < 1e-5
