"""A head for places on a trunk that stays as it is: what views of one place have in common in EfficientNet's maps.

python trained_head.py FOLDER LIST...: FOLDER has the files of efficientnet_lite0.py, a LIST pairs of views of one place
(lmdb-build views --view-size 192x144). Directions in which the views of a pair differ become short (within-class
whitening; Mikolajczyk and Matas, ICCV 2007). docs/trained.md says what the net reaches.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import netspec.pycaffe as caffe
from netspec.proto.text import read_net, write_text
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P

SHRINK = 0.3  # of the mean variance is added to each: few places
folder, lists = Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]]
n = caffe.NetSpec()
n.block10 = L.Input(shape={"dim": [48, 112, 9, 12]})
n.positions = L.Convolution(n.block10, num_output=112, kernel_size=1)
n.negative = L.Power(n.positions, scale=-1)
n.cubes = L.Power(L.ReLU(L.Concat(n.positions, n.negative)), power=3)
n.means = L.Power(L.Pooling(n.cubes, pool=P.Pooling.AVE, global_pooling=True), power=1 / 3, shift=1e-9)
n.parts = L.Pooling(n.positions, pool=P.Pooling.AVE, kernel_size=3, stride=3)
units = []
for name, size in (("means", 224), ("parts", 1344)):
    n[f"white_{name}"] = white = L.InnerProduct(n[name], num_output=size)
    squares = L.Reduction(white, operation=P.Reduction.SUMSQ, axis=1)  # each half of feat gets the length 0.707
    n[f"length_{name}"] = length = L.Power(squares, power=-0.5, scale=2, shift=1e-8)
    units.append(L.Scale(white, length, axis=0))
n.feat = L.Concat(*units)
(folder / "head.prototxt").write_text(str(n.to_proto()))
net, source = read_net(folder / "efficientnet_lite0.prototxt"), str(folder / "efficientnet_lite0.caffemodel")
del net.layer[[layer.name for layer in net.layer].index("block10") + 1 :]
net.layer[0].input_param.shape[0].dim[:] = [1, 3, 144, 192]
net.layer.extend(read_net(folder / "head.prototxt").layer[1:])
(folder / "places.prototxt").write_text(write_text(net))
whole = caffe.Net(str(folder / "places.prototxt"), source, caffe.TEST)
head = caffe.Net(str(folder / "head.prototxt"), caffe.TEST)
for views in lists:
    if not views.with_suffix(".npy").exists():
        files = [views.parent / name for row in views.open() if row[0] != "#" for name in row.split()[:2]]
        images = np.stack([np.asarray(cv2.imread(str(file)), np.float32) for file in files]).transpose(0, 3, 1, 2)
        np.save(views.with_suffix(".npy"), whole.forward_all(["block10"], data=images)["block10"].astype(np.float16))
maps = np.concatenate([np.load(views.with_suffix(".npy")).reshape(-1, 112, 9, 12) for views in lists])
for layer, of in (("positions", "block10"), ("white_means", "means"), ("white_parts", "parts")):
    x = maps[:6000] if of == "block10" else head.forward_all([of], block10=maps.astype(np.float32))[of]
    x = np.asarray(np.moveaxis(x, 1, -1) if of == "block10" else x.reshape(len(x), 1, -1), np.float32)
    apart = (x[::2] - x[1::2]).reshape(-1, x.shape[-1])
    within = apart.T @ apart / len(apart) / 2
    values, directions = np.linalg.eigh(within + SHRINK * np.trace(within) / len(within) * np.eye(len(within)))
    white = directions * values**-0.5 @ directions.T
    for params in (head.params[layer], whole.params[layer]):
        params[0].data[...] = white.reshape(params[0].data.shape)
        params[1].data[...] = -white @ x.reshape(-1, len(white)).mean(axis=0)
whole.save(str(folder / "places.caffemodel"))
print(f"{folder}/places.caffemodel: a head of {len(maps) // 2} pairs of views")
