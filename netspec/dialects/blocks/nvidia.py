"""NVIDIA's and Intel's Caffe: a BatchNorm that also has the slopes and biases of a Scale."""

from __future__ import annotations

from dataclasses import replace as changed

import torch
from typing_extensions import override

from netspec.dialects.layers import replace
from netspec.graph.plan import Param
from netspec.layers import normalization
from netspec.proto.schema import has, value

DECLARATIONS = """
extend BatchNormParameter {
  optional FillerParameter scale_filler = 5;
  optional FillerParameter bias_filler = 6;
  optional bool scale_bias = 7 [default = false];
  optional bool use_weight_bias = 1005 [default = true];
  optional bool bias_term = 1006 [default = true];
  optional FillerParameter filler = 1007;
}
"""

GROUP = "batch_norm_param"
ADDED = ("scale_filler", "bias_filler", "scale_bias", "use_weight_bias", "bias_term", "filler")
SLOPES, BIASES = 3, 4
LEAST_EPS = 1e-5  # NVIDIA's, and cuDNN's


@replace("BatchNorm", GROUP, *(f"{GROUP}.{name}" for name in ADDED))
class BatchNorm(normalization.BatchNorm):
    """Caffe's BatchNorm, multiplied by learnable slopes, plus learnable biases.

    NVIDIA's has them with scale_bias, or if one of the fillers is given. Its statistics are moving averages, with a
    weight of 1: S = S moving_average_fraction + (1 - moving_average_fraction) times the batch's; the first batch's as
    they are. lr_mult and decay_mult are 0 for the statistics and 1 for the others, whatever ``param`` says, and eps is
    at least 1e-5. Intel's has them with use_weight_bias, or if ``filler`` is given; the rest is Caffe's.

    bottom[0]  (N, C) or (N, C, ...)
    top[0]     the same shape
    blobs[0]   sum, or moving average, of means     (C,)
    blobs[1]   sum, or moving average, of variances (C,)
    blobs[2]   sum of weights, or 1                 (1,)               the divisor of the other two
    blobs[3]   slopes (C,), 1 unless scale_filler or filler is given   only with slopes and biases
    blobs[4]   biases (C,), 0 unless bias_filler is given              only with slopes and biases
    Fork: NVIDIA/caffe, src/caffe/layers/batch_norm_layer.cpp, cudnn_batch_norm_layer.cu; intel/caffe,
    src/caffe/layers/mkldnn_batch_norm_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.batch_norm_param
        is_intels = has(param, "use_weight_bias") or has(param, "filler")
        fillers = ("filler" if is_intels else "scale_filler", "bias_filler")
        wanted = value(param, "use_weight_bias" if is_intels else "scale_bias")
        self.scales: bool = wanted or (not is_intels and any(has(param, name) for name in fillers))
        self.is_nvidias = self.scales and not is_intels
        if is_intels and not value(param, "bias_term"):
            raise self.error("slopes without biases are not supported; remove bias_term: false", GROUP, "bias_term")
        self.first_weight = float(self.is_nvidias)
        super().setup()
        for name, start in zip(fillers, (1.0, 0.0), strict=True) if self.scales else ():
            self.add_blob((self.channels,), value(param, name) if has(param, name) else None, value=start)

    @override
    def check_params(self) -> None:
        if not self.is_nvidias:
            super().check_params()

    @override
    def param_spec(self, j: int, given: Param | None) -> Param:
        if self.is_nvidias:
            learned = float(j >= SLOPES)
            return changed(given or super().param_spec(j, None), lr_mult=learned, decay_mult=learned)
        spec = super().param_spec(j, given)
        return changed(spec, lr_mult=1.0) if given is None and j >= SLOPES else spec

    @property
    @override
    def eps(self) -> float:
        return max(super().eps, LEAST_EPS) if self.is_nvidias else super().eps

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        top = super().forward(data)
        if not self.scales:
            return top
        slope, bias = (self.blob(i).reshape(-1, *(1,) * (data.dim() - 2)) for i in (SLOPES, BIASES))
        return top * slope + bias

    @override
    @torch.no_grad()
    def add(self, mean: torch.Tensor, variance: torch.Tensor, unbiased: float = 1.0) -> None:
        if not self.is_nvidias:
            super().add(mean, variance, unbiased)
            return
        before = self.stored_statistics()  # those of weights of Caffe's are sums
        is_first = all(bool((stored == 0).all()) for stored in before)
        keep = 0.0 if is_first else self.param.batch_norm_param.moving_average_fraction
        for i, (stored, new) in enumerate(zip(before, (mean, variance * unbiased), strict=True)):
            self.blob(i).copy_(stored * keep + new * (1 - keep))
        self.blob(2).fill_(1.0)
