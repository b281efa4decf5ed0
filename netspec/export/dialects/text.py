"""The expressions of layers of netspec/dialects/text."""

from __future__ import annotations

from typing import Any

import torch

from netspec.export.exporter import exports
from netspec.export.expression import Expression, plain
from netspec.export.formats.torch_code import TorchCode

exports("netspec.dialects.text.text.Reverse")(plain(torch.Tensor.flip, "axis"))


@exports("netspec.dialects.text.text.ContinuationIndicator")
def continuation_indicator(layer: Any, code: TorchCode) -> Expression:
    return code.buffer(layer.forward())
