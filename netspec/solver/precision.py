"""The precision of a training's passes. Weights, gradients, history and losses are always float32.

``fp32``   float32, the default; on GPUs without TF32, which torch enables for cuDNN by default
``tf32``   float32 with 13 fewer bits of mantissa in products, on GPUs that support it; elsewhere the same as fp32
``bf16``   products and the blobs between layers in bfloat16, 8 bits of mantissa, as torch.autocast chooses
``fp16``   the same in float16, 11 bits of mantissa, but a small range: the loss is scaled (:class:`LossScale`)
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch

FP32, TF32, BF16, FP16 = PRECISIONS = ("fp32", "tf32", "bf16", "fp16")
_ROUNDED = {BF16: torch.bfloat16, FP16: torch.float16}
FIRST_SCALE, LARGEST_SCALE, PATIENCE = 2.0**16, 2.0**24, 2000


@contextmanager
def computing(precision: str, device: torch.device) -> Iterator[None]:
    """Within the block, compute passes on the device in a precision."""
    cuda: tuple[Any, ...] = (torch.backends.cuda.matmul, torch.backends.cudnn)
    before = [library.allow_tf32 for library in cuda]
    try:
        for library in cuda:
            library.allow_tf32 = precision == TF32
        kind = _ROUNDED.get(precision)
        with torch.autocast(device.type, kind) if kind else nullcontext():
            yield
    finally:
        for library, allowed in zip(cuda, before, strict=True):
            library.allow_tf32 = allowed


class LossScale:
    """The factor of the loss before the backward pass, so that small gradients do not vanish in float16.

    It is a power of two, so it only affects gradients that would vanish. If a gradient overflows, the
    iteration must not update anything, and the factor is halved. After ``PATIENCE`` iterations without overflow it is
    doubled. For the other precisions it is always 1.
    """

    def __init__(self, precision: str) -> None:
        self.factor = FIRST_SCALE if precision == FP16 else 1.0
        self._scales, self._good = precision == FP16, 0

    @property
    def state(self) -> list[float]:
        """What a resumed training needs: the factor, and the iterations without overflow; [] except for fp16."""
        return [self.factor, self._good] if self._scales else []

    def resume(self, state: Sequence[float]) -> None:
        """Restore ``state``. Without one, as that of a training in another precision, start from the beginning."""
        if self._scales:
            self.factor, good = state or (FIRST_SCALE, 0)
            self._good = int(good)

    def of(self, loss: torch.Tensor) -> torch.Tensor:
        """Return the scaled loss."""
        return loss * self.factor if self._scales else loss

    def remove(self, gradients: list[torch.Tensor]) -> bool:
        """Divide the gradients by the factor, and update the factor; return whether all gradients are finite."""
        if not self._scales or not gradients:
            return True
        largest = torch._foreach_norm(gradients, torch.inf)  # gradients have no gradients themselves
        if not bool(torch.stack(largest).isfinite().all()):
            self.factor, self._good = self.factor / 2, 0
            return False
        torch._foreach_mul_(gradients, 1 / self.factor)
        self._good += 1
        if self._good == PATIENCE:
            self.factor, self._good = min(2 * self.factor, LARGEST_SCALE), 0
        return True


def has_bfloat16() -> bool | None:
    """Return whether the CPU has bfloat16 instructions; None if torch does not know."""
    found = [getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    return any(test() for test in found if test) if any(found) else None
