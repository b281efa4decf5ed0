"""Draw the filters and the activations of a net."""

import os
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.datasets import load_digits

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P

plt.switch_backend("Agg")


def show(arrays, file, title):
    """Save images (N, H, W) as one picture, side by side in a square with a line between them."""
    side = int(np.ceil(np.sqrt(len(arrays))))
    low, high = arrays.min(), arrays.max()
    padding = ((0, side * side - len(arrays)), (0, 1), (0, 1))
    tiles = np.pad((arrays - low) / (high - low), padding, constant_values=1)
    height, width = tiles.shape[1:]
    picture = tiles.reshape(side, side, height, width).swapaxes(1, 2).reshape(side * height, side * width)
    plt.imsave(file, picture, cmap="gray")
    print(f"{file}: {title}")


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
n = caffe.NetSpec()
n.data, n.label = L.Input(shape={"dim": [64, 1, 8, 8]}), L.Input(shape={"dim": [64]})
n.conv1 = L.Convolution(n.data, kernel_size=3, num_output=16, weight_filler={"type": "xavier"})
n.relu1 = L.ReLU(n.conv1, in_place=True)
n.pool1 = L.Pooling(n.relu1, kernel_size=2, stride=2, pool=P.Pooling.MAX)
n.score = L.InnerProduct(n.pool1, num_output=10, weight_filler={"type": "xavier"})
n.loss = L.SoftmaxWithLoss(n.score, n.label)
Path("net.prototxt").write_text("force_backward: true\n" + str(n.to_proto()))
Path("solver.prototxt").write_text(
    'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" snapshot_prefix: "s" random_seed: 1\n'
)
digits, random = load_digits(), np.random.RandomState(1)
solver = caffe.SGDSolver("solver.prototxt")
net = solver.net
for _ in range(100):
    chosen = random.randint(1500, size=64)
    net.blobs["data"].data[:, 0] = digits.images[chosen] / 16
    net.blobs["label"].data[...] = digits.target[chosen]
    solver.step(1)
for name, blob in net.blobs.items():
    print(f"{name:7} {blob.data.shape}")
net.blobs["data"].data[:, 0] = digits.images[-64:] / 16
net.blobs["label"].data[...] = digits.target[-64:]
net.forward()
net.backward()
show(net.params["conv1"][0].data[:, 0], "filters.png", "the 16 filters of conv1")
show(net.blobs["conv1"].data[0], "activations.png", "what they make of a digit")
show(net.blobs["data"].diff[:, 0], "saliency.png", "the pixels of 64 digits that the loss depends on")
