"""A single layer without a net, for experiments and tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from typing_extensions import override

from netspec import log
from netspec.errors import Code, SpecError
from netspec.exact import SMALL
from netspec.graph.options import BuildOptions
from netspec.layers import Context, Layer, Random, unknown_type
from netspec.layers.contract.base import Shape
from netspec.layers.contract.context import device_of, nowhere
from netspec.layers.contract.registry import registered
from netspec.net.net import Array
from netspec.proto.forks import forks
from netspec.proto.reader import read_text
from netspec.proto.schema import LayerParameter, NetParameter, phase_of
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.upgrade.current import upgrade_net

FILE = "<layer>"  # the file name in errors


def layer(
    text: str,
    *shapes: Shape,
    tops: int | None = None,
    phase: str | int = "TEST",
    seed: int = 0,
    device: str | torch.device = "cpu",
    allow_python: bool = False,
    exact: str = SMALL,
) -> OneLayer:
    """Return a layer that can be called with tensors. ``text`` is what stands between the braces of ``layer { }``.

    Bottoms and tops need no names. ``tops`` is the number of tops, by default the fewest that the type allows. The
    layer is built when the shapes of its bottoms are known: at the first call, or at once if ``shapes`` are given.
    ``exact`` is as for a net (netspec/exact). Raises SpecError.

        >>> netspec.layer('type: "Pooling" pooling_param { kernel_size: 2 stride: 2 }')(images).shape
        torch.Size([2, 3, 16, 16])
    """
    options = BuildOptions(str(device_of(device)), seed, allow_python=allow_python, exact=exact)
    context = Context(phase_of(phase), options, Random(seed))
    return OneLayer(partial(make_layer, text, context=context, tops=tops), shapes)


class OneLayer(torch.nn.Module):
    """A function of a layer's bottoms, tensors or arrays, that returns its top, or a tuple if it has several.

    ``layer`` is the Layer, with its ``blobs`` and ``top_shapes``. It is None before the layer is built.
    """

    def __init__(self, make: Callable[[Sequence[Shape]], Layer], shapes: Sequence[Shape] = ()) -> None:
        super().__init__()
        self._make = make
        self.layer = make(shapes) if shapes else None

    @override
    def forward(self, *bottoms: Array) -> torch.Tensor | tuple[torch.Tensor, ...]:
        tensors = [x if isinstance(x, torch.Tensor) else torch.tensor(np.asarray(x, np.float32)) for x in bottoms]
        self.layer = self.layer or self._make([tuple(tensor.shape) for tensor in tensors])
        tops = self.layer.run(*tensors)
        return tops[0] if len(tops) == 1 else tops


def make_layer(text: str, shapes: Sequence[Shape], context: Context, tops: int | None = None) -> Layer:
    """Build the layer that ``text`` describes, for bottoms of these shapes.

    Errors name a line of ``text``, unless ``context`` has another ``at``.
    """
    param = LayerParameter()
    position = read_text(text, FILE, param)
    source = SourceMap(FILE, Position(position.where), (position,), dialects=position.dialects)
    net, source = upgrade_net(NetParameter(layer=[param]), source)
    (param,) = net.layer
    at = partial(source.at, 0, layer=param.name, type=param.type)
    param.bottom.extend(f"bottom{i}" for i in range(len(param.bottom), len(shapes)))
    param.top.extend(f"top{i}" for i in range(len(param.top), tops or 0))
    meaning = forks().meaning(net, source, context.options)
    cls = meaning.classes.get(0) or registered(param.type)
    if cls is None:
        raise SpecError(unknown_type(param.type), at("type"), Code.UNKNOWN_TYPE, (param.type,))
    if tops is None:
        fewest = len(shapes) if cls.same_tops else cls.tops[0] or 0
        most = fewest or int(cls.tops[1] is None)
        param.top.extend(f"top{i}" for i in range(len(param.top), most))
    for warning in meaning.warnings:
        log.logger.warning(warning)
    options = replace(context.options, dialects=meaning.dialects)
    context = replace(context, options=options, fork=meaning.forks.get(0, ""))
    return cls(param, shapes, replace(context, at=at) if context.at is nowhere else context)
