"""Convert an ONNX model to Caffe's files: XFeat, a net for key points, as a prototxt with BVLC's layers.

python xfeat.py OUT xfeat_640x640.onnx. The net is that of Potje et al., "XFeat: Accelerated Features for Lightweight
Image Matching" (CVPR 2024), with BatchNorm folded into its convolutions, for gray images of mean 0 and deviation 1.
"""

import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L
from netspec.pycaffe import params as P

prototxt, caffemodel = (str(Path(sys.argv[1], name)) for name in ("deploy.prototxt", "xfeat.caffemodel"))
graph = onnx.load(sys.argv[2]).graph
stored = {value.name: onnx.numpy_helper.to_array(value) for value in graph.initializer}
theirs = {node.name.split("/")[2]: node for node in graph.node if node.op_type == "Conv"}
n, blobs = caffe.NetSpec(), {}


def convs(block, numbers, bottom, last=None, cell=1):
    """Append convolutions of a block, with ReLU, except after one named ``last``; store their weights in ``blobs``."""
    for k in numbers:
        node = theirs[f"{block}.{k}"]
        filters, bias = (stored[weights] for weights in node.input[1:])
        if cell > 1:  # its channels are the pixels of a cell, row by row
            filters = filters.reshape(-1, 1, cell, cell)
        (stride,) = {part.ints[0] for part in node.attribute if part.name == "strides"}
        size = filters.shape[2]
        shape = {"kernel_size": size, "pad": size // 2 if cell == 1 else 0, "stride": stride * cell}
        plain = last and k == numbers[-1]
        name = last if plain else f"{block}_{k}"
        n[name], blobs[name] = L.Convolution(bottom, num_output=len(bias), **shape), [filters, bias]
        bottom = n[name] if plain else L.ReLU(n[name], in_place=True)
    return bottom


def upsampled(name, bottom, factor):
    """Append bilinear upsampling. Dividing by upsampled ones repeats the outermost values beyond the border."""
    shape = {"kernel_size": 2 * factor, "stride": factor, "pad": factor // 2, "num_output": 64, "group": 64}
    bilinear = {"bias_term": False, "weight_filler": {"type": "bilinear"}, **shape}
    maps = bottom, L.Power(bottom, scale=0, shift=1)
    shared = {"name": name, "lr_mult": 0}
    sums, ones = (L.Deconvolution(x, convolution_param=bilinear, param=shared) for x in maps)
    n[name] = L.Eltwise(sums, L.Power(ones, power=-1), operation=P.Eltwise.PROD)
    return n[name]


n.data = L.Input(shape={"dim": [1, 1, 480, 640]})
n.normal = L.MVN(n.data, eps=1e-4)
quarter = L.Pooling(n.normal, pool=P.Pooling.AVE, kernel_size=4, stride=4)
n.block1 = L.Eltwise(convs("block1", range(4), n.normal), convs("skip1", [1], quarter, last="skip1"))
block3 = convs("block3", range(3), convs("block2", range(2), n.block1))
block4 = convs("block4", range(3), block3)
block5 = convs("block5", range(4), block4)
n.pyramid = L.Eltwise(block3, upsampled("up4", block4, 2), upsampled("up5", block5, 4))
descriptors = convs("block_fusion", range(3), n.pyramid, last="descriptors")
n.reliability = L.Sigmoid(convs("heatmap_head", range(3), descriptors, last="heatmap"))
cells = convs("keypoint_head", [0], n.normal, cell=8)
n.keypoints = L.Softmax(convs("keypoint_head", [1, 2, 3], cells, last="logits"))
Path(prototxt).write_text(f"# Key points and descriptors of gray images, 0 to 255. See SOURCE.md.\n{n.to_proto()}")
net = caffe.Net(prototxt, caffe.TEST)
for layer, values in blobs.items():
    for blob, value in zip(net.params[layer], values, strict=True):
        blob.data[...] = value
net.save(caffemodel)
image = np.random.default_rng(0).integers(0, 256, (1, 1, 640, 640)).astype(np.float32)
session = onnxruntime.InferenceSession(sys.argv[2], providers=["CPUExecutionProvider"])
feats, logits, heatmap = session.run(None, {"input": (image - image.mean()) / image.std()})
expected = {"descriptors": feats.transpose(0, 3, 1, 2), "logits": logits.transpose(0, 3, 1, 2), "reliability": heatmap}
net.blobs["data"].reshape(*image.shape)
net.forward(data=image)
off = {name: np.abs(net.blobs[name].data - value).max() for name, value in expected.items()}
print(f"{prototxt}: at most {', '.join(f'{value:.0e} ({name})' for name, value in off.items())} off the ONNX model")
