"""Classify image files with a Transformer, a mean and oversampling; a net is first trained on drawn shapes."""

import os
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P

SHAPES = ("disc", "square", "cross")


def draw(random, kind):
    image = random.randint(0, 80, (40, 40, 3), np.uint8)
    x, y, radius, *color = random.randint([14, 14, 5, 120, 120, 120], [26, 26, 9, 256, 256, 256]).tolist()
    if kind == 0:
        cv2.circle(image, (x, y), radius, color, -1)
    else:
        marker = cv2.MARKER_SQUARE if kind == 1 else cv2.MARKER_CROSS
        cv2.drawMarker(image, (x, y), color, marker, 2 * radius, 3)
    return image


os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
n = caffe.NetSpec()
n.data = L.Input(shape={"dim": [32, 3, 32, 32]})
n.conv1 = L.Convolution(n.data, kernel_size=5, stride=2, num_output=16, weight_filler={"type": "xavier"})
n.pool1 = L.Pooling(L.ReLU(n.conv1, in_place=True), kernel_size=2, stride=2, pool=P.Pooling.MAX)
n.score = L.InnerProduct(n.pool1, num_output=3, weight_filler={"type": "xavier"})
n.prob = L.Softmax(n.score)
Path("deploy.prototxt").write_text(str(n.to_proto()))
n.label = L.Input(shape={"dim": [32]})
n.loss = L.SoftmaxWithLoss(n.score, n.label)
Path("train.prototxt").write_text(str(n.to_proto()))
Path("solver.prototxt").write_text(
    'net: "train.prototxt" base_lr: 0.01 momentum: 0.9 lr_policy: "fixed" random_seed: 1 snapshot_prefix: "shapes"\n'
)
random, mean, solver = np.random.RandomState(1), np.array([60.0, 60.0, 60.0]), caffe.SGDSolver("solver.prototxt")
for _ in range(200):
    kinds = random.randint(3, size=32)
    top, left = random.randint(9, size=2)
    batch = np.stack([draw(random, kind)[top : top + 32, left : left + 32] for kind in kinds]).transpose(0, 3, 1, 2)
    solver.net.blobs["data"].data[...] = (batch - mean[:, None, None]) / 128
    solver.net.blobs["label"].data[...] = kinds
    solver.step(1)
solver.net.save("shapes.caffemodel")

for number, kind in enumerate(SHAPES):
    cv2.imwrite(f"{kind}.png", draw(random, number))
options = {"mean": mean, "raw_scale": 255, "input_scale": 1 / 128, "channel_swap": (2, 1, 0)}
net = caffe.Classifier("deploy.prototxt", "shapes.caffemodel", image_dims=(40, 40), **options)
for oversample in (False, True):
    probabilities = net.predict([caffe.io.load_image(f"{kind}.png") for kind in SHAPES], oversample)
    for kind, row in zip(SHAPES, probabilities, strict=True):
        print(f"{kind}.png, {'ten crops' if oversample else 'center'}: {SHAPES[row.argmax()]} ({row.max():.2f})")
