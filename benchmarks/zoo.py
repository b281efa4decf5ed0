"""Prototxts of well-known architectures, so that benchmarks need no downloaded files.

Each function adds the layers of a net to a NetParameter ``n`` with the blob ``data``, and returns the blob of the
scores. The layers are in the order of the public files.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from netspec.proto.schema import NetParameter

WEIGHTS, BIAS = {"lr_mult": 1, "decay_mult": 1}, {"lr_mult": 2, "decay_mult": 0}
UNDECAYED, STATISTICS = {"lr_mult": 1, "decay_mult": 0}, {"lr_mult": 0, "decay_mult": 0}


def lenet(n: Any) -> str:
    """LeCun et al. 1998, as in Caffe's MNIST example."""
    top = pool(n, "pool1", conv(n, "conv1", "data", 20, 5), 2)
    top = pool(n, "pool2", conv(n, "conv2", top, 50, 5), 2)
    return _full(n, "ip2", relu(n, "relu1", _full(n, "ip1", top, 500)), 10)


def tiny(n: Any) -> str:
    """Three layers of at most 20 numbers, as in reinforcement learning and tutorials."""
    top = relu(n, "relu1", _full(n, "ip1", "data", 20))
    top = add(n, "TanH", "tanh2", _full(n, "ip2", top, 20))
    return _full(n, "ip3", top, 10)


def pnet(n: Any) -> str:
    """Zhang et al. 2016, MTCNN: the first net, on one window; whether it shows a face."""
    top = pool(n, "pool1", _prelu(n, "prelu1", conv(n, "conv1", "data", 10, 3)), 2)
    top = _prelu(n, "prelu2", conv(n, "conv2", top, 16, 3))
    top = _prelu(n, "prelu3", conv(n, "conv3", top, 32, 3))
    return conv(n, "conv4", top, 2, 1)


def rnet(n: Any) -> str:
    """MTCNN's second net, on one window; whether it shows a face."""
    top = pool(n, "pool1", _prelu(n, "prelu1", conv(n, "conv1", "data", 28, 3)), 3)
    top = pool(n, "pool2", _prelu(n, "prelu2", conv(n, "conv2", top, 48, 3)), 3)
    top = _prelu(n, "prelu4", _full(n, "conv4", _prelu(n, "prelu3", conv(n, "conv3", top, 64, 2)), 128))
    return _full(n, "conv5-1", top, 2)


def onet(n: Any) -> str:
    """MTCNN's third net, on one window; whether it shows a face."""
    top = pool(n, "pool1", _prelu(n, "prelu1", conv(n, "conv1", "data", 32, 3)), 3)
    top = pool(n, "pool2", _prelu(n, "prelu2", conv(n, "conv2", top, 64, 3)), 3)
    top = pool(n, "pool3", _prelu(n, "prelu3", conv(n, "conv3", top, 64, 3)), 2)
    top = _prelu(n, "prelu5", _full(n, "conv5", _prelu(n, "prelu4", conv(n, "conv4", top, 128, 2)), 256))
    return _full(n, "conv6-1", top, 2)


def cifar10_quick(n: Any) -> str:
    """Caffe's quick net for CIFAR-10."""
    top = relu(n, "relu1", pool(n, "pool1", conv(n, "conv1", "data", 32, 5, pad=2), 3))
    for k, width in ((2, 32), (3, 64)):
        top = _average(n, f"pool{k}", relu(n, f"relu{k}", conv(n, f"conv{k}", top, width, 5, pad=2)))
    return _full(n, "ip2", _full(n, "ip1", top, 64), 10)


