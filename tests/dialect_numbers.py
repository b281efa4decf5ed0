"""Layers of dialects with inputs, and the expected results, which were computed by plain loops over boxes and pixels.

Results of the forks themselves are in test_forks_golden.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from netspec.proto.schema import TEST, TRAIN

REGIONS = [  # image, x1, y1, x2, y2 in pixels of the image; the map is half as large
    [0, 0, 0, 11, 9],
    [1, 2, 1, 6, 5],
    [0, 3, 3, 3, 3],
    [1, 8, 4, 30, 30],  # beyond the map
    [0, 40, 40, 50, 50],  # outside
    [0, -9, -7, 4, 1],
    [1, 0.9, 1, 4.9, 3.1],
    [1, 6, 6, 2, 2],  # turned inside out
]
TRUTH = [  # image, label, instance, xmin, ymin, xmax, ymax, difficult
    [0, 1, 0, 0.10, 0.10, 0.40, 0.45, 0],
    [0, 3, 1, 0.50, 0.40, 0.90, 0.95, 0],
    [0, 3, 2, 0.20, 0.15, 0.45, 0.50, 1],
    [2, 2, 0, 0.30, 0.05, 0.80, 0.60, 0],
    [-1, 0, 0, 0.00, 0.00, 0.00, 0.00, 0],
]
IN_CELLS = [  # of two images: class, x, y, width, height
    [[1, 0.4, 0.45, 0.5, 0.6], [0, 0.9, 0.1, 0.2, 0.3], [0, 0.41, 0.46, 0.5, 0.6], [0] * 5],
    [[1, 0.7, 0.72, 0.6, 0.5], [0] * 5, [0] * 5, [0] * 5],
]


def priors(count: int, largest: float) -> np.ndarray:
    """Boxes, some of them partly outside, and variances: (1, 2, 4 count)."""
    rng = np.random.default_rng(3)
    center, half = rng.uniform(0.1, 0.9, (count, 2)), rng.uniform(0.05, largest, (count, 2))
    boxes = np.concatenate([center - half, center + half], axis=1)
    return np.stack([boxes.reshape(-1), np.tile([0.1, 0.15, 0.2, 0.25], count)])[None]


GIVEN = {
    "regions": np.array(REGIONS),
    "forward": np.array(REGIONS[:-1]),
    "columns": np.array(REGIONS)[:, :, None, None],
    "truth": np.array(TRUTH)[None, None],
    "cells": np.array(IN_CELLS)[:, None],
    "priors16": priors(16, 0.3),
    "priors20": priors(20, 0.2),
    "texts": np.array([[1, 2, 0], [2, 2, 0]]),
    "others": np.array([[0, 1, 2], [1, 1, 2]]),
    "edges": np.array([[0.25, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]]),
}


Draw = Callable[[np.random.Generator], np.ndarray]  # one array, drawn from a generator


def normal(*shape: int) -> Draw:
    return lambda rng: rng.normal(size=shape)


def uniform(*shape: int) -> Draw:
    return lambda rng: rng.uniform(size=shape)


def integers(*shape: int, below: int) -> Draw:
    return lambda rng: rng.integers(0, below, size=shape)


def positions(*shape: int, of: int) -> Draw:
    """Whole numbers from 0 to ``of`` - 1, none of them twice in a map of a shape (N, C, H, W)."""
    images, channels, height, width = shape
    return lambda rng: np.stack([rng.permutation(of)[: height * width] for _ in range(images * channels)]).reshape(
        shape
    )


@dataclass(frozen=True)
class Case:
    """A layer of a dialect, its bottoms, and what is expected of one pass forward and backward.

    A bottom is drawn, or is the name of an array in GIVEN; the ``fixed`` ones follow the others and get no gradient.
    ``expected`` are sums of numbers times fixed weights: one for each top, then one for each gradient of a bottom and a
    blob, then one for each blob that the pass changed. ``is_derivative`` is False where the gradient is Caffe's, and
    not the derivative of what the layer computes.
    """

    dialect: str
    layer: str
    bottoms: Sequence[Draw | str]
    expected: Sequence[float]
    fixed: Sequence[Draw | str] = ()
    phase: int = TEST
    tops: int = 1
    is_derivative: bool = True


NUMBERS = [
    Case(
        "blocks",
        'type: "Axpy"',
        [normal(2, 3), normal(2, 3, 4, 5), normal(2, 3, 4, 5)],
        [-9.144523, -0.5809045, -4.328014, 35.55517],
    ),
    Case(
        "blocks",
        'type: "Axpy"',
        [normal(2, 3, 1, 1), normal(2, 3, 4, 5), normal(2, 3, 4, 5)],
        [-9.144523, -0.5809045, -4.328014, 35.55517],
    ),
    Case(
        "blocks",
        'type: "DepthwiseConvolution" convolution_param { num_output: 3 group: 3 kernel_size: 3 pad: 1 stride: 2 }',
        [normal(2, 3, 5, 6)],
        [4.418644, -0.645652, 12.88407, 2.51108],
    ),
    Case(
        "blocks",
        'type: "DepthwiseConvolution" convolution_param { num_output: 6 kernel_size: 3 pad: 1 stride: 2 }',
        [normal(2, 3, 5, 6)],
        [-3.800892, -1.173277, 3.268382, 2.398764],
    ),
    Case(
        "blocks",
        'type: "ConvolutionDepthwise" convolution_param { num_output: 3 kernel_size: 3 pad: 1 stride: 2 }',
        [normal(2, 3, 5, 6)],
        [4.418644, -0.645652, 12.88407, 2.51108],
    ),
    Case(
        "blocks",
        'type: "ConvolutionDepthwise" convolution_param { kernel_size: 3 pad: 1 stride: 2 }',
        [normal(2, 3, 5, 6)],
        [4.418644, -0.645652, 12.88407, 2.51108],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { zoom_factor: 3 }',
        [normal(2, 2, 5, 6)],
        [-3.004576, -13.31617],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { shrink_factor: 2 }',
        [normal(2, 2, 5, 6)],
        [1.865974, 1.746126],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { shrink_factor: 2 zoom_factor: 2 }',
        [normal(2, 2, 5, 6)],
        [0.8491599, -1.999516],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { height: 4 width: 1 }',
        [normal(2, 2, 5, 6)],
        [-0.5035441, -0.6339109],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { height: 5 width: 6 }',
        [normal(2, 2, 5, 6)],
        [1.074569, 35.55517],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { zoom_factor: 2 pad_beg: -1 }',
        [normal(2, 2, 5, 6)],
        [-5.237909, 3.71103],
    ),
    Case(
        "blocks",
        'type: "Interp" interp_param { height: 6 width: 7 pad_beg: -1 pad_end: -2 }',
        [normal(2, 2, 5, 6)],
        [2.649096, 1.30232],
    ),
    Case(
        "blocks",
        'type: "Interp"',
        [normal(2, 2, 5, 6)],
        [-1.302871, 2.012695],
        fixed=[normal(1, 1, 8, 2)],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param { scale: 2 }',
        [normal(2, 3, 2, 3)],
        [1.619307, -2.100046],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param { scale: 2 }',
        [normal(2, 2, 3, 2)],
        [1.99904, -0.4281582],
        fixed=[positions(2, 2, 3, 2, of=24)],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param {  }',
        [normal(2, 2, 3, 2)],
        [1.99904, -0.4281582],
        fixed=[positions(2, 2, 3, 2, of=24)],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param { scale: 2 pad_out_h: true }',
        [normal(2, 2, 3, 2)],
        [-1.389119, 0.8804026],
        fixed=[positions(2, 2, 3, 2, of=20)],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param { scale_h: 3 scale_w: 2 }',
        [normal(2, 2, 3, 2)],
        [-2.540405, 1.104023],
        fixed=[positions(2, 2, 3, 2, of=36)],
    ),
    Case(
        "blocks",
        'type: "Upsample" upsample_param { scale: 2 upsample_h: 7 upsample_w: 5 }',
        [normal(2, 2, 3, 2)],
        [-1.444965, 1.186596],
        fixed=[positions(2, 2, 3, 2, of=35)],
    ),
    Case(
        "blocks",
        (
            'type: "BN" bn_param { slope_filler { type: "constant" } bias_filler { type: "constant" } momentum: '
            "0.8 eps: 0.01 }"
        ),
        [normal(3, 2, 4, 5)],
        [-18.03105, 41.6419, 0.7585003, 6.177052, -0.7836719, -0.9059258],
        phase=TRAIN,
    ),
    Case(
        "blocks",
        (
            'type: "BN" bn_param { slope_filler { type: "constant" } bias_filler { type: "constant" } momentum: '
            "0.8 eps: 0.01 }"
        ),
        [normal(3, 2, 4, 5)],
        [2.543284, 38.4089, -7.189967, 6.177052],
    ),
    Case(
        "blocks",
        (
            'type: "BN" bn_param { slope_filler { type: "constant" } bias_filler { type: "constant" } momentum: '
            "0.8 eps: 0.01 }"
        ),
        [normal(3, 2)],
        [1.374197, 0.3721634, -0.7686477, -0.2558614, -0.6577409, -0.9418001],
        phase=TRAIN,
    ),
    Case(
        "blocks",
        (
            'type: "BN" bn_param { slope_filler { type: "constant" } bias_filler { type: "constant" } momentum: '
            "0.8 eps: 0.01 }"
        ),
        [normal(3, 2, 4, 2)],
        [-5.262455, 14.67034, -0.2807398, 0.772356, -0.7396411, -0.9352907],
        phase=TRAIN,
    ),
    Case(
        "blocks",
        (
            'type: "BN" bn_param { slope_filler { type: "constant" } bias_filler { type: "constant" } momentum: '
            "0.8 eps: 0.01 frozen: true }"
        ),
        [normal(2, 3, 4, 4)],
        [0.0165768, 35.17999, -1.651917, 4.781834],
        phase=TRAIN,
    ),
    Case(
        "blocks",
        'type: "BN" bn_param { scale_filler { type: "constant" } }',
        [normal(3, 2, 4, 5)],
        [-18.04263, 41.90365, 0.7621522, 6.177052],
        phase=TRAIN,
    ),
    Case(
        "blocks",
        'type: "BN" bn_param { scale_filler { type: "constant" } }',
        [normal(3, 2, 4, 5)],
        [-18.04263, 41.90365, 0.7621522, 6.177052],
    ),
    Case(
        "blocks",
        'type: "BN" bn_param { scale_filler { type: "constant" } bn_mode: INFERENCE }',
        [normal(3, 2, 4, 5)],
        [-14.88904, 39.75625, -0.4228518, 6.177052],
    ),
    Case(
        "blocks",
        'type: "DeephiResize" deephi_resize_param { new_height: 11 new_width: 4 resize_type: BILINEAR }',
        [normal(2, 3, 5, 6)],
        [-11.83469, 4.040482],
    ),
    Case(
        "blocks",
        'type: "DeephiResize" deephi_resize_param { scale_h: 2 scale_w: 2.5 resize_type: BILINEAR }',
        [normal(2, 3, 5, 6)],
        [-3.179742, -13.6883],
    ),
    Case(
        "blocks",
        'type: "DeephiResize" deephi_resize_param { new_height: 11 new_width: 4 resize_type: NEAREST }',
        [normal(2, 3, 5, 6)],
        [-12.82797, 10.25435],
    ),
    Case(
        "blocks",
        'type: "DeephiResize" deephi_resize_param { scale_h: 2 scale_w: 2.5 resize_type: NEAREST }',
        [normal(2, 3, 5, 6)],
        [-0.7266089, -16.61627],
    ),
    Case(
        "layout",
        'type: "Transpose" transpose_param { dim: 3 dim: 0 dim: 2 dim: 1 }',
        [normal(2, 3, 4, 5)],
        [-7.34803, 7.855759],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 1 }',
        [normal(2, 2, 2, 3)],
        [0.8461753, 6.167653],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 1 reverse: true }',
        [normal(2, 2, 2, 3)],
        [0.8461753, 6.167653],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 2 }',
        [normal(2, 8, 4, 6)],
        [-15.253, -10.26343],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 2 reverse: true }',
        [normal(2, 32, 2, 3)],
        [-4.503412, -6.705996],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 3 }',
        [normal(2, 18, 6, 9)],
        [-10.77927, 17.07157],
    ),
    Case(
        "layout",
        'type: "Reorg" reorg_param { stride: 3 reverse: true }',
        [normal(2, 162, 2, 3)],
        [36.99194, 12.74782],
    ),
    Case(
        "layout",
        'type: "CropCenter" crop_center_param { crop_size: [0, 0, 2, 1] }',
        [normal(1, 2, 7, 6)],
        [-4.007561, -0.7406504],
    ),
    Case(
        "filters",
        'type: "Convolution" convolution_param { num_output: 4 kernel_size: 3 hole: 2 }',
        [normal(2, 3, 9, 8)],
        [6.418131, 5.623189, 13.85111, -1.742782],
    ),
    Case(
        "filters",
        'type: "Convolution" convolution_param { num_output: 4 kernel_size: 3 hole_h: 1 hole_w: 2 }',
        [normal(2, 3, 9, 8)],
        [44.64353, 35.57255, -10.24777, -1.303796],
    ),
    Case(
        "filters",
        'type: "Convolution" convolution_param { num_output: 4 kernel_size: 3 dilation: 3 }',
        [normal(2, 3, 9, 8)],
        [-7.817881, 3.947858, 6.944576, 1.973256],
    ),
    Case(
        "filters",
        'type: "Convolution" convolution_param { num_output: 4 kernel_size: 3 stride: 1 pad_l: 2 pad_r: 1 pad_b: 3 }',
        [normal(2, 3, 6, 5)],
        [16.89399, -19.96508, -2.59655, -2.554383],
    ),
    Case(
        "filters",
        'type: "Convolution" convolution_param { num_output: 4 kernel_size: 3 stride: 2 pad_l: 2 pad_r: 1 pad_b: 3 }',
        [normal(2, 3, 6, 5)],
        [-29.84186, 3.464937, -4.828467, -2.873972],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: MAX pad_l: 1 pad_b: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-4.148663, -2.2938],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: MAX pad_l: 1 pad_b: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-4.148663, -2.2938],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: MAX pad_r: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-7.089051, -0.3806704],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: MAX pad_r: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-7.089051, -0.3806704],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE pad_l: 1 pad_b: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-0.3351609, -0.782429],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE pad_l: 1 pad_b: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-0.3351609, -0.782429],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE pad_r: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.022036, 0.674587],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE pad_r: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-1.022036, 0.674587],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD  ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD  ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-0.1332676, -0.6214086],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad: 1 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.249067, -0.3968567],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad: 1 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [0.8900014, -0.09429795],
    ),
    Case(
        "filters",
        (
            'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad_l: 1 pad_b: 2 '
            "ceil_mode: true }"
        ),
        [normal(2, 2, 7, 6)],
        [0.2216374, -1.66146],
    ),
    Case(
        "filters",
        (
            'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad_l: 1 pad_b: 2 '
            "ceil_mode: false }"
        ),
        [normal(2, 2, 7, 6)],
        [0.2216374, -1.66146],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad_r: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_EXC_PAD pad_r: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF  ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF  ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-0.1332676, -0.6214086],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad: 1 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.249067, -0.3968567],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad: 1 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [0.8900014, -0.09429795],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad_l: 1 pad_b: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [0.2216374, -1.66146],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad_l: 1 pad_b: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [0.2216374, -1.66146],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad_r: 2 ceil_mode: true }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "filters",
        'type: "Pooling" pooling_param { kernel_size: 3 stride: 2 pool: AVE_TF pad_r: 2 ceil_mode: false }',
        [normal(2, 2, 7, 6)],
        [-1.541604, 0.7775136],
    ),
    Case(
        "nvidia",
        'type: "BatchNorm" batch_norm_param { eps: 0.01 scale_bias: true }',
        [normal(4, 3, 5, 2)],
        [6.854372, 33.79298, -5.423606, 0.2452865],
    ),
    Case(
        "nvidia",
        'type: "BatchNorm" batch_norm_param { eps: 0.01 scale_bias: true }',
        [normal(4, 3, 5, 2)],
        [-7.194847, 33.40505, -6.244445, 0.2452865, -0.7852127, -0.5744731, 0.02364325],
        phase=TRAIN,
    ),
    Case(
        "nvidia",
        'type: "BatchNorm" batch_norm_param { eps: 0.01 scale_bias: true }',
        [normal(3, 2)],
        [2.036341, 0.4064442, -0.7686477, -0.2558614, -0.5659067, -0.7514196, 0.02364325],
        phase=TRAIN,
    ),
    Case(
        "flownet",
        'type: "Correlation" correlation_param { pad: 2 kernel_size: 1 max_displacement: 2 }',
        [normal(2, 3, 7, 9), normal(2, 3, 7, 9)],
        [24.72878, 12.43683, 20.23313],
    ),
    Case(
        "flownet",
        'type: "Correlation" correlation_param { pad: 4 kernel_size: 3 max_displacement: 4 stride_1: 2 stride_2: 2 }',
        [normal(2, 3, 7, 9), normal(2, 3, 7, 9)],
        [1.552445, 0.4412638, -0.5133962],
    ),
    Case(
        "flownet",
        (
            'type: "Correlation" correlation_param { kernel_size: 1 max_displacement: 2 stride_2: 2 '
            "correlation_type: SUBTRACT }"
        ),
        [normal(2, 3, 7, 9), normal(2, 3, 7, 9)],
        [-13.88796, -1.079659, -8.416259],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 13 width: 17 type: LINEAR antialias: true }',
        [normal(2, 3, 7, 9)],
        [9.242182, -16.55883],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: LINEAR antialias: true }',
        [normal(2, 3, 7, 9)],
        [-0.2980159, 0.3023649],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: LINEAR antialias: false }',
        [normal(2, 3, 7, 9)],
        [-1.988601, -1.025961],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 4 width: 15 type: LINEAR antialias: true }',
        [normal(2, 3, 7, 9)],
        [-1.461756, -6.499684],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 13 width: 17 type: CUBIC antialias: true }',
        [normal(2, 3, 7, 9)],
        [9.146678, -18.90952],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: CUBIC antialias: true }',
        [normal(2, 3, 7, 9)],
        [-0.2366262, 0.3348213],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: CUBIC antialias: false }',
        [normal(2, 3, 7, 9)],
        [-2.420079, -1.367629],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 4 width: 15 type: CUBIC antialias: true }',
        [normal(2, 3, 7, 9)],
        [-5.707311, -5.811332],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 13 width: 17 type: NEAREST antialias: true }',
        [normal(2, 3, 7, 9)],
        [7.954002, -21.53669],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: NEAREST antialias: true }',
        [normal(2, 3, 7, 9)],
        [-4.103343, 0.1221913],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 3 width: 4 type: NEAREST antialias: false }',
        [normal(2, 3, 7, 9)],
        [-4.103343, 0.1221913],
    ),
    Case(
        "flownet",
        'type: "Resample" resample_param { height: 4 width: 15 type: NEAREST antialias: true }',
        [normal(2, 3, 7, 9)],
        [-5.684287, -7.30688],
    ),
    Case(
        "flownet",
        'type: "FlowWarp" flow_warp_param { fill_value: NOT_A_NUMBER }',
        [],
        [-33.82364],
        fixed=[normal(2, 3, 5, 6), normal(2, 2, 5, 6)],
    ),
    Case(
        "flownet",
        'type: "FlowWarp"',
        [normal(2, 3, 5, 6), normal(2, 2, 5, 6)],
        [0.07909832, 10.48333, -6.121468],
    ),
    Case(
        "flownet",
        'type: "ChannelNorm"',
        [normal(2, 3, 4, 5)],
        [-8.366511, -0.8427453],
    ),
    Case(
        "rcnn",
        'type: "ROIPooling" roi_pooling_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 }',
        [normal(2, 3, 5, 6)],
        [-1.874779, -3.133449],
        fixed=["forward"],
    ),
    Case(
        "rcnn",
        'type: "ROIPooling" roi_pooling_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 }',
        [normal(2, 3, 5, 6)],
        [-4.781144, -3.49895],
        fixed=["columns"],
        is_derivative=False,
    ),
    Case(
        "rfcn",
        'type: "PSROIPooling" psroi_pooling_param { spatial_scale: 0.5 output_dim: 2 group_size: 3 }',
        [normal(2, 18, 5, 6)],
        [-8.062114, -1.389664],
        fixed=["regions"],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 1 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [0.1239452, 0.03117525, -0.03117525],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 1 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [0.08212562, 0.02889544, -0.02889544],
        fixed=[normal(3, 4, 2, 1)],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 1 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [-0.003691068, -0.01230885, 0.01230885],
        fixed=[normal(3, 4, 2, 1), normal(3, 4, 2, 1)],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 3 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [0.1921058, 0.03970803, -0.03970803],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 3 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [0.1317747, 0.03931015, -0.03931015],
        fixed=[normal(3, 4, 2, 1)],
    ),
    Case(
        "rcnn",
        'type: "SmoothL1Loss" loss_weight: 1 smooth_l1_loss_param { sigma: 3 }',
        [normal(3, 4, 2, 1), normal(3, 4, 2)],
        [-0.02407361, -0.01952287, 0.01952287],
        fixed=[normal(3, 4, 2, 1), normal(3, 4, 2, 1)],
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b"',
        [normal(5, 4), normal(5, 4)],
        [0.05680883, -0.3603201, -0.006080432, 0.006080432],
        tops=2,
    ),
    Case(
        "rfcn",
        (
            'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: PRE_FIXED '
            "pre_fixed_normalizer: 128 }"
        ),
        [normal(5, 4), normal(5, 4)],
        [0.002219095, -0.3603201, -0.0002375169, 0.0002375169],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: PRE_FIXED }',
        [normal(5, 4), normal(5, 4)],
        [0.2840442, -0.3603201, -0.03040216, 0.03040216],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: NONE }',
        [normal(5, 4), normal(5, 4)],
        [0.2840442, -0.3603201, -0.03040216, 0.03040216],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalize: false }',
        [normal(5, 4), normal(5, 4)],
        [0.05680883, -0.3603201, -0.006080432, 0.006080432],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b"',
        [normal(5, 4), normal(5, 4)],
        [0.0319544, -0.9766866, -0.004932855, 0.004932855],
        fixed=[integers(5, 4, below=2)],
        tops=2,
    ),
    Case(
        "rfcn",
        (
            'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: PRE_FIXED '
            "pre_fixed_normalizer: 128 }"
        ),
        [normal(5, 4), normal(5, 4)],
        [0.001248219, -0.9766866, -0.0001926897, 0.0001926897],
        fixed=[integers(5, 4, below=2)],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: PRE_FIXED }',
        [normal(5, 4), normal(5, 4)],
        [0.159772, -0.9766866, -0.02466428, 0.02466428],
        fixed=[integers(5, 4, below=2)],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalization: NONE }',
        [normal(5, 4), normal(5, 4)],
        [0.159772, -0.9766866, -0.02466428, 0.02466428],
        fixed=[integers(5, 4, below=2)],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SmoothL1LossOHEM" top: "a" top: "b" loss_param { normalize: false }',
        [normal(5, 4), normal(5, 4)],
        [0.0319544, -0.9766866, -0.004932855, 0.004932855],
        fixed=[integers(5, 4, below=2)],
        tops=2,
    ),
    Case(
        "rfcn",
        'type: "SoftmaxWithLossOHEM" top: "a" top: "b" top: "c" loss_param { ignore_label: 1  }',
        [normal(4, 3)],
        [0.04762457, 0.0868695, 0.05202895, 0.004714647],
        fixed=[integers(4, below=3)],
        tops=3,
        is_derivative=False,
    ),
    Case(
        "rfcn",
        (
            'type: "SoftmaxWithLossOHEM" top: "a" top: "b" top: "c" loss_param { ignore_label: 1 normalization: '
            "PRE_FIXED pre_fixed_normalizer: 16 }"
        ),
        [normal(4, 3)],
        [0.008929606, 0.0868695, 0.05202895, 0.0008839962],
        fixed=[integers(4, below=3)],
        tops=3,
        is_derivative=False,
    ),
    Case(
        "rcnn",
        'type: "ROIAlign" roi_pooling_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 pad_ratio: 0 }',
        [normal(2, 3, 5, 6)],
        [1.72952, 3.158715],
        fixed=["regions"],
    ),
    Case(
        "rcnn",
        'type: "ROIAlign" roi_pooling_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 pad_ratio: 0.25 }',
        [normal(2, 3, 5, 6)],
        [5.26001, 1.434601],
        fixed=["regions"],
    ),
    Case(
        "rcnn",
        'type: "ROIAlign" roi_align_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 sampling_ratio: 0 }',
        [normal(2, 3, 5, 6)],
        [-0.9612119, 2.796713],
        fixed=["regions"],
    ),
    Case(
        "rcnn",
        'type: "ROIAlign" roi_align_param { pooled_h: 3 pooled_w: 2 spatial_scale: 0.5 sampling_ratio: 2 }',
        [normal(2, 3, 5, 6)],
        [-0.7916504, 2.289607],
        fixed=["regions"],
    ),
    Case(
        "ssd",
        'type: "Permute" permute_param { order: 0 order: 2 order: 3 order: 1 }',
        [normal(2, 3, 4, 5)],
        [-1.244284, 4.895939],
    ),
    Case(
        "ssd",
        'type: "Permute" permute_param { order: 2 }',
        [normal(2, 3, 4, 5)],
        [6.507168, 2.08094],
    ),
    Case(
        "ssd",
        'type: "Permute" permute_param {  }',
        [normal(2, 3, 4, 5)],
        [1.074569, 35.55517],
    ),
    Case(
        "ssd",
        'type: "Normalize" norm_param { across_spatial: false channel_shared: false eps: 0.1 }',
        [normal(2, 3, 4, 5)],
        [-1.654348, 22.91709, -5.775313],
        is_derivative=False,
    ),
    Case(
        "ssd",
        'type: "Normalize" norm_param { across_spatial: false channel_shared: true eps: 0.1 }',
        [normal(2, 3, 4, 5)],
        [0.7775014, 26.96293, 0.01352904],
    ),
    Case(
        "ssd",
        'type: "Normalize" norm_param { across_spatial: true channel_shared: false eps: 0.1 }',
        [normal(2, 3, 4, 5)],
        [-0.2592086, 5.850358, -1.248164],
        is_derivative=False,
    ),
    Case(
        "ssd",
        'type: "Normalize" norm_param { across_spatial: true channel_shared: true eps: 0.1 }',
        [normal(2, 3, 4, 5)],
        [0.2117075, 6.910889, 0.003683853],
    ),
    Case(
        "ssd",
        'type: "PriorBox" prior_box_param { min_size: 30 }',
        [],
        [-1.121701],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        (
            'type: "PriorBox" prior_box_param { min_size: 30.9 max_size: 60 aspect_ratio: 2 aspect_ratio: 1 '
            "aspect_ratio: 0.5 }"
        ),
        [],
        [-1.503245],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        (
            'type: "PriorBox" prior_box_param { min_size: 10 min_size: 20 aspect_ratio: 3 flip: false img_size: '
            "100 step: 8 offset: 0.25 }"
        ),
        [],
        [-0.1013434],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        'type: "PriorBox" prior_box_param { min_size: 10 img_h: 50 img_w: 40 step_h: 5 step_w: 4 }',
        [],
        [-0.5488563],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        'type: "PriorBox" prior_box_param { min_size: 10 img_h: 50 img_w: 40 }',
        [],
        [-0.7771636],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        (
            'type: "PriorBox" prior_box_param { min_size: 50 clip: true img_size: 60 variance: 0.1 variance: 0.2 '
            "variance: 0.3 variance: 0.4 }"
        ),
        [],
        [-1.702654],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        (
            'type: "PriorBox" prior_box_param { min_size: 10 max_size: 20 aspect_ratio: 2 img_size: 100 step: 8 '
            "offset: 0.25 denser_prior_boxes: true }"
        ),
        [],
        [1.392959],
        fixed=[normal(2, 4, 2, 3), normal(2, 3, 60, 90)],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [-3.035492],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [-3.01588],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [1.896518],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-5.102071],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [-12.98047],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [-9.563436],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [-0.7407089],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-5.761427],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [6.632187],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [-3.426609],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [1.977525],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-4.660651],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [3.539857],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [16.85978],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [0.1072637],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-4.510096],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CENTER_SIZE nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [-3.17295],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [-3.870611],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [1.927699],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-4.812325],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: true '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 80), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.3 eta: 1 } "
            "confidence_threshold: 0.2 }"
        ),
        [],
        [1.261175],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.8 eta: 0.9 } }"
        ),
        [],
        [1.761616],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: 3 } "
            "confidence_threshold: 0.1 }"
        ),
        [],
        [0.0619609],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: 6 } "
            "confidence_threshold: 0.1 keep_top_k: 7 }"
        ),
        [],
        [-6.512276],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 3 share_location: false '
            "background_label_id: 1 code_type: CORNER_SIZE nms_param { nms_threshold: 0.45 top_k: -1 } "
            "confidence_threshold: 0.1 keep_top_k: 0 }"
        ),
        [],
        [-1.783863],
        fixed=[normal(2, 240), uniform(2, 60), "priors20"],
    ),
    Case(
        "ssd",
        (
            'type: "DetectionOutput" detection_output_param { num_classes: 2 code_type: CENTER_SIZE nms_param { '
            "nms_threshold: 0.4 } confidence_threshold: 0.3 objectness_score: 0.4 }"
        ),
        [],
        [2.092509],
        fixed=[normal(2, 80), uniform(2, 40), "priors20", uniform(2, 40), normal(2, 80)],
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4  }',
        [normal(3, 64), normal(3, 64)],
        [0.2725081, -0.005907792, -0.0005858541],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 code_type: CENTER_SIZE }',
        [normal(3, 64), normal(3, 64)],
        [0.3474898, -0.01300546, -0.0005858541],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 code_type: CORNER_SIZE loc_loss_type: L2 '
            "loc_weight: 2.5 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [1.293817, 0.04720657, -0.0005858541],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 match_type: BIPARTITE neg_pos_ratio: 1.5 }',
        [normal(3, 64), normal(3, 64)],
        [0.2115119, -0.005907792, -0.007145815],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 overlap_threshold: 0.2 neg_overlap: 0.1 }',
        [normal(3, 64), normal(3, 64)],
        [0.1451205, -0.003120608, -0.004505917],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 use_prior_for_matching: false '
            "overlap_threshold: 0.3 code_type: CENTER_SIZE }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.3163311, -0.0006943504, -0.01063038],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 use_difficult_gt: false overlap_threshold: 0.3 }',
        [normal(3, 64), normal(3, 64)],
        [0.2063398, -0.009712096, -0.01068891],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 ignore_cross_boundary_bbox: true '
            "overlap_threshold: 0.3 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.17666, 0.005750305, 0.004557439],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 bp_inside: true overlap_threshold: 0.3 }',
        [normal(3, 64), normal(3, 64)],
        [0.1983458, -0.004071336, -0.01116732],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 bp_inside: true use_prior_for_matching: '
            "false overlap_threshold: 0.3 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.1908694, -0.0006924698, -0.002565162],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 encode_variance_in_target: true code_type:'
            " CENTER_SIZE overlap_threshold: 0.3 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.561419, -0.01255446, -0.01116732],
        fixed=["priors16", "truth"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 conf_loss_type: LOGISTIC }',
        [normal(3, 64), normal(3, 64)],
        [0.4268842, -0.005907792, -0.01441071],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: NONE }',
        [normal(3, 64), normal(3, 64)],
        [0.5528913, -0.005907792, 0.0007282972],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: NONE conf_loss_type: LOGISTIC }',
        [normal(3, 64), normal(3, 64)],
        [0.9633976, -0.005907792, 0.003541447],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: NONE share_location: false '
            "overlap_threshold: 0.3 }"
        ),
        [normal(3, 256), normal(3, 64)],
        [0.3318643, -0.0005409369, -0.00835317],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: NONE share_location: false '
            "use_prior_for_matching: false conf_loss_type: LOGISTIC }"
        ),
        [normal(3, 256), normal(3, 64)],
        [0.989535, 0.005092909, 0.01787027],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: HARD_EXAMPLE sample_size: 5 '
            "overlap_threshold: 0.2 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.1483162, -0.006188891, 0.002665592],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: HARD_EXAMPLE conf_loss_type: '
            "LOGISTIC overlap_threshold: 0.2 sample_size: 3 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.1983084, -0.007024237, -0.003906637],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        (
            'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 mining_type: HARD_EXAMPLE loc_loss_type: '
            "L2 ignore_cross_boundary_bbox: true sample_size: 7 }"
        ),
        [normal(3, 64), normal(3, 64)],
        [0.1504671, 0.01402672, 0.002089778],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 } loss_param { normalization: FULL }',
        [normal(3, 64), normal(3, 64)],
        [0.022709, -0.000492316, -4.882119e-05],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 } loss_param { normalization: BATCH_SIZE }',
        [normal(3, 64), normal(3, 64)],
        [0.3633441, -0.007877056, -0.000781139],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "ssd",
        'type: "MultiBoxLoss" multibox_loss_param { num_classes: 4 } loss_param { normalization: NONE }',
        [normal(3, 64), normal(3, 64)],
        [1.090032, -0.02363117, -0.002343417],
        fixed=["priors16", "truth"],
        phase=TRAIN,
    ),
    Case(
        "yolo",
        (
            'type: "YoloDetectionOutput" yolo_detection_output_param { num_classes: 3 num_box: 2 '
            "confidence_threshold: 0.2 nms_threshold: 0.3 biases: [0.5, 1, 2, 1.5] }"
        ),
        [],
        [5.413416],
        fixed=[normal(1, 16, 3, 4)],
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3DetectionOutput" yolov3_detection_output_param { num_classes: 2 num_box: 3 '
            "nms_threshold: 0.45 confidence_threshold: 0.5 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, "
            "344, 319] mask: [3, 4, 5, 0, 1, 2] anchors_scale: [32, 16] mask_group_num: 2 }"
        ),
        [],
        [2.332478],
        fixed=[normal(2, 21, 2, 2), normal(2, 21, 4, 4)],
    ),
    Case(
        "yolo",
        (
            'type: "RegionLoss" region_loss_param { num_class: 2 num: 2 object_scale: 5 noobject_scale: 1 '
            "class_scale: 1 coord_scale: 1 thresh: 0.6 biases: [0.5, 1, 2, 1.5] rescore: 0 bias_match: 0 }"
        ),
        [normal(2, 14, 3, 3)],
        [0.1205803, 0.01387339],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "RegionLoss" region_loss_param { num_class: 2 num: 2 object_scale: 5 noobject_scale: 1 '
            "class_scale: 1 coord_scale: 1 thresh: 0.6 biases: [0.5, 1, 2, 1.5] rescore: 0 bias_match: 1 }"
        ),
        [normal(2, 14, 3, 3)],
        [0.2551893, 0.03375954],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "RegionLoss" region_loss_param { num_class: 2 num: 2 object_scale: 5 noobject_scale: 1 '
            "class_scale: 1 coord_scale: 1 thresh: 0.6 biases: [0.5, 1, 2, 1.5] rescore: 1 bias_match: 0 }"
        ),
        [normal(2, 14, 3, 3)],
        [0.07245629, 0.02452407],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "RegionLoss" region_loss_param { num_class: 2 num: 2 object_scale: 5 noobject_scale: 1 '
            "class_scale: 1 coord_scale: 1 thresh: 0.6 biases: [0.5, 1, 2, 1.5] rescore: 1 bias_match: 1 }"
        ),
        [normal(2, 14, 3, 3)],
        [0.1067757, 0.02101677],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [3, 4, 5] "
            "use_logic_gradient: false use_focal_loss: false iou_thresh: 0.5 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.5658241, -0.006785976],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [3, 4, 5] "
            "use_logic_gradient: true use_focal_loss: false iou_thresh: 1 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.5152028, -0.02519436],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [3, 4, 5] "
            "use_logic_gradient: false use_focal_loss: true iou_thresh: 0.3 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.5341776, -0.02173396],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [3, 4, 5] "
            "use_logic_gradient: true use_focal_loss: true iou_thresh: 0.1 }"
        ),
        [normal(2, 21, 3, 4)],
        [1.257408, -0.01733314],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [0, 1, 2] "
            "use_logic_gradient: false use_focal_loss: false iou_thresh: 0.5 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.7213647, -0.09550395],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [0, 1, 2] "
            "use_logic_gradient: true use_focal_loss: false iou_thresh: 1 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.8120394, -0.05759128],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [0, 1, 2] "
            "use_logic_gradient: false use_focal_loss: true iou_thresh: 0.3 }"
        ),
        [normal(2, 21, 3, 4)],
        [1.542858, -0.07743824],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [0, 1, 2] "
            "use_logic_gradient: true use_focal_loss: true iou_thresh: 0.1 }"
        ),
        [normal(2, 21, 3, 4)],
        [3.119827, -0.01360469],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [1, 2, 3] "
            "use_logic_gradient: false use_focal_loss: false iou_thresh: 0.5 }"
        ),
        [normal(2, 21, 3, 4)],
        [0.9475042, -0.05210443],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [1, 2, 3] "
            "use_logic_gradient: true use_focal_loss: false iou_thresh: 1 }"
        ),
        [normal(2, 21, 3, 4)],
        [1.054082, 0.01208422],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [1, 2, 3] "
            "use_logic_gradient: false use_focal_loss: true iou_thresh: 0.3 }"
        ),
        [normal(2, 21, 3, 4)],
        [1.103474, -0.06790204],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "yolo",
        (
            'type: "Yolov3" yolov3_param { num_class: 2 num: 3 object_scale: 5 class_scale: 2 coord_scale: 1.5 '
            "thresh: 0.3 biases: [10, 14, 23, 27, 37, 58, 81, 82, 135, 169, 344, 319] mask: [1, 2, 3] "
            "use_logic_gradient: true use_focal_loss: true iou_thresh: 0.1 }"
        ),
        [normal(2, 21, 3, 4)],
        [3.303819, -0.02701206],
        fixed=["cells"],
        phase=TRAIN,
        is_derivative=False,
    ),
    Case(
        "text",
        'type: "CTCLoss" ctc_loss_param { blank_index: 0 }',
        [normal(4, 2, 3)],
        [0.07642764, -0.01305533],
        fixed=["texts"],
        is_derivative=False,
    ),
    Case(
        "text",
        'type: "CTCLoss" ctc_loss_param { blank_index: 2 }',
        [normal(4, 2, 3)],
        [0.06451606, 0.005573799],
        fixed=["others"],
        is_derivative=False,
    ),
    Case(
        "text",
        'type: "CTCLoss" ctc_loss_param { blank_index: -1 }',
        [normal(4, 2, 3)],
        [0.06451606, 0.005573799],
        fixed=["others"],
        is_derivative=False,
    ),
    Case(
        "text",
        'type: "Reverse" reverse_param { axis: 0 }',
        [normal(3, 2, 4)],
        [0.984417, 4.703313],
    ),
    Case(
        "text",
        'type: "Reverse" reverse_param { axis: 1 }',
        [normal(3, 2, 4)],
        [-0.4806333, -0.158797],
    ),
    Case(
        "text",
        'type: "Reverse" reverse_param { axis: -1 }',
        [normal(3, 2, 4)],
        [-0.8967435, 0.6255139],
    ),
    Case(
        "text",
        'type: "Lstm" lstm_param { num_output: 3 }',
        [normal(4, 2, 5)],
        [1.292283, -1.890608, -1.492505, 0.0440155, 1.787338],
    ),
    Case(
        "segmentation",
        (
            'type: "SoftmaxWithLoss" loss_param { weight_by_label_freqs: true class_weighting: [0.5, 2, 3] '
            "ignore_label: 1 }"
        ),
        [normal(2, 3, 4)],
        [0.04880939, -0.002210081],
        fixed=[integers(2, 4, below=3)],
    ),
    Case(
        "segmentation",
        'type: "DiceCoefLoss"',
        [uniform(3, 1, 2, 4), uniform(3, 8)],
        [0.004806423, -0.001368993, -0.00229749],
        is_derivative=False,
    ),
    Case(
        "hed",
        'type: "SigmoidCrossEntropyLoss"',
        [normal(2, 12)],
        [0.07495704, -0.001010084],
        fixed=["edges"],
    ),
    Case(
        "rcf",
        'type: "SigmoidCrossEntropyLoss"',
        [normal(2, 12)],
        [0.07832466, -0.0007978148],
        fixed=["edges"],
    ),
    Case(
        "c3d",
        'type: "Pooling3D" pooling3d_param { kernel_size: 3 kernel_depth: 2 stride: 2 temporal_stride: 2 }',
        [normal(2, 2, 5, 6, 7)],
        [-2.256834, 2.26327],
    ),
    Case(
        "c3d",
        'type: "Pooling3D" pooling3d_param { kernel_size: 2 kernel_depth: 1 }',
        [normal(2, 2, 5, 6, 7)],
        [-4.82973, 4.712918],
    ),
    Case(
        "c3d",
        (
            'type: "Pooling3D" pooling3d_param { pool: AVE kernel_size: 3 kernel_depth: 2 stride: 2 '
            "temporal_stride: 2 pad: 1 }"
        ),
        [normal(2, 2, 5, 6, 7)],
        [-1.309786, -0.5104223],
    ),
    Case(
        "c3d",
        'type: "Pooling3D" pooling3d_param { kernel_size: 2 kernel_depth: 1 }',
        [integers(2, 2, 5, 6, 7, below=3)],
        [-10.60585, 3.597249],
        is_derivative=False,
    ),
    Case(
        "c3d",
        (
            'type: "NdPooling" pooling_param { pool: MAX kernel_shape { dim: [2, 3, 3] } stride_shape { dim: [2, '
            "2, 3] } pad_shape { dim: [1, 1, 1] } }"
        ),
        [normal(2, 2, 5, 6, 7)],
        [-1.195191, 6.783394],
    ),
    Case(
        "c3d",
        (
            'type: "NdPooling" pooling_param { pool: AVE kernel_shape { dim: [2, 3, 3] } stride_shape { dim: [2, '
            "2, 3] } pad_shape { dim: [1, 1, 1] } }"
        ),
        [normal(2, 2, 5, 6, 7)],
        [-0.3427705, 0.8765133],
    ),
    Case(
        "c3d",
        'type: "NdPooling" pooling_param { global_pooling: true }',
        [normal(2, 2, 5, 6)],
        [1.196102, -0.4006284],
    ),
    Case(
        "c3d",
        (
            'type: "Convolution3D" convolution3d_param { num_output: 4 kernel_size: 3 kernel_depth: 2 pad: 1 '
            "temporal_pad: 1 stride: 2 }"
        ),
        [normal(2, 3, 5, 6, 7)],
        [133.2968, -117.6644, 1.81752, 10.27711],
    ),
    Case(
        "c3d",
        (
            'type: "NdConvolution" convolution_param { num_output: 4 group: 2 kernel_shape { dim: [2, 3, 3] } '
            "stride_shape { dim: [1, 2, 2] } }"
        ),
        [normal(2, 2, 5, 6, 7)],
        [48.91868, -0.401328, 35.61594, -8.072385],
    ),
    Case(
        "densenet",
        'type: "DenseBlock" denseblock_param { numTransition: 2 growthRate: 2 use_BC: false }',
        [normal(4, 3, 5, 6)],
        [-1842.609, -2.899141, 168.6997, -212.6391, 159.0248, 1165.246, 215.5791, 74.15221],
    ),
    Case(
        "densenet",
        'type: "DenseBlock" denseblock_param { numTransition: 2 initChannel: 3 growthRate: 2 use_BC: false }',
        [normal(4, 3, 5, 6)],
        [
            -295.8689,
            -41.67536,
            -33.41282,
            -9.4679,
            -44.07007,
            11.83691,
            -20.10818,
            19.71413,
            -0.7574189,
            -2.689992,
            -0.7769846,
            -8.040322,
        ],
        phase=TRAIN,
    ),
    Case(
        "densenet",
        'type: "DenseBlock" denseblock_param { numTransition: 2 initChannel: 3 growthRate: 2 use_BC: true }',
        [normal(4, 3, 5, 6)],
        [
            -89695.84,
            614.5413,
            4532.932,
            4414.429,
            1361.804,
            46377.94,
            8671.925,
            722.123,
            -2231.953,
            18937.2,
            4557.852,
            273.4977,
            -15627.46,
            -74.79141,
        ],
    ),
    Case(
        "densenet",
        'type: "DenseBlock" denseblock_param { numTransition: 2 initChannel: 3 growthRate: 2 use_BC: true }',
        [normal(4, 3, 5, 6)],
        [
            -676.9661,
            -6.826948,
            -40.79268,
            46.59149,
            -9.016398,
            56.44849,
            86.87909,
            -28.87731,
            98.26114,
            16.54972,
            -18.31888,
            -59.49739,
            54.37667,
            -53.14525,
            -1.061165,
            -6.755203,
            -0.066508,
            -67.20603,
            1.210186,
            0.6039271,
            0.980361,
            2.43212,
        ],
        phase=TRAIN,
    ),
    Case(
        "happynear",
        'type: "FocalLoss" focal_loss_param { alpha: 1 gamma: 2 }',
        [normal(4, 3)],
        [0.02794332, 0.003545093],
        fixed=[integers(4, below=3)],
    ),
]
