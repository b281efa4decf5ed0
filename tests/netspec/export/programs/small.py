"""Small, converted from small.prototxt."""

from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import nn


def check_shapes(expected, *inputs):
    """Raise an error for inputs of other shapes. A name stands for any size, and equal names for equal sizes."""
    sizes = {}
    for (name, shape), x in zip(expected.items(), inputs, strict=True):
        for size, wanted in zip(x.shape, shape, strict=False):
            if isinstance(wanted, str):
                sizes.setdefault(wanted, size)
        shape = tuple(sizes.get(wanted, wanted) for wanted in shape)
        if tuple(x.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(x.shape)}, expected {shape}")


class Small(nn.Module):
    """data (N, 3, H, W) -> prob (N, 5)."""

    expected = {
        "data": ("N", 3, "H", "W"),
    }

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 4, kernel_size=3)
        self.bn1 = nn.BatchNorm2d(4)
        self.fc_3 = nn.Linear(4, 5)

    def forward(self, data):
        check_shapes(self.expected, data)
        x = self.conv1(data)
        x = self.bn1(x)
        x = F.relu(x)
        x = F.max_pool2d(x, 3, stride=2, ceil_mode=True)
        x = F.adaptive_avg_pool2d(x, 1)
        x = self.fc_3(x.flatten(1))
        x = F.softmax(x, dim=1)
        return x


def load(weights=Path(__file__).with_suffix(".safetensors")):
    """Return the net with its trained weights, for inference."""
    net = Small()
    net.load_state_dict(load_file(weights))
    return net.eval()


if __name__ == "__main__":
    outputs = load()(torch.zeros(1, 3, 12, 12))
    print("prob", tuple(outputs.shape))
