"""A Siamese net: two columns with shared weights learn to map digits to the plane, and a picture shows the result."""

import os
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.datasets import load_digits

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L

plt.switch_backend("Agg")


def column(data, suffix):
    def learned(name):  # the parameters of both columns have these names, so they are shared
        return {"param": [{"name": f"{name}_w"}, {"name": f"{name}_b"}], "weight_filler": {"type": "xavier"}}

    hidden = L.InnerProduct(data, num_output=64, name=f"fc1{suffix}", **learned("fc1"))
    return L.InnerProduct(L.ReLU(hidden, in_place=True), num_output=2, name=f"feat{suffix}", **learned("feat"))


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
n = caffe.NetSpec()
n.left, n.right = (L.Input(shape={"dim": [128, 64]}) for _ in range(2))
n.same = L.Input(shape={"dim": [128]})
n.feat, n.feat_p = column(n.left, ""), column(n.right, "_p")
n.loss = L.ContrastiveLoss(n.feat, n.feat_p, n.same, margin=1)
Path("siamese.prototxt").write_text(str(n.to_proto()))
Path("solver.prototxt").write_text(
    'net: "siamese.prototxt" base_lr: 0.05 momentum: 0.9 lr_policy: "fixed" random_seed: 1 snapshot_prefix: "siamese"\n'
)

digits, random = load_digits(), np.random.RandomState(1)
images, labels = digits.data / 16, digits.target
solver = caffe.SGDSolver("solver.prototxt")
for iteration in range(300):
    first = random.randint(len(images), size=128)
    near = [random.choice(np.flatnonzero(labels == labels[i])) for i in first[:64]]  # half of the pairs are alike
    second = np.concatenate([near, random.randint(len(images), size=64)])
    solver.net.blobs["left"].data[...] = images[first]
    solver.net.blobs["right"].data[...] = images[second]
    solver.net.blobs["same"].data[...] = labels[first] == labels[second]
    solver.step(1)
    if iteration % 50 == 0:
        print(f"iteration {iteration:3d}: loss {solver.net.blobs['loss'].data:.4f}")

places = []
for first in range(0, 1024, 128):
    solver.net.blobs["left"].data[...] = images[first : first + 128]
    places.append(solver.net.forward(end="feat")["feat"].copy())
plt.scatter(*np.concatenate(places).T, c=labels[:1024], s=4, cmap="tab10")
plt.colorbar(label="digit")
plt.savefig("embedding.png")
print("embedding.png")
