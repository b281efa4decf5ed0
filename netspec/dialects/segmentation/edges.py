"""Nets for edge detection (HED, RCF): images with edge maps, and a loss that balances edges and background.

Forks: s9xie/hed (Xie and Tu, Holistically-Nested Edge Detection, ICCV 2015), yun-liu/rcf (Liu et al., Richer
Convolutional Features for Edge Detection, CVPR 2017)
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F

from netspec.data.sources import Source
from netspec.data.transformer import Transformer
from netspec.dialects.segmentation.pairs import Array, pair_source
from netspec.layers.contract.base import Shape
from netspec.layers.data.files import ImageData
from netspec.layers.loss.losses import SigmoidCrossEntropyLoss
from netspec.proto.schema import copy_without


class EdgeMaps(ImageData):
    """Base of the two layers ImageLabelmapData: images and edge maps, mirrored and cropped in the same way.

    A list has lines ``image edges``; both can be resized bilinearly.
    """

    def edges(self, gray: Array) -> Array:
        """Return the labels of a gray image, 0 to 255."""
        raise NotImplementedError

    def open(self) -> Source | None:
        draws = self.draws
        bare = copy_without(self.param.transform_param, ("mean_file", "mean_value", "scale"))
        as_images = Transformer(bare, self.phase, self.context.at, draws.seed, draws.stream)  # the same random numbers

        def cut(image: Array, labels: Array, position: int) -> tuple[Array, Array]:
            if labels.shape[1:] != image.shape[1:]:
                found = f"the edges are {labels.shape[1]} x {labels.shape[2]}"
                raise self.error(f"{found}, the image {image.shape[1]} x {image.shape[2]}; expected the same", "top", 1)
            edges = self.edges(labels.astype(np.float32))
            return image, as_images([edges], range(position, position + 1))[0]

        return pair_source(self, self.param.image_data_param, cut, "image_labelmap_data_layer.cpp:105")

    def second_shape(self, data: Shape) -> Shape:
        return (data[0], 1, *data[2:])


class Balanced(SigmoidCrossEntropyLoss):
    """Base of the two losses: the cross entropy of each image, balanced between edges and background.

    Edges are weighted by the share of background pixels, and background pixels by the share of edges. Labels other
    than 1 and 0 are ignored. The sum is divided by N only.
    """

    of_others: ClassVar[float]  # an additional weight of background pixels
    not_exported = "it is for training"

    def forward(self, x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        x, targets = x.reshape(len(x), -1), targets.detach().reshape(len(x), -1)
        edges, others = (targets == 1).to(x), (targets == 0).to(x)
        count = (edges.sum(1, keepdim=True), others.sum(1, keepdim=True))
        weights = (edges * count[1] + self.of_others * others * count[0]) / (count[0] + count[1])
        return F.binary_cross_entropy_with_logits(x, targets.clamp(0, 1), weights, reduction="sum") / len(x)