def resnet50(n: Any) -> str:
    """He et al. 2015: 50 layers, the stride in a block's first convolution."""
    top = pool(n, "pool1", relu(n, "conv1_relu", _normalized(n, "conv1", "data", 64, 7, stride=2, pad=3, bias=True)), 3)
    for stage, (blocks, width) in enumerate(RESNET50, 2):
        for k in range(blocks):
            name, stride = f"res{stage}{'abcdef'[k]}", 2 if stage > 2 and not k else 1
            shortcut = top if k else _normalized(n, f"{name}_branch1", top, 4 * width, 1, stride=stride)
            top = relu(n, f"{name}_2a_relu", _normalized(n, f"{name}_branch2a", top, width, 1, stride=stride))
            top = relu(n, f"{name}_2b_relu", _normalized(n, f"{name}_branch2b", top, width, 3, pad=1))
            top = _normalized(n, f"{name}_branch2c", top, 4 * width, 1)
            top = relu(n, f"{name}_relu", _sum(n, name, shortcut, top))
    top = add(n, "Pooling", "pool5", top, pooling_param={"pool": "AVE", "kernel_size": 7, "stride": 1})
    return _full(n, "fc1000", top, 1000)


RESNET50 = ((3, 64), (4, 128), (6, 256), (3, 512))  # blocks and width of each stage


def mobilenet(n: Any) -> str:
    """Sandler et al. 2018: MobileNet v2, with plain ReLU as in its Caffe files."""
    top = relu(n, "relu1", _normalized(n, "conv1", "data", 32, 3, stride=2, pad=1))
    width = 32
    for number, (expansion, wide, stride) in enumerate(MOBILENET, 1):
        name, inner = f"block{number}", expansion * width
        inside = relu(n, f"{name}_expand_relu", _normalized(n, f"{name}_expand", top, inner, 1))
        inside = _normalized(n, f"{name}_depthwise", inside, inner, 3, stride=stride, pad=1, group=inner)
        inside = _normalized(n, f"{name}_linear", relu(n, f"{name}_depthwise_relu", inside), wide, 1)
        top = _sum(n, f"{name}_sum", top, inside) if stride == 1 and wide == width else inside
        width = wide
    top = relu(n, "conv_last_relu", _normalized(n, "conv_last", top, 1280, 1))
    top = add(n, "Pooling", "pool_last", top, pooling_param={"pool": "AVE", "global_pooling": True})
    return conv(n, "classifier", top, 1000, 1)


MOBILENET = (  # expansion, width, stride: where the public Caffe files have the strides
    (1, 16, 1),
    (6, 24, 2),
    (6, 24, 1),
    (6, 32, 2),
    (6, 32, 1),
    (6, 32, 1),
    (6, 64, 1),
    (6, 64, 1),
    (6, 64, 1),
    (6, 64, 1),
    (6, 96, 2),
    (6, 96, 1),
    (6, 96, 1),
    (6, 160, 2),
    (6, 160, 1),
    (6, 160, 1),
    (6, 320, 1),
)


def squeezenet(n: Any) -> str:
    """Iandola et al. 2016: SqueezeNet 1.1."""
    top = pool(n, "pool1", relu(n, "conv1_relu", conv(n, "conv1", "data", 64, 3, stride=2)), 3)
    for k, (squeezed, expanded) in enumerate(SQUEEZENET, 2):
        name = f"fire{k}"
        inside = relu(n, f"{name}_squeeze_relu", conv(n, f"{name}_squeeze", top, squeezed, 1))
        ones = relu(n, f"{name}_expand1_relu", conv(n, f"{name}_expand1", inside, expanded, 1))
        threes = relu(n, f"{name}_expand3_relu", conv(n, f"{name}_expand3", inside, expanded, 3, pad=1))
        top = add(n, "Concat", f"{name}_concat", ones, threes)
        if k in (3, 5):
            top = pool(n, f"pool{k}", top, 3)
    top = relu(n, "conv10_relu", conv(n, "conv10", _dropout(n, "drop9", top, 0.5), 1000, 1))
    top = add(n, "Pooling", "pool10", top, pooling_param={"pool": "AVE", "global_pooling": True})
    return top


SQUEEZENET = ((16, 64), (16, 64), (32, 128), (32, 128), (48, 192), (48, 192), (64, 256), (64, 256))

