"""Finds the dynamic sizes of an exported net: batch, height and width, if the net allows it.

Each size is tried by computing the shapes of all blobs for inputs of other sizes, as when Caffe reshapes a net. A size
is fixed if a layer refuses the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

from netspec.data.blobs import Shape
from netspec.errors import SpecError, Where
from netspec.graph.plan import Node
from netspec.layers.contract.base import ALL_AXES, Layer
from netspec.layers.contract.data_layer import DataLayer
from netspec.net.net import Net

Sizes = tuple[int | None, ...]  # a shape; None where the size is known only when the exported net runs
Shapes = tuple[Shape, ...]  # by value number of the Plan
Axis = tuple[int, int]  # value number, axis
T = TypeVar("T")
WORDS = {"N": "batch", "H": "height", "W": "width"}


def _other_sizes(size: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return sizes to try (a size is dynamic if one of them is possible), and more to find which shapes vary."""
    return (2 * size, 3 * size, size + 32), (size + 7, size + 1)


@dataclass(frozen=True)
class FreeSize:
    """A dynamic size, which is known only when the exported net runs.

    ``axes`` are the axes with this size: of inputs, or of the top of a layer that counts its results (``counted``).
    ``size`` is the size in the built net. ``tried`` are the shapes of all values for some other sizes.
    """

    name: str
    size: int
    axes: tuple[Axis, ...]
    tried: tuple[Shapes, ...]
    counted: bool = False


@dataclass(frozen=True)
class NetShapes:
    """The shapes of all values in the built net, and their dynamic sizes.

    ``fixed`` has a note for the user for each batch, height and width of an input that is not dynamic.
    """

    built: Shapes
    free: tuple[FreeSize, ...]
    fixed: tuple[str, ...] = ()

    def sizes(self, value: int) -> Sizes:
        """Return the shape of a value, with None for sizes that vary."""
        return tuple(None if self.chosen(value, axis) else size for axis, size in enumerate(self.built[value]))

    def chosen(self, value: int, axis: int) -> list[FreeSize]:
        """Return the dynamic sizes on which the size of an axis depends."""
        size = self.built[value][axis]
        return [free for free in self.free if any(shapes[value][axis] != size for shapes in free.tried)]

    def same(self, first: Axis, second: Axis) -> bool:
        """Return whether two axes always have the same size."""
        every = [self.built, *(shapes for free in self.free for shapes in free.tried)]
        return all(shapes[first[0]][first[1]] == shapes[second[0]][second[1]] for shapes in every)

    def name(self, value: int, axis: int) -> str:
        """Return the name of the dynamic size of an axis, or ``?`` if its size only depends on one."""
        return next((free.name for free in self.free if self.same(free.axes[0], (value, axis))), "?")

    def without(self, fixed: FreeSize, why: str) -> NetShapes:
        """Return the shapes with one size fixed, for a reason."""
        free = tuple(other for other in self.free if other is not fixed)
        return NetShapes(self.built, free, (*self.fixed, _line(fixed.name, fixed.size, why)))


def _line(name: str, size: int, why: str) -> str:
    kind, _, blob = name.partition("_")
    return f"the {WORDS[kind]}{f' of {blob}' if blob else ''} is fixed at {size}: {why}"


class Fixed(Exception):
    """A layer needs the size of an axis of a value as a number."""

    def __init__(self, value: int, axis: int, why: str) -> None:
        super().__init__(why)
        self.value, self.axis, self.why = value, axis, why


class LayerShapes:
    """The shapes of the bottoms of the layer that is written now."""

    layer: Layer
    plan_node: Node
    shapes: NetShapes

    def sizes(self, bottom: int) -> Sizes:
        """Return the shape of a bottom; None for a size that is known only when the exported net runs."""
        return self.shapes.sizes(self.plan_node.bottoms[bottom])

    def size(self, bottom: int, axis: int, why: str) -> int:
        """Return the size of an axis of a bottom; if it was free, it is fixed, and the user sees ``why``."""
        value = self.plan_node.bottoms[bottom]
        if self.shapes.chosen(value, axis):
            raise self.fixed(value, axis, why)
        return self.shapes.built[value][axis]

    def fixed(self, value: int, axis: int, why: str) -> Fixed:
        """Return what to raise where the size of an axis must be fixed."""
        return Fixed(value, axis, f'layer "{self.plan_node.name}" ({self.layer.type}): {why}')


def is_given(layer: Layer) -> bool:
    """Return whether the caller of an exported net gives the tops of a layer."""
    return layer.is_input or isinstance(layer, DataLayer)


