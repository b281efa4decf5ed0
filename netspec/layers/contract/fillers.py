"""Initial values of blobs: Caffe's seven fillers.

Caffe: include/caffe/filler.hpp
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from netspec.data.blobs import Shape
from netspec.errors import did_you_mean

FAN_IN, FAN_OUT, AVERAGE = 0, 1, 2  # caffe.proto: enum FillerParameter.VarianceNorm


def draw(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
    """Return a float32 CPU tensor of ``shape``, filled by ``filler``, a FillerParameter that :func:`check` accepted.

    The distributions are Caffe's, but the numbers differ, because Caffe's random generator depends on its version of
    Boost.
    """
    return _FILLERS[filler.type].draw(filler, shape, generator)


def check(filler: Any, shape: Shape) -> None:
    """Raise ValueError if Caffe would refuse the filler for a blob of this shape."""
    if filler.type not in _FILLERS:
        known = sorted(_FILLERS)
        raise ValueError(
            f'unknown filler "{filler.type}"{did_you_mean(filler.type, known) or ";"} known: {", ".join(known)}'
        )
    if math.prod(shape) == 0:
        raise ValueError(f"cannot fill an empty blob of shape {shape}")
    if filler.sparse != -1 and filler.type != "gaussian":
        raise ValueError(
            f'filler "{filler.type}" does not support sparse (found {filler.sparse}); only "gaussian" does'
        )
    _FILLERS[filler.type].check(filler, shape)


def _check_uniform(filler: Any, shape: Shape) -> None:
    if not filler.min <= filler.max:
        raise ValueError(f'filler "uniform" needs min <= max, found min {filler.min:g} and max {filler.max:g}')


def _check_gaussian(filler: Any, shape: Shape) -> None:
    if not filler.std > 0:
        raise ValueError(f'filler "gaussian" needs std > 0, found {filler.std:g}')
    if filler.sparse < -1:
        raise ValueError(f'filler "gaussian" needs sparse >= 0 (or -1 for none), found {filler.sparse}')
    if filler.sparse >= 0 and not shape:
        raise ValueError('filler "gaussian" needs a blob of at least one axis for sparse, found a scalar')
    if shape and filler.sparse > shape[0]:
        raise ValueError(f'filler "gaussian" needs sparse <= shape[0] = {shape[0]}, found {filler.sparse}')


def _check_bilinear(filler: Any, shape: Shape) -> None:
    if len(shape) != 4 or shape[2] != shape[3]:
        raise ValueError(f'filler "bilinear" needs a 4-D blob with square filters, found shape {shape}')


def _check_axis(filler: Any, shape: Shape) -> None:
    if not shape:
        raise ValueError(f'filler "{filler.type}" needs a blob of at least one axis, found a scalar')


def constant(shape: Shape, value: float, device: torch.device | str = "cpu") -> torch.Tensor:
    """Return a float32 tensor of equal numbers. Zeros are free, because new memory from the system is zero."""
    if value == 0:
        return torch.zeros(shape, dtype=torch.float32, device=device)
    return torch.full(shape, value, dtype=torch.float32, device=device)


def _gaussian(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
    values = _draw_normal(shape, filler.mean, filler.std, generator)
    if filler.sparse >= 0:
        # On average `sparse` of the weights of one input stay: the probability is a share of the outputs, shape[0].
        values *= torch.empty_like(values).bernoulli_(filler.sparse / shape[0], generator=generator)
    return values


def _positive_unitball(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
    rows = _draw_uniform(shape, 0.0, 1.0, generator).view(shape[0], -1)
    return (rows / rows.sum(dim=1, keepdim=True)).view(shape)


def _xavier(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
    bound = math.sqrt(3.0 / _fan(filler, shape))
    return _draw_uniform(shape, -bound, bound, generator)


def _bilinear(filler: Any, shape: Shape, generator: torch.Generator) -> torch.Tensor:
    width = shape[3]
    factor = (width + 1) // 2
    center = (width - 1) / (2.0 * factor)
    ramp = 1 - (torch.arange(width, dtype=torch.float64) / factor - center).abs()
    return torch.outer(ramp, ramp).float().expand(shape).contiguous()


def _fan(filler: Any, shape: Shape) -> float:
    """Return the divisor of the variance. Caffe computes it from the shape of the blob, not from the layer.

    So fan_out is ``num_output`` for an InnerProduct, and wrong by the factor ``group`` for a grouped convolution.
    """
    count = math.prod(shape)
    fan_in = count // shape[0]
    fan_out = count // shape[1] if len(shape) > 1 else count
    return {FAN_IN: fan_in, FAN_OUT: fan_out, AVERAGE: (fan_in + fan_out) / 2}[filler.variance_norm]


def _draw_uniform(shape: Shape, low: float, high: float, generator: torch.Generator) -> torch.Tensor:
    return torch.empty(shape, dtype=torch.float32).uniform_(low, high, generator=generator)


def _draw_normal(shape: Shape, mean: float, std: float, generator: torch.Generator) -> torch.Tensor:
    return torch.empty(shape, dtype=torch.float32).normal_(mean, std, generator=generator)


class _Filler(NamedTuple):
    """A filler: its function, the fields of FillerParameter that it reads in addition to ``type``, and its check."""

    draw: Callable[[Any, Shape, torch.Generator], torch.Tensor]
    reads: tuple[str, ...] = ()
    check: Callable[[Any, Shape], None] = lambda filler, shape: None


_FILLERS = {
    "constant": _Filler(lambda f, shape, _: constant(shape, f.value), ("value",)),
    "uniform": _Filler(lambda f, shape, draw: _draw_uniform(shape, f.min, f.max, draw), ("min", "max"), _check_uniform),
    "gaussian": _Filler(_gaussian, ("mean", "std", "sparse"), _check_gaussian),
    "positive_unitball": _Filler(_positive_unitball, (), _check_axis),
    "xavier": _Filler(_xavier, ("variance_norm",), _check_axis),
    "msra": _Filler(
        lambda f, shape, draws: _draw_normal(shape, 0.0, math.sqrt(2.0 / _fan(f, shape)), draws),
        ("variance_norm",),
        _check_axis,
    ),
    "bilinear": _Filler(_bilinear, (), _check_bilinear),
}
#: The fields that each filler reads.
READS = {name: filler.reads for name, filler in _FILLERS.items()}
