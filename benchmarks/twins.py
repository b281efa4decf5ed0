"""The nets of the benchmark, written by hand in PyTorch, with weights from a caffemodel.

Modules are created in the order of the prototxt's layers, so that weights are loaded in order. The results equal
netspec's; see tests/benchmarks/test_twins.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.detectors import HEADS
from benchmarks.zoo import GOOGLENET, MOBILENET, RESNET50, SQUEEZENET


def unit(feat: Tensor) -> Tensor:
    """Return descriptors (N, neurons) with length 1, as Reduction, Power and Scale make them."""
    return feat * (feat.square().sum(1, keepdim=True) + 1e-8).rsqrt()


class Siamese(nn.Module):
    """One tower of the paper's LeNet-like net, (N, 3, size, size); ``normalized``: descriptors of length 1."""

    def __init__(self, neurons: int, size: int = 224, normalized: bool = False) -> None:
        super().__init__()
        self.finish = unit if normalized else nn.Identity()
        self.conv1, self.conv2 = nn.Conv2d(3, 20, 5), nn.Conv2d(20, 50, 5)
        self.ip1 = nn.Linear(50 * (((size - 4) // 2 - 4) // 2) ** 2, 500)
        self.feat = nn.Linear(500, neurons)

    def forward(self, x: Tensor) -> Tensor:
        """Return the descriptors (N, neurons)."""
        x = F.max_pool2d(self.conv1(x), 2)
        x = F.max_pool2d(self.conv2(x), 2)
        return self.finish(self.feat(F.relu(self.ip1(x.flatten(1)))))


def conv_bn(inputs: int, outputs: int, size: int = 1, bias: bool = False, **others: Any) -> nn.Sequential:
    """Return a convolution and its normalization."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, size, bias=bias, **others), nn.BatchNorm2d(outputs))


class ResidualPair(nn.Module):
    """A residual block: two 3x3 convolutions plus the input; the last ReLU follows the sum."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.a, self.b = conv_bn(width, width, 3, padding=1), conv_bn(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, width, H, W)."""
        return F.relu(x + self.b(F.relu(self.a(x))))


class Resnet27(nn.Module):
    """One tower of the paper's residual net, (N, 3, size, size); ``normalized``: descriptors of length 1."""

    def __init__(self, neurons: int, size: int = 224, normalized: bool = False) -> None:
        super().__init__()
        self.finish = unit if normalized else nn.Identity()
        stages: list[nn.Module] = [conv_bn(3, 32, 3, stride=2, padding=1), nn.ReLU()]
        width = 32
        for wide, blocks in ((64, 1), (128, 2), (256, 5), (512, 3)):
            stages += [conv_bn(width, wide, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2, ceil_mode=True)]
            stages += [ResidualPair(wide) for _ in range(blocks)]
            width = wide
        self.stages = nn.Sequential(*stages)
        self.feat = nn.Linear(512 * (size // 32) ** 2, neurons)

    def forward(self, x: Tensor) -> Tensor:
        """Return the descriptors (N, neurons)."""
        return self.finish(self.feat(self.stages(x).flatten(1)))


class Tiny(nn.Module):
    """Three layers of at most 20 numbers, for (N, 10, 1, 1)."""

    def __init__(self) -> None:
        super().__init__()
        self.ip1, self.ip2, self.ip3 = nn.Linear(10, 20), nn.Linear(20, 20), nn.Linear(20, 10)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 10)."""
        return self.ip3(torch.tanh(self.ip2(F.relu(self.ip1(x.flatten(1))))))


class _Windows(nn.Module):
    """A net of MTCNN's, for windows (N, 3, side, side); it returns scores, (N, 2) or (N, 2, 1, 1)."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores."""
        return self.layers(x)


def _conv_prelu(inputs: int, outputs: int, size: int) -> tuple[nn.Module, nn.Module]:
    return nn.Conv2d(inputs, outputs, size), nn.PReLU(outputs)


def _pool_ceil(size: int) -> nn.Module:
    return nn.MaxPool2d(size, 2, ceil_mode=True)


def pnet() -> nn.Module:
    """MTCNN's first net, for windows of 12 pixels."""
    first = (*_conv_prelu(3, 10, 3), _pool_ceil(2))
    return _Windows(*first, *_conv_prelu(10, 16, 3), *_conv_prelu(16, 32, 3), nn.Conv2d(32, 2, 1))


def rnet() -> nn.Module:
    """MTCNN's second net, for windows of 24 pixels."""
    maps = (*_conv_prelu(3, 28, 3), _pool_ceil(3), *_conv_prelu(28, 48, 3), _pool_ceil(3), *_conv_prelu(48, 64, 2))
    return _Windows(*maps, nn.Flatten(), nn.Linear(576, 128), nn.PReLU(128), nn.Linear(128, 2))


def onet() -> nn.Module:
    """MTCNN's third net, for windows of 48 pixels."""
    maps = (*_conv_prelu(3, 32, 3), _pool_ceil(3), *_conv_prelu(32, 64, 3), _pool_ceil(3))
    maps = (*maps, *_conv_prelu(64, 64, 3), _pool_ceil(2), *_conv_prelu(64, 128, 2))
    return _Windows(*maps, nn.Flatten(), nn.Linear(1152, 256), nn.PReLU(256), nn.Linear(256, 2))


class Heads(nn.Module):
    """A net of MTCNN's with all its heads."""

    def __init__(self, windows: nn.Module, widths: Sequence[int]) -> None:
        super().__init__()
        *maps, scores = next(windows.children()).children()
        self.maps, heads = nn.Sequential(*maps), [scores]
        for width in widths:
            if isinstance(scores, nn.Conv2d):
                heads.append(nn.Conv2d(scores.in_channels, width, 1))
            elif isinstance(scores, nn.Linear):
                heads.append(nn.Linear(scores.in_features, width))
        self.heads = nn.ModuleList(heads)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return the scores (N, 2, ...) and the other heads' numbers."""
        x = self.maps(x)
        return [head(x) for head in self.heads]


class LeNet(nn.Module):
    """Caffe's LeNet, for images (N, 1, 28, 28)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(1, 20, 5), nn.Conv2d(20, 50, 5)
        self.ip1, self.ip2 = nn.Linear(800, 500), nn.Linear(500, 10)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 10)."""
        x = F.max_pool2d(self.conv1(x), 2)
        x = F.max_pool2d(self.conv2(x), 2)
        return self.ip2(F.relu(self.ip1(x.flatten(1))))


class Cifar10Quick(nn.Module):
    """Caffe's quick net for CIFAR-10, for images (N, 3, 32, 32)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(3, 32, 5, padding=2), nn.Conv2d(32, 32, 5, padding=2)
        self.conv3 = nn.Conv2d(32, 64, 5, padding=2)
        self.ip1, self.ip2 = nn.Linear(1024, 64), nn.Linear(64, 10)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 10)."""
        x = F.relu(F.max_pool2d(self.conv1(x), 3, 2, ceil_mode=True))
        x = F.avg_pool2d(F.relu(self.conv2(x)), 3, 2, ceil_mode=True)
        x = F.avg_pool2d(F.relu(self.conv3(x)), 3, 2, ceil_mode=True)
        return self.ip2(self.ip1(x.flatten(1)))


class Cifar10Full(nn.Module):
    """Caffe's full net for CIFAR-10, for images (N, 3, 32, 32)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(3, 32, 5, padding=2), nn.Conv2d(32, 32, 5, padding=2)
        self.conv3, self.ip1 = nn.Conv2d(32, 64, 5, padding=2), nn.Linear(1024, 10)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 10)."""
        x = _within_channel(F.relu(F.max_pool2d(self.conv1(x), 3, 2, ceil_mode=True)))
        x = _within_channel(F.avg_pool2d(F.relu(self.conv2(x)), 3, 2, ceil_mode=True))
        x = F.avg_pool2d(F.relu(self.conv3(x)), 3, 2, ceil_mode=True)
        return self.ip1(x.flatten(1))


def _within_channel(x: Tensor) -> Tensor:
    return x / (1 + 5e-5 * F.avg_pool2d(x.square(), 3, 1, 1)).pow(0.75)


class AlexNet(nn.Module):
    """For images (N, 3, 227, 227)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            *(nn.Conv2d(3, 96, 11, stride=4), nn.ReLU(inplace=True), nn.LocalResponseNorm(5), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(96, 256, 5, padding=2, groups=2), nn.ReLU(inplace=True)),
            *(nn.LocalResponseNorm(5), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(256, 384, 3, padding=1), nn.ReLU(inplace=True)),
            *(nn.Conv2d(384, 384, 3, padding=1, groups=2), nn.ReLU(inplace=True)),
            *(nn.Conv2d(384, 256, 3, padding=1, groups=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2)),
        )
        self.classifier = nn.Sequential(
            *(nn.Linear(9216, 4096), nn.ReLU(inplace=True), nn.Dropout()),
            *(nn.Linear(4096, 4096), nn.ReLU(inplace=True), nn.Dropout()),
            nn.Linear(4096, 1000),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 1000)."""
        return self.classifier(self.features(x).flatten(1))


class Inception(nn.Module):
    """GoogLeNet's Inception block: four parallel branches."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        one, reduce3, three, reduce5, five, pooled = widths  # as the columns of the paper's table 1
        self.one = nn.Conv2d(inputs, one, 1)
        self.reduce3, self.three = nn.Conv2d(inputs, reduce3, 1), nn.Conv2d(reduce3, three, 3, padding=1)
        self.reduce5, self.five = nn.Conv2d(inputs, reduce5, 1), nn.Conv2d(reduce5, five, 5, padding=2)
        self.pooled = nn.Conv2d(inputs, pooled, 1)
        self.outputs = one + three + five + pooled

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, outputs, H, W)."""
        three, five = self.three(F.relu(self.reduce3(x))), self.five(F.relu(self.reduce5(x)))
        return F.relu(torch.cat([self.one(x), three, five, self.pooled(F.max_pool2d(x, 3, 1, 1))], 1))


class GoogLeNet(nn.Module):
    """For images (N, 3, 224, 224)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3)
        self.reduce, self.conv2 = nn.Conv2d(64, 64, 1), nn.Conv2d(64, 192, 3, padding=1)
        blocks: list[nn.Module] = []
        width = 192
        for _, *widths in GOOGLENET:
            if widths:
                block = Inception(width, widths)
                blocks.append(block)
                width = block.outputs
            else:
                blocks.append(nn.MaxPool2d(3, 2, ceil_mode=True))
        self.blocks, self.classifier = nn.Sequential(*blocks), nn.Linear(width, 1000)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 1000)."""
        x = F.max_pool2d(F.relu(self.conv1(x)), 3, 2, ceil_mode=True)
        x = F.relu(self.reduce(F.local_response_norm(x, 5)))
        x = F.local_response_norm(F.relu(self.conv2(x)), 5)
        x = F.avg_pool2d(self.blocks(F.max_pool2d(x, 3, 2, ceil_mode=True)), 7, 1)
        return self.classifier(F.dropout(x.flatten(1), 0.4, self.training))


class Bottleneck(nn.Module):
    """A block of ResNet-50; a block that changes the shape has a projection in its shortcut."""

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = 4 * width
        self.shortcut = conv_bn(inputs, outputs, stride=stride) if inputs != outputs or stride > 1 else nn.Identity()
        self.a = conv_bn(inputs, width, stride=stride)
        self.b = conv_bn(width, width, 3, padding=1)
        self.c = conv_bn(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, 4 width, H', W')."""
        return F.relu(self.shortcut(x) + self.c(F.relu(self.b(F.relu(self.a(x))))))


class ResNet50(nn.Module):
    """For images (N, 3, 224, 224)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = conv_bn(3, 64, 7, bias=True, stride=2, padding=3)
        blocks, inputs = [], 64
        for stage, (count, width) in enumerate(RESNET50):
            for k in range(count):
                blocks.append(Bottleneck(inputs, width, 2 if stage and not k else 1))
                inputs = 4 * width
        self.blocks, self.fc = nn.Sequential(*blocks), nn.Linear(2048, 1000)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 1000)."""
        x = F.max_pool2d(F.relu(self.conv1(x)), 3, 2, ceil_mode=True)
        return self.fc(F.avg_pool2d(self.blocks(x), 7, 1).flatten(1))


class Inverted(nn.Module):
    """An inverted residual block of MobileNet v2; the input is added if the shapes are equal."""

    def __init__(self, inputs: int, expansion: int, outputs: int, stride: int) -> None:
        super().__init__()
        inner = expansion * inputs
        self.adds = stride == 1 and inputs == outputs
        self.expand = conv_bn(inputs, inner)
        self.depthwise = conv_bn(inner, inner, 3, stride=stride, padding=1, groups=inner)
        self.linear = conv_bn(inner, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, outputs, H', W')."""
        y = self.linear(F.relu(self.depthwise(F.relu(self.expand(x)))))
        return x + y if self.adds else y


class MobileNet(nn.Module):
    """For images (N, 3, 224, 224)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = conv_bn(3, 32, 3, stride=2, padding=1)
        blocks, inputs = [], 32
        for expansion, width, stride in MOBILENET:
            blocks.append(Inverted(inputs, expansion, width, stride))
            inputs = width
        self.blocks, self.last = nn.Sequential(*blocks), conv_bn(inputs, 1280)
        self.classifier = nn.Conv2d(1280, 1000, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 1000)."""
        x = F.relu(self.last(self.blocks(F.relu(self.conv1(x)))))
        return self.classifier(x.mean((2, 3), keepdim=True)).flatten(1)


class Fire(nn.Module):
    """SqueezeNet's fire module."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.ones, self.threes = nn.Conv2d(squeezed, expanded, 1), nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, 2 expanded, H, W)."""
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat([self.ones(x), self.threes(x)], 1))


class SqueezeNet(nn.Module):
    """For images (N, 3, 227, 227)."""

    def __init__(self) -> None:
        super().__init__()
        pool = nn.MaxPool2d(3, 2, ceil_mode=True)
        layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool]
        inputs = 64
        for k, (squeezed, expanded) in enumerate(SQUEEZENET, 2):
            layers += [Fire(inputs, squeezed, expanded), *([pool] if k in (3, 5) else [])]
            inputs = 2 * expanded
        self.layers, self.conv10 = nn.Sequential(*layers, nn.Dropout()), nn.Conv2d(inputs, 1000, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the scores (N, 1000)."""
        return F.relu(self.conv10(self.layers(x))).mean((2, 3))


CLASSIFIERS = {
    "tiny": Tiny,
    "pnet": pnet,
    "rnet": rnet,
    "onet": onet,
    "lenet": LeNet,
    "cifar10_quick": Cifar10Quick,
    "cifar10_full": Cifar10Full,
    "alexnet": AlexNet,
    "googlenet": GoogLeNet,
    "resnet50": ResNet50,
    "mobilenet": MobileNet,
    "squeezenet": SqueezeNet,
}
TOWERS = {"siamese": Siamese, "siamese_resnet27": Resnet27}


class Pairs(nn.Module):
    """The contrastive loss of a tower's descriptors of both halves of pairs (N, 6, H, W), margin 1."""

    def __init__(self, tower: nn.Module) -> None:
        super().__init__()
        self.tower = tower

    def forward(self, pairs: Tensor, similar: Tensor) -> Tensor:
        """Return the loss, a scalar; ``similar`` (N,) is 1 or 0."""
        difference = self.tower(pairs[:, :3]) - self.tower(pairs[:, 3:])
        squared = difference.square().sum(1)
        return torch.where(similar > 0, squared, F.relu(1 - squared.sqrt()).square()).mean() / 2


class Classified(nn.Module):
    """The cross entropy of a classifier's scores."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, images: Tensor, labels: Tensor) -> Tensor:
        """Return the loss, a scalar."""
        return F.cross_entropy(self.net(images).flatten(1), labels)


def net(name: str) -> nn.Module:
    """Return the twin of a net of the catalog: scores for a classifier, descriptors for ``[small/]siamese*_N``."""
    if name in CLASSIFIERS:
        return CLASSIFIERS[name]()
    tower, _, neurons = name.rpartition("/")[2].rpartition("_")
    small = name.startswith("small/")
    return TOWERS[tower](int(neurons), 64 if small else 224, normalized=small)


def with_heads(name: str) -> nn.Module:
    """Return the twin of benchmarks.detectors.mtcnn."""
    return Heads(net(name), HEADS[name])


def load(twin: nn.Module, caffemodel: str | Path) -> None:
    """Load the weights of a net with layers in the order of the twin's modules.

    A second tower, with layers named ``..._p``, shares the weights of the first.
    """
    from netspec.proto.binary import read_net_binary

    found = [layer for layer in read_net_binary(caffemodel).layer if layer.blobs and not layer.name.endswith("_p")]
    layers = iter([[np.array(blob.data, np.float32) for blob in layer.blobs] for layer in found])
    with torch.no_grad():
        for module in _learning(twin):
            values = next(layers)
            if isinstance(module, nn.BatchNorm2d):
                mean, variance, weight = values
                values = next(layers)
                factor = 1 / weight if weight else weight  # Caffe: a net that was not trained has 0
                _copy(module.running_mean, mean * factor)
                _copy(module.running_var, variance * factor)
            _copy(module.weight, values[0])
            if len(values) > 1 and module.bias is not None:
                _copy(module.bias, values[1])
    assert next(layers, None) is None, f"{caffemodel} has more layers than the twin"


def parameter_groups(twin: nn.Module, rate: float, decay: float) -> list[dict]:
    """Return the parameter groups for torch.optim: biases have twice the learning rate and no weight decay."""
    groups = []
    for module in _learning(twin):
        weighs = not isinstance(module, nn.BatchNorm2d)
        groups.append({"params": [module.weight], "lr": rate, "weight_decay": decay if weighs else 0})
        if getattr(module, "bias", None) is not None:
            groups.append({"params": [module.bias], "lr": 2 * rate if weighs else rate, "weight_decay": 0})
    return groups


def _learning(twin: nn.Module) -> Iterator[nn.Conv2d | nn.Linear | nn.BatchNorm2d | nn.PReLU]:
    for module in twin.modules():
        if isinstance(module, nn.Conv2d | nn.Linear | nn.BatchNorm2d | nn.PReLU):
            yield module


def _copy(target: Tensor | nn.Module | None, values: np.ndarray) -> None:
    assert isinstance(target, Tensor)
    target.copy_(torch.from_numpy(values).reshape(target.shape))
