"""Train a small Faster R-CNN on five images until it finds the shapes in them: OUT/found.png.

python faster_rcnn.py OUT [TRAIN TEST ITERATIONS]: the prototxts are faster_rcnn.prototxt, or those of py-faster-rcnn as
they are, models/pascal_voc/ZF/faster_rcnn_end2end. Training starts from random weights, not from ImageNet's.
"""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
from shapes import judge, render

import netspec.pycaffe as caffe

MEANS, DEVIATIONS = (102.9801, 115.9465, 122.7717), (0.1, 0.1, 0.2, 0.2)  # of py-faster-rcnn's configuration


def detect(net, image, side=600):
    """Return the boxes (n, 6) that a net finds, after non-maximum suppression; ``side`` is that of the training."""
    net.blobs["data"].reshape(1, 3, side, side)
    net.blobs["data"].data[0] = (cv2.resize(image, (side, side)) - np.array(MEANS)).transpose(2, 0, 1)
    net.blobs["im_info"].data[...] = side, side, 1
    net.forward()
    regions, found = net.blobs["rois"].data[:, 1:], []
    scores, moves = net.blobs["cls_prob"].data, net.blobs["bbox_pred"].data
    sizes = regions[:, 2:] - regions[:, :2] + 1
    for kind in range(1, 4):
        shift, grow = np.split(moves[:, 4 * kind : 4 * kind + 4] * DEVIATIONS, 2, axis=1)
        centers, halves = regions[:, :2] + sizes / 2 + shift * sizes, np.exp(grow) * sizes / 2
        boxes = np.clip(np.hstack([centers - halves, centers + halves]), 0, side)
        xywh = np.hstack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
        for k in np.ravel(cv2.dnn.NMSBoxes(xywh.tolist(), scores[:, kind].tolist(), 0.05, 0.3)).astype(int):
            found.append([kind, scores[k, kind], *boxes[k] / side])
    return np.array(found).reshape(-1, 6)


files = [Path(given).resolve() for given in sys.argv[2:4]] or [Path(__file__).with_suffix(".prototxt")] * 2
os.chdir(sys.argv[1])
iterations = int(sys.argv[4]) if len(sys.argv) > 4 else 300
Path("solver.prototxt").write_text(
    f'train_net: "{files[0]}" base_lr: 0.001 lr_policy: "step" stepsize: {iterations * 4 // 5} gamma: 0.1\n'
    "momentum: 0.9 weight_decay: 0.0005 random_seed: 3 display: 20 average_loss: 10\n"
)
solver = caffe.get_solver("solver.prototxt")
random = np.random.RandomState(7)
for weights, *_ in solver.net.params.values():
    if not weights.data.any():
        weights.data[...] = random.randn(*weights.shape) * np.sqrt(2 / np.prod(weights.shape[1:]))
images, entries = [render(random) for _ in range(5)], []
for i, (image, boxes) in enumerate(images):
    cv2.imwrite(f"{i}.png", image)
    entries.append({"image": f"{i}.png", "boxes": 96 * boxes[:, 1:], "gt_classes": boxes[:, 0]})
solver.net.layers[0].set_roidb(entries)
solver.step(iterations)
solver.net.save("faster_rcnn.caffemodel")
net = caffe.Net(str(files[1]), "faster_rcnn.caffemodel", caffe.TEST)
judge(images, [detect(net, image) for image, _ in images], "found.png", least=0.9)