def settled(net: Net, write: Callable[[NetShapes], T]) -> tuple[T, NetShapes]:
    """Call ``write`` with the shapes; return its result and the shapes. After each Fixed, retry with it fixed."""
    shapes = find_shapes(net)
    while True:
        try:
            return write(shapes), shapes
        except Fixed as fixed:
            for free in shapes.chosen(fixed.value, fixed.axis):
                if free.counted:
                    raise SpecError(f"cannot be exported: {fixed.why}", Where(net.plan.source.file)) from None
                shapes = shapes.without(free, fixed.why)


def find_shapes(net: Net) -> NetShapes:
    """Return the shapes of the values of a net. A size is dynamic if Caffe could reshape the net to other sizes."""
    built = _propagate(net, {})
    free, fixed = [], []
    for name, axes in _input_sizes(net).items():
        size = built[axes[0][0]][axes[0][1]]
        tried, fault = _try(net, axes, size)
        if fault is None:
            free.append(FreeSize(name, size, axes, tried))
        else:
            culprit = fault.where and fault.where.layer
            fixed.append(_line(name, size, f"{fault.where} accepts no other size" if culprit else str(fault)))
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        if layer.counted_axis not in (None, ALL_AXES):
            axes = tuple((v, layer.counted_axis) for v in node.tops)
            size = built[axes[0][0]][axes[0][1]]
            tried, fault = _try(net, axes, size)
            if fault is not None:
                raise fault
            free.append(FreeSize(f"N_{node.name}", size, axes, tried, counted=True))
    _propagate(net, {})  # layers keep the geometry of the last shapes
    return NetShapes(built, tuple(free), tuple(fixed))


def input_shapes(net: Net, shapes: NetShapes) -> dict[str, tuple[int | str, ...]]:
    """Return the shapes of the inputs, by blob. A dynamic size is a name.

    Sizes with the same name must be equal, as Caffe's layers require it.
    """
    found: dict[str, tuple[int | str, ...]] = {}
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        for v in node.tops if is_given(layer) else ():
            sizes: list[int | str] = list(shapes.built[v])
            for free in shapes.free:
                for axis in (axis for value, axis in free.axes if value == v and not free.counted):
                    shared = any(value != v for value, _ in free.axes)
                    alone = shared and _try(net, ((v, axis),), free.size)[1] is None
                    sizes[axis] = f"{free.name}_{net.plan.blobs[v]}" if alone else free.name
            found[net.plan.blobs[v]] = tuple(sizes)
    _propagate(net, {})
    return found


def check_shapes(expected, *inputs):
    """Raise an error for inputs of other shapes. A name stands for any size, and equal names for equal sizes."""
    sizes = {}
    for (name, shape), x in zip(expected.items(), inputs, strict=True):
        for size, wanted in zip(x.shape, shape, strict=False):
            if isinstance(wanted, str):
                sizes.setdefault(wanted, size)
        shape = tuple(sizes.get(wanted, wanted) for wanted in shape)
        if tuple(x.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(x.shape)}, expected {shape}")


def _input_sizes(net: Net) -> dict[str, tuple[Axis, ...]]:
    """Return the sizes of the inputs that may be dynamic, by name. Equal sizes of the same kind count as one."""
    found: dict[tuple[str, int], list[Axis]] = {}
    names: dict[tuple[str, int], str] = {}
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        for v, shape in zip(node.tops, layer.top_shapes, strict=True) if is_given(layer) else ():
            kinds = {"N": 0, "H": 2, "W": 3} if len(shape) == 4 else {"N": 0} if shape else {}
            for kind, axis in kinds.items():
                key = (kind, shape[axis])
                found.setdefault(key, []).append((v, axis))
                taken = kind in names.values()
                names.setdefault(key, f"{kind}_{net.plan.blobs[v]}" if taken else kind)
    return {names[key]: tuple(axes) for key, axes in found.items()}


def _try(net: Net, axes: tuple[Axis, ...], size: int) -> tuple[tuple[Shapes, ...], SpecError | None]:
    """Return the shapes for other sizes of these axes, and the error if none is possible."""
    tried, faults = [], []
    for sizes in _other_sizes(size):
        for other in sizes:
            try:
                tried.append(_propagate(net, dict.fromkeys(axes, other)))
            except SpecError as fault:
                faults.append(fault)
        if not tried:
            return (), faults[0]
    return tuple(tried), None


def _propagate(net: Net, given: Mapping[Axis, int]) -> Shapes:
    """Return the shapes of all values if some axes have the given sizes."""
    shapes: list[Shape] = []
    for node, layer in zip(net.plan.nodes, net.layers, strict=True):
        bottoms = [shapes[v] for v in node.bottoms]
        tops = layer.top_shapes if is_given(layer) else [layer.possible(shape) for shape in layer.reshape(bottoms)]
        for v, shape in zip(node.tops, tops, strict=False):
            assert v == len(shapes), "values are numbered in the order in which they are written"
            shapes.append(tuple(given.get((v, axis), size) for axis, size in enumerate(shape)))
    return tuple(shapes)