ZOO: dict[str, tuple[Callable[[Any], str], tuple[int, int, int]]] = {  # the layers, and the image (C, H, W)
    "tiny": (tiny, (10, 1, 1)),
    "pnet": (pnet, (3, 12, 12)),
    "rnet": (rnet, (3, 24, 24)),
    "onet": (onet, (3, 48, 48)),
    "lenet": (lenet, (1, 28, 28)),
    "cifar10_quick": (cifar10_quick, (3, 32, 32)),
    "resnet50": (resnet50, (3, 224, 224)),
    "mobilenet": (mobilenet, (3, 224, 224)),
    "squeezenet": (squeezenet, (3, 227, 227)),
}


def deploy(name: str) -> Any:
    """Return the NetParameter for deployment: input ``data``, output ``prob``."""
    n, (layers, image) = NetParameter(name=name), ZOO[name]
    add(n, "Input", "data", input_param={"shape": [{"dim": [1, *image]}]})
    add(n, "Softmax", "prob", layers(n))
    return n


def training(name: str, source: str, batch: int) -> Any:
    """Return the NetParameter for training on the LMDB ``source``."""
    n, (layers, _) = NetParameter(name=name), ZOO[name]
    reads = {"source": source, "batch_size": batch, "backend": "LMDB"}
    scaled = {"mean_value": [128], "scale": 1 / 128}
    add(n, "Data", "data", data_param=reads, transform_param=scaled)
    n.layer[0].top.append("label")
    add(n, "SoftmaxWithLoss", "loss", layers(n), "label")
    return n


def add(n: Any, kind: str, name: str, *bottoms: str, in_place: bool = False, **fields: Any) -> str:
    """Add a layer with one top, named as the layer, or as the bottom with ``in_place``; return the top."""
    top = bottoms[0] if in_place else name
    n.layer.add(name=name, type=kind, bottom=bottoms, top=[top], **fields)
    return top


def conv(n: Any, name: str, bottom: str, width: int, size: int, bias: bool = True, **others: int) -> str:
    """Add a convolution; ``others``: stride, pad, dilation, group. Return its top."""
    param = {key: [value] if key in ("stride", "pad", "dilation") else value for key, value in others.items()}
    param |= {"num_output": width, "kernel_size": [size], "bias_term": bias, "weight_filler": {"type": "msra"}}
    learned = [WEIGHTS, BIAS] if bias else [WEIGHTS]
    return add(n, "Convolution", name, bottom, param=learned, convolution_param=param)


def _normalized(n: Any, name: str, bottom: str, width: int, size: int, bias: bool = False, **others: int) -> str:
    """Return a convolution's top, normalized and scaled in place."""
    top = conv(n, name, bottom, width, size, bias, **others)
    add(n, "BatchNorm", f"{name}_bn", top, in_place=True, param=[STATISTICS] * 3)
    scales = {"bias_term": True}
    return add(n, "Scale", f"{name}_scale", top, in_place=True, param=[UNDECAYED] * 2, scale_param=scales)


def _full(n: Any, name: str, bottom: str, width: int) -> str:
    param = {"num_output": width, "weight_filler": {"type": "xavier"}}
    return add(n, "InnerProduct", name, bottom, param=[WEIGHTS, BIAS], inner_product_param=param)


def relu(n: Any, name: str, bottom: str) -> str:
    """Add a ReLU in place; return its top."""
    return add(n, "ReLU", name, bottom, in_place=True)


def _prelu(n: Any, name: str, bottom: str) -> str:
    return add(n, "PReLU", name, bottom, in_place=True)


def _dropout(n: Any, name: str, bottom: str, ratio: float) -> str:
    return add(n, "Dropout", name, bottom, in_place=True, dropout_param={"dropout_ratio": ratio})


def pool(n: Any, name: str, bottom: str, size: int, stride: int = 2, pad: int = 0) -> str:
    """Add a max pooling; return its top."""
    return add(n, "Pooling", name, bottom, pooling_param={"kernel_size": size, "stride": stride, "pad": pad})


def _average(n: Any, name: str, bottom: str) -> str:
    return add(n, "Pooling", name, bottom, pooling_param={"pool": "AVE", "kernel_size": 3, "stride": 2})


def _sum(n: Any, name: str, *bottoms: str) -> str:
    return add(n, "Eltwise", name, *bottoms)
