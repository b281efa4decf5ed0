"""NVIDIA Caffe: a BatchNorm that also has the slopes and biases of a Scale."""

from __future__ import annotations

import torch

from netspec.dialects.layers import replace
from netspec.dialects.not_learned import NotLearned
from netspec.layers import normalization
from netspec.proto.schema import has, value

DECLARATIONS = """
extend BatchNormParameter {
  optional FillerParameter scale_filler = 5;
  optional FillerParameter bias_filler = 6;
  optional bool scale_bias = 7 [default = false];
}
"""

GROUP = "batch_norm_param"
SLOPES, BIASES = 3, 4


@replace(
    "BatchNorm",
    GROUP,
    f"{GROUP}.scale_filler",
    f"{GROUP}.bias_filler",
    f"{GROUP}.scale_bias",
)
class BatchNorm(NotLearned, normalization.BatchNorm):
    """Caffe's BatchNorm; with scale_bias, the top is multiplied by learnable slopes, and learnable biases are added.

    bottom[0]  (N, C) or (N, C, ...)
    top[0]     the same shape
    blobs[0]   sum of means     (C,)
    blobs[1]   sum of variances (C,)
    blobs[2]   sum of weights   (1,)                                   the divisor of the other two
    blobs[3]   slopes (C,), 1 unless scale_filler is given             only with scale_bias
    blobs[4]   biases (C,), 0 unless bias_filler is given              only with scale_bias
    Fork: NVIDIA/caffe, src/caffe/layers/batch_norm_layer.cpp
    """

    not_learned = frozenset(range(SLOPES))

    def setup(self) -> None:
        super().setup()
        param = self.param.batch_norm_param
        self.scales: bool = value(param, "scale_bias")
        for name, start in (("scale_filler", 1.0), ("bias_filler", 0.0)) if self.scales else ():
            self.add_blob((self.channels,), value(param, name) if has(param, name) else None, value=start)

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        top = super().forward(data)
        if not self.scales:
            return top
        slope, bias = (self.blob(i).reshape(-1, *(1,) * (data.dim() - 2)) for i in (SLOPES, BIASES))
        return top * slope + bias
