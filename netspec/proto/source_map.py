"""The line and column of each part of a net. Every pass takes and returns it together with the NetParameter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from netspec.errors import Report, Where, raise_fault

_NONE: dict[str, tuple[Position, ...]] = {}  # shared by all positions without fields


@dataclass(frozen=True, slots=True)
class Position:
    """The position of a message in its file, and the positions of the values of its fields, by field name, in order.

    ``dialects`` of the outermost message are those that comments name.
    """

    where: Where
    fields: Mapping[str, tuple[Position, ...]] = field(default_factory=lambda: _NONE)
    dialects: tuple[str, ...] = ()

    def find(self, *path: str | int) -> Where:
        """Return the position of ``path``, e.g. ``("convolution_param", "pad", 1)``, or of its nearest known ancestor.

        A name selects the first value of that field; an index after it selects the value with that index.
        """
        node = self
        steps = list(path)
        while steps:
            name = steps.pop(0)
            index = steps.pop(0) if steps and isinstance(steps[0], int) else 0
            children = node.fields.get(str(name), ())
            if not children:
                break
            node = children[min(int(index), len(children) - 1)]
        return node.where


@dataclass(frozen=True)
class SourceMap:
    """``layers[i]`` is the position of layer ``i`` of the NetParameter.

    ``report`` gets each error in the net, from the first pass until the net is built and has its weights. By default it
    raises the first one; another function can collect them. ``dialects`` are those that a comment names.
    ``left_out`` maps the blobs of excluded layers to a text with the layer's name and advice.
    """

    file: str
    net: Position
    layers: tuple[Position, ...] = ()
    report: Report = field(default=raise_fault, compare=False)
    dialects: tuple[str, ...] = ()
    left_out: Mapping[str, tuple[str, str]] = field(default_factory=lambda: {}, compare=False)

    @staticmethod
    def of(net: Position) -> SourceMap:
        """Return the map of a net that was just read; its layers are in ``layer``, or in ``layers`` (old format)."""
        layers = (*net.fields.get("layer", ()), *net.fields.get("layers", ()))
        return SourceMap(net.where.file, net, layers, dialects=net.dialects)

    @staticmethod
    def unknown(file: str, count: int) -> SourceMap:
        """Return a map for a net that was not read from text (a binary file, a message made in Python)."""
        node = Position(Where(file))
        return SourceMap(file, node, (node,) * count)

    def as_net(self) -> Position:
        """Return the position of the net, including those of its current layers; see :meth:`of`."""
        others = {name: nodes for name, nodes in self.net.fields.items() if name not in ("layer", "layers")}
        return replace(self.net, fields={**others, "layer": self.layers})

    def at(self, index: int, *path: str | int, layer: str = "", type: str = "") -> Where:
        """Return the position of a field of layer ``index``, labeled with the layer's name and type."""
        return replace(self.layers[index].find(*path), layer=layer, type=type)

    def reporting_to(self, report: Report) -> SourceMap:
        """Return a map of the same net that passes errors to ``report``."""
        return replace(self, report=report)

    def with_layers(self, layers: Iterable[Position]) -> SourceMap:
        """Return the map of a net with these layers, in order."""
        return replace(self, layers=tuple(layers))
