"""LeNet, written and trained in Python, one update at a time, on scikit-learn's digits in an LMDB."""

import os
import sys
import tempfile
from pathlib import Path

import lmdb
import numpy as np
from sklearn.datasets import load_digits

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P


def write_lmdb(path, images, labels):
    with lmdb.open(path, map_size=1 << 26) as database, database.begin(write=True) as transaction:
        for number, (image, label) in enumerate(zip(images, labels, strict=True)):
            datum = caffe.io.array_to_datum(image[np.newaxis].astype(np.uint8), int(label))
            transaction.put(b"%08d" % number, datum.SerializeToString())


def lenet(source, batch):
    n = caffe.NetSpec()
    scale = {"scale": 1 / 16}
    n.data, n.label = L.Data(source=source, backend=P.Data.LMDB, batch_size=batch, transform_param=scale, ntop=2)
    filler = {"type": "xavier"}
    n.conv1 = L.Convolution(n.data, kernel_size=3, num_output=20, weight_filler=filler)
    n.pool1 = L.Pooling(n.conv1, kernel_size=2, stride=2, pool=P.Pooling.MAX)
    n.fc1 = L.InnerProduct(n.pool1, num_output=100, weight_filler=filler)
    n.relu1 = L.ReLU(n.fc1, in_place=True)
    n.score = L.InnerProduct(n.relu1, num_output=10, weight_filler=filler)
    n.loss = L.SoftmaxWithLoss(n.score, n.label)
    return str(n.to_proto())


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
digits = load_digits()
write_lmdb("train_lmdb", digits.images[:1500], digits.target[:1500])
write_lmdb("test_lmdb", digits.images[1500:], digits.target[1500:])
Path("train.prototxt").write_text(lenet("train_lmdb", 64))
Path("test.prototxt").write_text(lenet("test_lmdb", 99))
Path("solver.prototxt").write_text(
    'train_net: "train.prototxt" test_net: "test.prototxt" test_iter: 3 test_interval: 1000 random_seed: 1\n'
    'base_lr: 0.05 momentum: 0.9 weight_decay: 0.0005 lr_policy: "fixed" snapshot_prefix: "lenet"\n'
)
solver = caffe.get_solver("solver.prototxt")
for iteration in range(101):
    if iteration % 25 == 0:
        test, right = solver.test_nets[0], 0
        for _ in range(3):
            test.forward()
            right += (test.blobs["score"].data.argmax(1) == test.blobs["label"].data).sum()
        print(f"iteration {iteration:3d}: loss {test.blobs['loss'].data:.3f}, {right} of 297 right")
    solver.step(1)
