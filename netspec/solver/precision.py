"""In which numbers a training's passes compute. Weights, gradients, history and losses are float32 in each.

``fp32``   float32, the default; on GPUs without TF32, which torch allows cuDNN by itself
``tf32``   float32 whose products drop 13 bits of the mantissa, on GPUs that have it; elsewhere as fp32
``bf16``   products and the blobs between layers in bfloat16, 8 bits of mantissa, as torch.autocast chooses
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch

from netspec.exact.products import weights_rounded_once

FP32, TF32, BF16 = PRECISIONS = ("fp32", "tf32", "bf16")


def check_precision(precision: str) -> None:
    """Raise ValueError for what is not one of the choices."""
    if precision not in PRECISIONS:
        raise ValueError(f"found precision {precision!r}, expected {', '.join(map(repr, PRECISIONS))}")


@contextmanager
def computing(precision: str, device: torch.device) -> Iterator[None]:
    """Within the block passes on the device compute in a precision."""
    cuda: tuple[Any, ...] = (torch.backends.cuda.matmul, torch.backends.cudnn)
    before = [library.allow_tf32 for library in cuda]
    try:
        for library in cuda:
            library.allow_tf32 = precision == TF32
        with (
            torch.autocast(device.type, torch.bfloat16) if precision == BF16 else nullcontext(),
            weights_rounded_once(),
        ):
            yield
    finally:
        for library, allowed in zip(cuda, before, strict=True):
            library.allow_tf32 = allowed
