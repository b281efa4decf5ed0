"""RCF: edges are 1 if more than half of the annotators marked them; those that fewer marked are ignored.

HED and RCF each change the meaning of Caffe's SigmoidCrossEntropyLoss, without a field that shows it.
"""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from netspec.dialects.layers import replace
from netspec.dialects.segmentation.edges import Balanced, EdgeMaps
from netspec.dialects.segmentation.pairs import Array
from netspec.layers import register

DECLARATIONS = ""  # no field determines this fork, so the dialect must be named


@register("ImageLabelmapData", "image_data_param", "transform_param", "data_param.prefetch")
class ImageLabelmapData(EdgeMaps):
    """Read images and edge maps from a list with lines ``image edges``, mirrored and cropped in the same way.

    top[0]  transformed images (batch_size, 3 or 1, H, W)
    top[1]  edges (batch_size, 1, H, W): 1 for gray values from 128, else gray / 255
    Fork: yun-liu/rcf, src/caffe/layers/image_labelmap_data_layer.cpp
    """

    @override
    def edges(self, gray: Array) -> Array:
        shares = gray / np.float32(255)
        return np.where(shares > 0.5, np.float32(1), shares)


@replace("SigmoidCrossEntropyLoss", "loss_param")
class BalancedLoss(Balanced):
    """The cross entropy of sigmoid(x) and edges, balanced in each image: an edge is weighted by the share of the rest.

    The rest is weighted by 1.1 times the share of edges. Labels other than 1 and 0 are ignored. The sum is divided by
    N.

    bottom[0]  x (N, ...)
    bottom[1]  edges, as many
    top[0]     the loss, ()
    Fork: yun-liu/rcf, src/caffe/layers/sigmoid_cross_entropy_loss_layer.cpp
    """

    of_others = 1.1
