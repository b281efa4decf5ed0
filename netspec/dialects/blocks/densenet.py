"""A block of DenseNet as one layer, which does not copy the maps that it concatenates. Fork: Tongcheng/caffe."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.not_learned import NotLearned
from netspec.exact.layout import of_one_layout
from netspec.layers import register
from netspec.layers.contract.base import Shape
from netspec.proto.schema import TRAIN, value

DECLARATIONS = """
message DenseBlockParameter {
  optional int32 numTransition = 1 [default = 40];
  optional int32 initChannel = 2 [default = 16];
  optional int32 growthRate = 3 [default = 12];
  optional int32 pad_h = 4 [default = 1];
  optional int32 pad_w = 5 [default = 1];
  optional int32 conv_verticalStride = 6 [default = 1];
  optional int32 conv_horizentalStride = 7 [default = 1];
  optional int32 filter_H = 8 [default = 3];
  optional int32 filter_W = 9 [default = 3];
  optional FillerParameter Filter_Filler = 10;
  optional FillerParameter BN_Scaler_Filler = 11;
  optional FillerParameter BN_Bias_Filler = 12;
  optional int32 gpuIdx = 15 [default = 0];
  optional bool use_dropout = 16 [default = false];
  optional float dropout_amount = 17 [default = 0];
  optional bool use_BC = 18 [default = false];
  optional bool BC_ultra_space_efficient = 19 [default = false];
  optional int32 workspace_MB = 20 [default = 8];
  optional float moving_average_fraction = 21 [default = 0.1];
}
extend LayerParameter {
  optional DenseBlockParameter denseblock_param = 1147;
}
"""

GROUP = "denseblock_param"
EPS = 1e-5  # CUDNN_BN_MIN_EPSILON
FIXED = {"pad_h": 1, "pad_w": 1, "conv_verticalStride": 1, "conv_horizentalStride": 1, "filter_H": 3, "filter_W": 3}


@register("DenseBlock", GROUP)
class DenseBlock(NotLearned):
    """Append growthRate channels numTransition times, by BN, ReLU and a 3 x 3 convolution of all channels so far.

    With use_BC, a 1 x 1 convolution, BN and ReLU first reduce the input of the 3 x 3 convolution to 4 growthRate
    channels. In training, BN uses the batch, and its averages move by moving_average_fraction toward the batch's mean
    and unbiased variance; in testing it uses these averages. With use_dropout, the appended channels pass a Dropout of
    dropout_amount in training. This is the fork's code for GPUs; its code for CPUs has other averages.

    bottom[0]  (N, C, H, W); C replaces initChannel, which is wrong in caffe_ocr's files
    top[0]     (N, C + numTransition growthRate, H, W)
    blobs[0 T ...]  for T = numTransition steps, step i's at 0 T + i: filters (growthRate, C_i, 3, 3), where C_i is
               C + i growthRate, or 4 growthRate with use_BC; then at 1 T slopes, at 2 T biases, at 3 T means
               and at 4 T variances (1, C, 1, 1); with use_BC at 5 T filters (4 growthRate, C, 1, 1), and at 6 T to 9 T
               slopes, biases, means and variances of the second BN; finally one unused number
    Fork: Tongcheng/caffe, src/caffe/layers/DenseBlock_layer.cu
    """

    not_exported = "it is a net of its own; write its steps as layers"

    def setup(self) -> None:
        self.settings = p = value(self.param, GROUP)
        shape = self.bottom_shapes[0]
        if len(shape) != 4:
            raise self.error(f"found a bottom of shape {shape}, expected (N, C, H, W)", "bottom")
        for name, only in FIXED.items():
            if getattr(p, name) != only:
                raise self.error(f"{name} must be {only}, as the fork's code takes it to be", GROUP, name)
        check_at_least_1(self, GROUP, "numTransition", "growthRate")
        if not 0 <= p.dropout_amount < 1:
            raise self.error("dropout_amount must be at least 0 and less than 1", GROUP, "dropout_amount")
        self.steps = steps = p.numTransition
        inner = 4 * p.growthRate
        widths = [shape[1] + i * p.growthRate for i in range(steps)]
        for width in widths:
            self.add_blob((p.growthRate, inner if p.use_BC else width, 3, 3), p.Filter_Filler)
        self._add_norms(widths)
        if p.use_BC:
            for width in widths:
                self.add_blob((inner, width, 1, 1), p.Filter_Filler)
            self._add_norms([inner] * steps)
        self.add_blob((1,))
        kept = [3, 4, 8, 9] if p.use_BC else [3, 4]
        self.not_learned = frozenset({i * steps + j for i in kept for j in range(steps)} | {len(self.blobs) - 1})

    def _add_norms(self, widths: Sequence[int]) -> None:
        for filler in (self.settings.BN_Scaler_Filler, self.settings.BN_Bias_Filler):
            for width in widths:
                self.add_blob((1, width, 1, 1), filler)
        for start in (0.0, 1.0):
            for width in widths:
                self.add_blob((1, width, 1, 1), value=start)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        images, channels, *pixels = bottom_shapes[0]
        return [(images, channels + self.steps * self.settings.growthRate, *pixels)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        p = self.settings
        for i in range(self.steps):
            maps = self._normalized(data, self.steps, i)
            if p.use_BC:
                maps = F.conv2d(maps, self.blob(5 * self.steps + i))
                maps = self._normalized(maps, 6 * self.steps, i)
            maps = F.conv2d(maps, self.blob(i), padding=1)
            if p.use_dropout and self.phase == TRAIN:
                drawn = maps.new_empty(maps.shape)  # in Caffe's order, whatever the layout of the maps
                drawn.bernoulli_(1 - p.dropout_amount, generator=self.context.random.on(maps.device))
                maps = maps * drawn / (1 - p.dropout_amount)
            data = torch.cat([data, maps], dim=1)
        return data

    def _normalized(self, maps: torch.Tensor, first: int, step: int) -> torch.Tensor:
        """Return BN and ReLU of maps; the slopes of all steps begin at blob ``first``."""
        slope, bias, mean, variance = (self.blob(first + k * self.steps + step).reshape(-1) for k in range(4))
        fraction, learning = self.settings.moving_average_fraction, self.phase == TRAIN
        moving = mean.detach(), variance.detach()
        return F.relu(F.batch_norm(of_one_layout(maps), *moving, slope, bias, learning, fraction, EPS))
