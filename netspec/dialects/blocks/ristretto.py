"""Ristretto: layers that simulate a chip with few bits, in the test phase. Training them is not supported.

MINIFLOAT and LRNRistretto are not supported.
"""

from __future__ import annotations

from typing import Any

import torch
from typing_extensions import override

from netspec.dialects.rcnn.regions import whole
from netspec.layers import Layer, register
from netspec.layers.common import InnerProduct
from netspec.layers.vision.convolution import Convolution, Deconvolution
from netspec.proto.schema import TEST, value

DECLARATIONS = """
message QuantizationParameter {
  enum Precision { DYNAMIC_FIXED_POINT = 0; MINIFLOAT = 1; INTEGER_POWER_OF_2_WEIGHTS = 2; }
  enum Rounding { NEAREST = 0; STOCHASTIC = 1; }
  optional Precision precision = 1 [default = DYNAMIC_FIXED_POINT];
  optional Rounding rounding_scheme = 2 [default = NEAREST];
  optional uint32 bw_layer_in = 3 [default = 32];
  optional uint32 bw_layer_out = 4 [default = 32];
  optional uint32 bw_params = 5 [default = 32];
  optional int32 fl_layer_in = 6 [default = 16];
  optional int32 fl_layer_out = 7 [default = 16];
  optional int32 fl_params = 8 [default = 16];
  optional uint32 mant_bits = 9 [default = 23];
  optional uint32 exp_bits = 10 [default = 8];
  optional int32 exp_min = 11 [default = -8];
  optional int32 exp_max = 12 [default = -1];
}
extend LayerParameter {
  optional QuantizationParameter quantization_param = 1145;
}
"""

GROUP = "quantization_param"
FIXED_POINT, MINIFLOAT = 0, 1  # QuantizationParameter.Precision
NEAREST = 0  # QuantizationParameter.Rounding


def fixed_point(x: torch.Tensor, bits: int, fraction: int) -> torch.Tensor:
    """Return the nearest fixed-point numbers with ``bits`` bits, ``fraction`` of them fractional, with saturation."""
    step, most = 2.0**-fraction, 2.0 ** (bits - 1)
    return (whole(x.double().clamp(-most * step, (most - 1) * step) / step) * step).to(x)


def power_of_two(x: torch.Tensor, least: int, most: int) -> torch.Tensor:
    """Round x to plus or minus a power of two between 2^least and 2^most."""
    exponent = whole(x.abs().log2().double()).clamp(least, most)
    return torch.where(x >= 0, 1.0, -1.0) * torch.exp2(exponent).to(x)


class _Quantized(Layer):
    """Base of the layers. Bottoms, blobs and tops are rounded according to quantization_param."""

    not_exported = "its numbers are rounded to few bits"

    def setup(self) -> None:
        super().setup()
        param = value(self.param, GROUP)
        if param.precision == MINIFLOAT:
            raise self.error("precision MINIFLOAT is not supported", GROUP, "precision")
        if param.rounding_scheme != NEAREST:
            raise self.error("only rounding_scheme NEAREST is supported", GROUP, "rounding_scheme")
        if self.phase != TEST:
            raise self.error("runs in phase TEST only; its training is not supported")
        self.fixed: bool = param.precision == FIXED_POINT

    @override
    def blob(self, index: int) -> torch.Tensor:
        param, blob = value(self.param, GROUP), super().blob(index)
        if self.fixed:
            return fixed_point(blob, param.bw_params, param.fl_params)
        return power_of_two(blob, param.exp_min, param.exp_max) if index == 0 else blob

    def forward(self, *bottoms: torch.Tensor) -> Any:
        param: Any = value(self.param, GROUP)
        if not self.fixed:
            return super().forward(*bottoms)
        tops = super().forward(*(fixed_point(bottom, param.bw_layer_in, param.fl_layer_in) for bottom in bottoms))
        several = tops if isinstance(tops, tuple) else (tops,)
        return tuple(fixed_point(top, param.bw_layer_out, param.fl_layer_out) for top in several)


@register("ConvolutionRistretto", "convolution_param", GROUP)
class ConvolutionRistretto(_Quantized, Convolution):
    """A Convolution with rounded numbers.

    bottom[i]  (N, C, H, W)
    top[i]     (N, num_output, H', W') as Convolution's
    blobs      as Convolution's; they are rounded when they are used
    Fork: Ristretto, src/caffe/ristretto/layers/conv_ristretto_layer.cpp, base_ristretto_layer.cpp
    """


@register("DeconvolutionRistretto", "convolution_param", GROUP)
class DeconvolutionRistretto(_Quantized, Deconvolution):
    """A Deconvolution with rounded numbers.

    bottom[i]  (N, C, H, W)
    top[i]     (N, num_output, H', W') as Deconvolution's
    blobs      as Deconvolution's; they are rounded when they are used
    Fork: Ristretto, src/caffe/ristretto/layers/deconv_ristretto_layer.cpp
    """


@register("FcRistretto", "inner_product_param", GROUP)
class FcRistretto(_Quantized, InnerProduct):
    """An InnerProduct with rounded numbers.

    bottom[0]  (N, ...)
    top[0]     (N, num_output)
    blobs      as InnerProduct's; they are rounded when they are used
    Fork: Ristretto, src/caffe/ristretto/layers/fc_ristretto_layer.cpp
    """
