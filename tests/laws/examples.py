"""One example of each layer type, read from ``docs/reference/layers.prototxt``, with values for its bottoms."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from google.protobuf import text_format

from netspec.proto.schema import LayerParameter
from paths import ROOT

Shape = tuple[int, ...]
MAPS = (2, 4, 5, 6)
FILE = ROOT / "docs" / "reference" / "layers.prototxt"
ENTRY = re.compile(r"^# (?P<bottoms>[^\n]*?) ?(?:->[^\n]*)?\nlayer \{(?P<text>.*?)^\}$", re.M | re.S)


def labels(shape: Shape) -> torch.Tensor:
    return torch.arange(int(np.prod(shape))).reshape(shape) % 4


def flags(shape: Shape) -> torch.Tensor:
    return torch.arange(int(np.prod(shape))).reshape(shape) % 2


def ones(shape: Shape) -> torch.Tensor:
    return torch.ones(shape)


def beginnings(shape: Shape) -> torch.Tensor:
    """Return the cont of sequences that begin with the batch."""
    return torch.cat([torch.zeros(1, *shape[1:]), torch.ones(shape[0] - 1, *shape[1:])])


def positive(shape: Shape) -> torch.Tensor:
    return torch.linspace(0.1, 1, int(np.prod(shape))).reshape(shape)


# By a bottom's name; others hold normal numbers.
VALUES: dict[str, Callable[[Shape], torch.Tensor]] = {
    "label": labels,
    "words": labels,
    "chosen": flags,
    "same": flags,
    "yes": flags,
    "going": flags,
    "selector": ones,
    "cont": beginnings,
    "prob": positive,
}
BATCH = {"LSTM": 1, "RNN": 1, "LSTMUnit": 1, "InfogainLoss": None}  # the axis of the items, where it is not 0
NOT_SMOOTH = {"Accuracy", "ArgMax", "HDF5Output", "Silence", "Threshold"}


@dataclass(frozen=True)
class Example:
    """A layer with names for bottoms and tops, and its bottoms: their shapes, and of some the ``values``.

    ``batch`` is the axis of the items, None where there is no other batch to try; ``smooth``: there is a gradient.
    """

    param: LayerParameter
    shapes: tuple[Shape, ...] = (MAPS,)
    values: dict[int, Callable[[Shape], torch.Tensor]] = field(default_factory=dict)
    batch: int | None = 0
    smooth: bool = True

    @property
    def tops(self) -> int:
        return len(self.param.top)

    def bottoms(self, times: int = 1) -> list[torch.Tensor]:
        """Return bottoms, in double, of ``times`` as many items as ``shapes`` say; most hold normal numbers."""
        generator = torch.Generator().manual_seed(5)
        made = []
        for i, shape in enumerate(self.shapes):
            sizes = tuple(size * (times if axis == self.batch else 1) for axis, size in enumerate(shape))
            made.append(self.values[i](sizes) if i in self.values else torch.randn(sizes, generator=generator))
        return [bottom.double() for bottom in made]


def _example(text: str, bottoms: str) -> Example:
    param = text_format.Parse(text, LayerParameter())
    shapes = tuple(tuple(map(int, each.split("=")[1].split(","))) for each in bottoms.split())
    return Example(
        param,
        shapes,
        {i: VALUES[name] for i, name in enumerate(param.bottom) if name in VALUES},
        BATCH.get(param.type, 0) if shapes else None,
        bool(shapes or param.type == "Parameter") and param.type not in NOT_SMOOTH,
    )


def examples() -> dict[str, Example]:
    """Return the examples by type; that of Python, whose code is not the reference's, is added here."""
    found = [_example(entry["text"], entry["bottoms"]) for entry in ENTRY.finditer(FILE.read_text())]
    python = 'name: "it" type: "Python" bottom: "x" top: "y" python_param { module: "law_twice" layer: "Twice" }'
    return {each.param.type: each for each in (*found, _example(python, "x=2,4,5,6"))}


EXAMPLES = examples()
