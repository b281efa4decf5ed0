"""Train a small MobileNet-SSD to find shapes: a database of boxes, a sampler, SSD's loss and average precision.

python mobilenet_ssd.py OUT ITERATIONS: OUT/found.png shows the boxes found in new images (400 iterations: a minute).
"""

import os
import sys
from pathlib import Path

import numpy as np
from shapes import judge, render, write

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L

BLOCKS = [(32, 1), (48, 2), (64, 2), (64, 1), (128, 2), (128, 1)]  # outputs and stride
BOXES = {"code_type": 2, "num_classes": 4}  # CENTER_SIZE; the background is a class too
DATA = {"mean_value": 127.5, "scale": 1 / 127.5, "resize_param": {"height": 96, "width": 96}}


def normed(bottom, outputs, **settings):
    top = L.Convolution(bottom, num_output=outputs, bias_term=False, weight_filler={"type": "msra"}, **settings)
    return L.ReLU(L.Scale(L.BatchNorm(top), bias_term=True))


def write_net(name, images, **samplers):
    """Write images, and the net that is trained on them, with samplers, or finds boxes in them and judges them."""
    write(f"{name}_lmdb", images)
    n, parts, size = caffe.NetSpec(), [], 16 if samplers else len(images)
    source = {"source": f"{name}_lmdb", "batch_size": size, "backend": 1}
    n.data, n.label = L.AnnotatedData(ntop=2, data_param=source, transform_param=DATA, annotated_data_param=samplers)
    top, width = normed(n.data, 16, kernel_size=3, stride=2, pad=1), 16
    for i, (outputs, stride) in enumerate(BLOCKS, 1):
        top, width = normed(top, width, group=width, kernel_size=3, pad=1, stride=stride), outputs
        n[f"conv{i}"] = top = normed(top, outputs, kernel_size=1)
    for top, low, high in ((n.conv4, 22, 34), (n.conv6, 34, 52)):
        heads = [L.Convolution(top, num_output=8, kernel_size=3, pad=1, weight_filler={"type": "xavier"}) for _ in "ab"]
        priors = L.PriorBox(top, n.data, min_size=low, max_size=high, variance=[0.1, 0.1, 0.2, 0.2])
        parts.append([*(L.Flatten(L.Permute(head, order=[0, 2, 3, 1])) for head in heads), priors])
    n.loc, n.conf, n.priors = (L.Concat(*part, axis=1 + i // 2) for i, part in enumerate(zip(*parts, strict=True)))
    if samplers:
        n.loss = L.MultiBoxLoss(n.loc, n.conf, n.priors, n.label, mining_type=1, **BOXES)
    else:
        n.prob = L.Flatten(L.Softmax(L.Reshape(n.conf, shape={"dim": [0, -1, 4]}), axis=2))
        n.found = L.DetectionOutput(n.loc, n.prob, n.priors, nms_param={"nms_threshold": 0.45}, keep_top_k=20, **BOXES)
        n.detection_eval = L.DetectionEvaluate(n.found, n.label, num_classes=4)
    Path(f"{name}.prototxt").write_text(str(n.to_proto()))


os.chdir(sys.argv[1])
train, test = ([render(np.random.RandomState(seed)) for seed in seeds] for seeds in (range(500), range(1000, 1064)))
write_net("train", train, batch_sampler=[{"max_sample": 1}, {"sampler": {"min_scale": 0.5}, "max_sample": 1}])
write_net("test", test)
Path("solver.prototxt").write_text(f"""train_net: "train.prototxt" test_net: "test.prototxt" snapshot_prefix: "ssd"
test_iter: 1 test_interval: {sys.argv[2]} test_initialization: false eval_type: "detection" random_seed: 1
type: "Adam" momentum: 0.9 momentum2: 0.99 base_lr: 0.005 lr_policy: "poly" power: 1 max_iter: {sys.argv[2]}""")
solver = caffe.get_solver("solver.prototxt")
solver.solve()
rows = solver.test_nets[0].blobs["found"].data[0, 0]
judge(test, [rows[rows[:, 0] == i, 1:] for i in range(len(test))], "found.png")
