"""Ristretto's layers compared with Caffe's on numbers that were rounded by hand."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from netspec.layers import Context, Layer
from netspec.net.one_layer import make_layer

Build = Callable[..., Layer]
FIXED = "bw_layer_in: 6 fl_layer_in: 3 bw_layer_out: 8 fl_layer_out: 2 bw_params: 5 fl_params: 4"
KINDS = {
    "ConvolutionRistretto": "convolution_param { num_output: 3 kernel_size: 2 weight_filler { type: 'xavier' }"
    " bias_filler { type: 'uniform' min: -1 max: 1 } }",
    "DeconvolutionRistretto": "convolution_param { num_output: 3 kernel_size: 2 weight_filler { type: 'xavier' } }",
    "FcRistretto": "inner_product_param { num_output: 3 weight_filler { type: 'xavier' }"
    " bias_filler { type: 'uniform' min: -1 max: 1 } }",
}
PLAIN = {"FcRistretto": "InnerProduct"}


def fixed(values: torch.Tensor, bits: int, fraction: int) -> torch.Tensor:
    """Round value by value, halves away from zero."""
    found = []
    for value in values.flatten().tolist():
        most, step = 2 ** (bits - 1), 2.0**-fraction
        scaled = min(max(value, -most * step), (most - 1) * step) / step
        found.append(math.copysign(math.floor(abs(scaled) + 0.5), scaled) * step)
    return torch.tensor(found).reshape(values.shape)


def powers(values: torch.Tensor, least: int, most: int) -> torch.Tensor:
    found = []
    for value in values.flatten().tolist():
        exponent = min(max(math.floor(math.log2(abs(value)) + 0.5), least), most)
        found.append(math.copysign(2.0**exponent, value))
    return torch.tensor(found).reshape(values.shape)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["fixed", "powers"])
def test_layers_equal_caffes_on_rounded_numbers(build: Build, kind: str, precision: str) -> None:
    data = torch.randn(2, 2, 4, 5) * 3
    how = FIXED if precision == "fixed" else "precision: INTEGER_POWER_OF_2_WEIGHTS exp_min: -5 exp_max: -2"
    layer = build("ristretto", f"type: '{kind}' {KINDS[kind]} quantization_param {{ {how} }}", data.shape)
    plain = make_layer(
        f"type: '{PLAIN.get(kind, kind.removesuffix('Ristretto'))}' {KINDS[kind]}", [data.shape], Context(), 1
    )
    weights, bias = (blob.detach() for blob in layer.blobs)
    with torch.no_grad():
        plain.blobs[0].copy_(fixed(weights, 5, 4) if precision == "fixed" else powers(weights, -5, -2))
        plain.blobs[1].copy_(fixed(bias, 5, 4) if precision == "fixed" else bias)
        (expected,) = plain.run(fixed(data, 6, 3) if precision == "fixed" else data)
        expected = fixed(expected, 8, 2) if precision == "fixed" else expected
        (top,) = layer.run(data)
    np.testing.assert_allclose(top.numpy(), expected.numpy(), rtol=1e-5, atol=1e-5)
