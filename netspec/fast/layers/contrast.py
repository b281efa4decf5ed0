"""The kernel of LRN (netspec/layers/contrast.py)."""

from __future__ import annotations

import torch

from netspec.exact import ALL
from netspec.fast.entry import Entry
from netspec.fast.kernels import Inference, Kernel, with_activation
from netspec.layers.contrast import ACROSS_CHANNELS, LRN


def _lrn(layer: LRN, how: Inference) -> Kernel | None:
    param, shape = layer.param.lrn_param, layer.bottom_shapes[0]
    if param.norm_region != ACROSS_CHANNELS or layer.context.options.exact == ALL:
        return None
    size, channels, reach = param.local_size, shape[1], param.local_size // 2
    frames: dict[bool, torch.Tensor] = {}  # the squares with zeros before and after them, by layout

    def kernel(data: torch.Tensor) -> torch.Tensor:
        side_by_side = not data.is_contiguous()
        if side_by_side not in frames:
            layout = torch.channels_last if side_by_side else torch.contiguous_format
            with torch.inference_mode(False):
                frame = data.new_zeros(shape[0], channels + 2 * reach, *shape[2:])
                frames[side_by_side] = frame.contiguous(memory_format=layout)
        frame = frames[side_by_side]
        torch.mul(data, data, out=frame[:, reach : reach + channels])
        total = frame[:, :channels] + frame[:, 1 : 1 + channels] if size > 1 else frame.clone()
        for shift in range(2, size):
            total += frame[:, shift : shift + channels]
        base = total.mul_(param.alpha / size).add_(param.k)
        if param.beta == 0.75:
            root = base.rsqrt_()  # x ** -0.75 = r sqrt(r), for r = 1 / sqrt(x), five times as fast as a power
            return root.mul_(root.sqrt()).mul_(data)
        return base.pow_(-param.beta).mul_(data)

    return with_activation(kernel, how.activation)


ENTRIES = {LRN: Entry(_lrn, fresh=True, any_layout=True)}
