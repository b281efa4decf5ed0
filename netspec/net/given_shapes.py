"""The shapes that a caller gives for what a net reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where, did_you_mean
from netspec.layers import class_of
from netspec.layers.contract.reading import takes_shapes
from netspec.proto.schema import NetParameter


def not_to_be_given(shapes: Mapping[str, Shape], nets: Sequence[NetParameter], path: str | Path) -> list[SpecError]:
    """Return an error for each given shape whose blob is not a top of a data layer (or Python layer)."""
    layers = [layer for net in nets for layer in net.layer]
    makers = [layer for layer in layers if not layer.bottom or ((cls := class_of(layer)) and takes_shapes(cls))]
    blobs = list(dict.fromkeys(top for layer in makers for top in layer.top))
    known = ", ".join(blobs) or "none"
    return [
        SpecError(
            f'--shape: no data layer has a top "{name}"{did_you_mean(name, blobs) or ";"} their tops: {known}',
            Where(str(path)),
        )
        for name in shapes
        if name not in blobs
    ]
