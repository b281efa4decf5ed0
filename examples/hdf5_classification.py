"""Logistic regression from HDF5 files, with and without a hidden layer, compared with scikit-learn."""

import os
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
from sklearn.datasets import make_classification
from sklearn.linear_model import LogisticRegression

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L


def write(name, data, labels):
    """Write a data set as two HDF5 files and the list of them that an HDF5Data layer reads."""
    half = len(data) // 2
    for number, part in enumerate((slice(half), slice(half, None))):
        with h5py.File(f"{name}_{number}.h5", "w") as file:
            file["data"], file["label"] = data[part].astype(np.float32), labels[part].astype(np.float32)
    Path(f"{name}.txt").write_text(f"{name}_0.h5\n{name}_1.h5\n")


def net(source, batch, hidden):
    """Return the prototxt; ``hidden`` is the size of the hidden layer, 0 for none."""
    n = caffe.NetSpec()
    n.data, n.label = L.HDF5Data(source=source, batch_size=batch, ntop=2)
    below = n.data
    if hidden:
        n.fc1 = L.InnerProduct(below, num_output=hidden, weight_filler={"type": "xavier"})
        below = n.relu1 = L.ReLU(n.fc1, in_place=True)
    n.score = L.InnerProduct(below, num_output=2, weight_filler={"type": "xavier"})
    n.accuracy = L.Accuracy(n.score, n.label)
    n.loss = L.SoftmaxWithLoss(n.score, n.label)
    return str(n.to_proto())


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
data, labels = make_classification(
    3000, 4, n_redundant=0, n_informative=4, n_clusters_per_class=2, hypercube=False, random_state=0
)
write("train", data[:2000], labels[:2000])
write("test", data[2000:], labels[2000:])
regression = LogisticRegression().fit(data[:2000], labels[:2000])
print(f"scikit-learn's logistic regression: {regression.score(data[2000:], labels[2000:]):.3f}")
for title, hidden in (("logistic regression", 0), ("with 40 hidden units", 40)):
    Path("train.prototxt").write_text(net("train.txt", 20, hidden))
    Path("test.prototxt").write_text(net("test.txt", 20, hidden))
    Path("solver.prototxt").write_text(
        'train_net: "train.prototxt" test_net: "test.prototxt" test_iter: 50 test_interval: 5000 random_seed: 1\n'
        'base_lr: 0.05 momentum: 0.9 weight_decay: 0.0005 lr_policy: "fixed" snapshot_prefix: "s"\n'
    )
    solver = caffe.get_solver("solver.prototxt")
    solver.step(400)
    print(f"{title}: {np.mean([float(solver.test_nets[0].forward()['accuracy']) for _ in range(50)]):.3f}")
