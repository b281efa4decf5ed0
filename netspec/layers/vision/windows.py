"""Windows over a map, and pooling over them: the maximum, the mean, or a sample."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn import functional as F

from netspec.exact.blas import is_recorded
from netspec.exact.layout import channels_side_by_side

CEIL, FLOOR = 0, 1  # caffe.proto: enum PoolingParameter.RoundMode
Pair = tuple[int, int]


LOWEST = torch.finfo(torch.float32).min  # the initial value of a maximum: Caffe's -FLT_MAX


SMALLEST = torch.finfo(torch.float32).tiny  # Caffe's FLT_MIN


@dataclass(frozen=True)
class Windows:
    """The positions of the windows of a map. Every pair is (vertical, horizontal), in pixels."""

    size: Pair  # of the map
    kernel: Pair
    stride: Pair
    pad: Pair
    round_mode: int = CEIL

    @property
    def count(self) -> Pair:
        """Return the number of windows, down and across.

        It is rounded up, so the last window may reach past the map. If either axis is padded, a last window that would
        begin past the map is dropped. Without padding, it may have no pixel if the stride is longer than the kernel.
        """
        counts = []
        for size, kernel, stride, pad in self.axes():
            free = size + 2 * pad - kernel
            count = (free // stride if self.round_mode == FLOOR else -(-free // stride)) + 1
            if any(self.pad) and (count - 1) * stride >= size + pad:
                count -= 1
            counts.append(count)
        return counts[0], counts[1]

    @property
    def known_to_torch(self) -> bool:
        """Whether torch's pooling supports these windows: none is empty, and no padding exceeds half a kernel."""
        axes = zip(self.axes(), self.count, strict=True)
        return all(2 * p <= k and (n - 1) * s < size + p for (size, k, s, p), n in axes)

    def padded(self, maps: torch.Tensor, value: float) -> torch.Tensor:
        """Return the maps padded with ``value``, so that every window is full."""
        frame: list[int] = []
        for (size, kernel, stride, pad), count in zip(self.axes(), self.count, strict=True):
            frame = [pad, (count - 1) * stride + kernel - pad - size, *frame]
        return F.pad(maps, frame, value=value)

    def areas(self, like: torch.Tensor) -> torch.Tensor:
        """Return the divisors of an average (count down, count across). Up to ``pad`` pixels of padding count."""
        lengths = []
        for (size, kernel, stride, pad), count in zip(self.axes(), self.count, strict=True):
            starts = torch.arange(count, dtype=like.dtype, device=like.device) * stride - pad
            lengths.append((starts + kernel).clamp(max=size + pad) - starts)
        return torch.outer(lengths[0], lengths[1])

    def axes(self) -> zip[tuple[int, int, int, int]]:
        """Return size, kernel, stride and padding of the vertical and of the horizontal axis."""
        return zip(self.size, self.kernel, self.stride, self.pad, strict=True)

    @property
    def reach(self) -> Pair:
        """Return the padding after the map, vertical and horizontal, that gives Caffe's windows when rounding down.

        With it, (size + pad + reach - kernel) // stride + 1 equals ``count`` at every size. Rounding up adds windows as
        long as a pixel is left; if either axis is padded, windows that begin past the padded map are dropped.
        """
        reaches = []
        for _, kernel, stride, pad in self.axes():
            reach = pad if self.round_mode == FLOOR else pad + stride - 1
            reaches.append(min(reach, kernel - 1) if any(self.pad) else reach)
        return reaches[0], reaches[1]


def max_pool(maps: torch.Tensor, windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the maximum of each window and the index, row * width + column, of the pixel it came from.

    The first of equal pixels gets the gradient, padding and NaN never win, and a window without a pixel above
    -FLT_MAX (all NaN, all -inf, or empty) yields -FLT_MAX, index -1 and no gradient.
    """
    if is_recorded():  # without the branch
        values, indices = _native_max_pool(torch.where(maps > LOWEST, maps, LOWEST), windows)
        return values, torch.where(values > LOWEST, indices, -1)
    values, indices = _native_max_pool(maps, windows)
    # In torch NaN wins, so the maxima show whether any window needs Caffe's rule. If none does, this check of the
    # smaller output is the only extra cost.
    if values.numel() and not bool(values.detach().amin() > LOWEST):
        values, indices = _native_max_pool(torch.where(maps > LOWEST, maps, LOWEST), windows)
        indices = torch.where(values > LOWEST, indices, -1)
    return values, indices


def _native_max_pool(maps: torch.Tensor, windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
    kernel, stride, pad = windows.kernel, windows.stride, windows.pad
    maps = channels_side_by_side(maps)
    if windows.known_to_torch:
        ceil = windows.round_mode == CEIL
        return F.max_pool2d(maps, kernel, stride, pad, ceil_mode=ceil, return_indices=True)
    framed = windows.padded(maps, LOWEST)
    values, indices = F.max_pool2d(framed, kernel, stride, return_indices=True)
    rows = indices.div(framed.shape[-1], rounding_mode="floor") - pad[0]
    return values, rows * maps.shape[-1] + indices % framed.shape[-1] - pad[1]


def average_pool(maps: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Return the mean of each window; padding counts as zeros.

    A window without a pixel is 0 divided by the rest of its area. If that is 0, the result is NaN, as in Caffe.
    """
    if windows.known_to_torch and not is_recorded():  # torch 2.13 compiles its gradient wrong at the rim, in ceil mode
        ceil = windows.round_mode == CEIL
        return F.avg_pool2d(maps, windows.kernel, windows.stride, windows.pad, ceil_mode=ceil, count_include_pad=True)
    return _sum_pool(maps, windows) / windows.areas(maps)


def _sum_pool(maps: torch.Tensor, windows: Windows) -> torch.Tensor:
    return F.avg_pool2d(windows.padded(maps, 0.0), windows.kernel, windows.stride, divisor_override=1)


def weighted_pool(maps: torch.Tensor, windows: Windows) -> torch.Tensor:
    """Return the mean of each window's pixels, each weighted by itself: stochastic pooling in the test phase."""
    return _sum_pool(maps * maps, windows) / (_sum_pool(maps, windows) + SMALLEST)


def sampled_pool(maps: torch.Tensor, windows: Windows, generator: torch.Generator) -> torch.Tensor:
    """Return one pixel of each window, drawn with a probability proportional to its value (not negative)."""
    (kernel_h, kernel_w), (down, across) = windows.kernel, windows.count
    columns = F.unfold(windows.padded(maps, 0.0), windows.kernel, stride=windows.stride)
    pixels = columns.view(*maps.shape[:2], kernel_h * kernel_w, down, across)
    with torch.no_grad():
        sums = pixels.cumsum(dim=2)
        shape = (*maps.shape[:2], 1, down, across)
        drawn = 1 - torch.rand(shape, generator=generator, device=maps.device, dtype=maps.dtype)  # never 0
        chosen = (sums >= drawn * sums[:, :, -1:]).byte().argmax(dim=2, keepdim=True)  # the first that reaches it
    return pixels.gather(2, chosen).squeeze(2)
