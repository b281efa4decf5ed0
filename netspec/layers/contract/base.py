"""The base class of layers: a module built from a LayerParameter and the shapes of its bottoms.

A layer is made in two phases. Its constructor checks everything, and computes by integer arithmetic ``top_shapes``, the
shapes that ``forward`` will return, and those of its learnable blobs, which are on torch's device "meta". ``allocate``
gives them memory and fills them; a net calls it once it knows that the memory is enough. Without a net, the constructor
does.

A new layer, also of a dialect, needs ``reshape`` and ``forward``, and ``setup`` if it has settings or learnable blobs.
``construct`` and ``ReadingLayer.open`` exist only for the order of the log: Caffe opens a database in a layer's
constructor, before it logs the layer's bottoms and tops, and reads the first record after that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import torch
from typing_extensions import override

from netspec.data.blobs import Shape
from netspec.errors import SpecError
from netspec.exact import NONE
from netspec.exact.arithmetic import AsTorch, arithmetic
from netspec.files.limits import amount, is_out_of_memory, memory
from netspec.graph.plan import Param
from netspec.layers.contract import fillers
from netspec.layers.contract.context import Context
from netspec.layers.contract.learned import Learned, values_of

MOST_AXES = 32  # the most axes of a blob in Caffe (kMaxBlobAxes)
MOST = 2**31 - 1  # the most numbers in a blob in Caffe (Blob::Reshape)


def shape_string(shape: Sequence[int]) -> str:
    """Return a shape as Caffe prints it, ``64 20 24 24 (737280)`` (Caffe: Blob::shape_string)."""
    return "".join(f"{d} " for d in shape) + f"({math.prod(shape)})"


ALL_AXES = -1  # counted_axis of a layer whose tops may have any shapes


class Scorer(NamedTuple):
    """A layer's own score of a test.

    ``score`` takes the layer's tops of all batches, and the SolverParameter or None; ``reads`` are a fork's fields of
    the solver that it reads.
    """

    score: Callable[[Sequence[torch.Tensor], Any], list[float]]
    reads: frozenset[str] = frozenset()


State = dict[str, int | str | tuple[torch.Tensor, ...]]  # what a layer keeps between passes

_PLAIN = frozenset({bool, int, float, str, tuple, list})
_NO_BLOBS = torch.nn.ParameterList()  # shared by all layers without blobs; stays empty


class Layer(torch.nn.Module):
    """Base of all layers. A subclass declares its counts, then implements ``setup``, ``reshape`` and ``forward``.

    ``setup()`` reads ``self.param``, refuses what is wrong (``raise self.error(...)``) and adds the learnable blobs;
    ``self.bottom_shapes`` is known. ``reshape(bottom_shapes)`` returns the tops' shapes; it runs in the constructor and
    again whenever bottoms of other shapes arrive. ``forward(*bottoms)`` returns a tensor, or a tuple, one per top.

    Everything else that a layer can do has a default here. A subclass that replaces ``forward`` starts again from the
    defaults of ``OF_FORWARD``, because what its base class says of the old ``forward`` need not be true of the new one.

    Caffe: include/caffe/layer.hpp
    """

    type: ClassVar[str] = ""
    bottoms: ClassVar[tuple[int, int | None]] = (1, 1)  # fewest and most (None: any number)
    tops: ClassVar[tuple[int, int | None]] = (1, 1)
    same_tops: ClassVar[bool] = False  # as many tops as bottoms
    is_loss: ClassVar[bool] = False  # a missing top is added, and default_loss_weight is 1
    is_input: ClassVar[bool] = False  # its tops are given by the caller
    takes_empty: ClassVar[bool] = True  # bottoms of no channels or pixels; layers of forks take only those of no items
    label_bottoms: ClassVar[frozenset[int]] = frozenset()  # never receive a gradient (Caffe's AllowForceBackward)
    reads: ClassVar[frozenset[str]] = frozenset()  # the fields of LayerParameter that it reads; set by ``register``
    ignores: frozenset[str] = frozenset()  # those of ``reads`` that have no effect, e.g. "data_param.scale"
    shares: frozenset[str] = frozenset()  # "data", "diff": what its tops share with its bottom in Caffe's memory
    # the axis of the tops with a size that is known only after forward, which may be ALL_AXES
    counted_axis: ClassVar[int | None] = None
    ignores_frozen: ClassVar[bool] = False  # computes the gradients of all blobs, also of those with lr_mult: 0
    ignores_propagate_down: frozenset[int] = frozenset()  # the bottoms that get a gradient even where it is false
    changes_itself: bool = False  # a pass changes its state, so it can be neither prepared nor copied
    passes_on: bool = False  # every top is the bottom, unchanged, at the present settings
    # what the layer before it may compute too: "relu" (max(x, 0)), "scale" (factors and biases of channels)
    joins_as: str = ""
    # what its gradient reads from memory: of "bottom", "sign" (of it), "top" and "kept" (the bottom of the forward
    # pass); empty if autograd saves all that it needs
    gradient_reads: frozenset[str] = frozenset()

    OF_FORWARD: ClassVar[tuple[str, ...]] = (
        "passes_on",
        "joins_as",
        "joined_with",
        "gradient_reads",
        "caffes_gradient",
        "caffes_gradients",
    )

    @override
    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        if "forward" in vars(cls):
            for name in set(cls.OF_FORWARD) - set(vars(cls)):
                setattr(cls, name, vars(Layer)[name])

    def __init__(self, param: Any, bottom_shapes: Sequence[Shape], context: Context | None = None) -> None:
        super().__init__()
        self.param = param
        self.context = context or Context()
        self.phase: int = param.phase if param.HasField("phase") else self.context.phase
        self.bottom_shapes: list[Shape] = [tuple(s) for s in bottom_shapes]
        self.num_tops: int = max(len(param.top), self.tops[0] if self.is_loss else 0)
        self.blobs = _NO_BLOBS
        self.blob_shapes: list[Shape] = []
        self.held: frozenset[int] = frozenset()  # blobs whose gradient another layer computes, but not this one
        self._fillings: list[tuple[Any, float]] = []  # of the blobs: a FillerParameter or None, and a value
        self.construct()
        self.context.created(self.num_tops)
        self.refuse(self._wrong_counts())
        self.setup()
        self.top_shapes: list[Shape] = self._reshaped(self.bottom_shapes)
        self._shapes_checked = False  # whether a pass at the present shapes gave tops of ``top_shapes``
        if self.context.allocates:
            self.allocate()

    @override
    def __setattr__(self, name: str, value: Any) -> None:
        """Set plain values directly, because torch's check for modules and parameters is slow."""
        if type(value) in _PLAIN:
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    @override
    def _apply(self, fn: Any, *arguments: Any, **named: Any) -> Any:
        """Move the layer to another device, or change its precision. Its tensors other than blobs are moved too."""
        super()._apply(fn, *arguments, **named)
        before = torch.empty(0, device=self.context.device)
        if (device := fn(before).device) != before.device:
            self.context = replace(self.context, options=replace(self.context.options, device=str(device)))
            for name, value in list(vars(self).items()):
                if isinstance(value, torch.Tensor):
                    setattr(self, name, value.to(device))
                elif isinstance(value, (list, tuple)) and any(isinstance(each, torch.Tensor) for each in value):
                    moved = [each.to(device) if isinstance(each, torch.Tensor) else each for each in value]
                    setattr(self, name, type(value)(moved))
        return self

    def construct(self) -> None:
        """Do what Caffe does in the layer's constructor, if it shows in the log."""

    def setup(self) -> None:
        """Read the parameters and add the learnable blobs."""

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shapes of the tops for bottoms of these shapes; may keep geometry on ``self``."""
        raise self.error(f"class {type(self).__name__} does not define reshape(bottom_shapes); write it", "type")

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        raise self.error(f"class {type(self).__name__} does not define forward(*bottoms); write it", "type")

    @property
    def small(self) -> bool | None:
        """Whether the layer is so small, at its present shapes, that summing in Caffe's order costs almost no time.

        None if ``exact: small`` does not apply to this layer.
        """
        return None

    def arithmetic(self, bottom: torch.Tensor, small: bool | None = None) -> AsTorch:
        """Return the arithmetic to use for a bottom: torch's, or, depending on the option ``exact``, Caffe's.

        ``small`` overrides the property ``small``. If the blobs have another dtype than the bottom, it is torch's.
        """
        options, small = self.context.options, self.small if small is None else small
        found = arithmetic(options.exact, bottom, bool(small), options.accumulate_in_place)
        if found.is_caffes and any(blob.dtype != bottom.dtype for blob in self.blobs):
            return arithmetic(NONE, bottom, in_place=options.accumulate_in_place)
        return found

    def close(self) -> None:
        """Close files and stop threads, if the layer has any."""

    def multiply_adds(self) -> int:
        """Return the multiply-adds of one forward pass at the present shapes (0 where they are not counted)."""
        return 0

    # What a layer may do in addition; see also the attributes

    def joined_with(self, after: Layer) -> Layer | None:
        """Return a layer that does the work of this one and of ``after`` in a training, with the blobs of both."""
        return None

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """Return the bottom's gradient with Caffe's steps, from the data in memory at the backward pass.

        Not for a layer with several tops. A layer that works in place gets the same tensor as its bottom and its top.
        """
        raise NotImplementedError

    def caffes_gradients(
        self, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the gradients of all bottoms; see :meth:`caffes_gradient`. With several, it is never in place."""
        return (self.caffes_gradient(bottoms[0], top, diff),)

    def gradients_from_memory(
        self, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the result of ``caffes_gradients``, with the memory of the top in the shape of its gradient.

        A later layer in place may have given it other axes: MVN makes four.
        """
        fitting = top.view(diff.shape)
        return self.caffes_gradients([fitting if bottom is top else bottom for bottom in bottoms], fitting, diff)

    def restart(self) -> None:
        """Return to the first record."""

    def running_state(self) -> State:
        """Return the state that the layer keeps between passes, without its blobs."""
        return {}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Restore a result of :meth:`running_state`. Raises SpecError for an impossible value."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Do the same as :meth:`resume`. Raises SpecError also if the state is that of another kind of layer."""
        found, mine = (
            ", ".join(f"{name} ({type(value).__name__})" for name, value in sorted(each.items()))
            for each in (state, self.running_state())
        )
        if found != mine:
            raise self.error(f"found a saved state with {found}, expected {mine or 'nothing'}")
        self.resume(state)

    def missing_input(self) -> SpecError | None:
        """Return an error if a solver cannot run the layer, because a program must first give it data."""
        return None

    def filled_once(self) -> Sequence[torch.Tensor | None]:
        """Return for each top its values, filled when it was built, or None; an empty sequence if none is constant."""
        return ()

    def scorer(self) -> Scorer | None:
        """Return how a test is scored from the tops of all its batches; None: by their means."""
        return None

    def takes_stored(self, index: int, shape: Shape) -> bool:
        """Return whether a blob of this shape in a file can be its learnable blob ``index``."""
        return shape == self.blob_shapes[index]

    # Running

    def run(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Reshape if the bottoms' shapes changed, run ``forward``, return a tuple."""
        self.fit([tuple(b.shape) for b in bottoms])
        try:
            tops = self(*bottoms)
        except (MemoryError, RuntimeError) as fault:
            if is_out_of_memory(fault):
                there = f"this machine has {amount(memory())}"
                raise self.error(f"its pass needs more memory than available; {there}") from None
            raise
        tops = tops if isinstance(tops, tuple) else (tops,)
        if not self._shapes_checked:
            self.check_shapes(tops)
            self._shapes_checked = True
        return tops

    def check_shapes(self, tops: Sequence[torch.Tensor]) -> None:
        """Raise SpecError if the tops of a pass have other shapes than ``reshape`` returned."""
        found = [tuple(top.shape) if isinstance(top, torch.Tensor) else None for top in tops]
        expected = found if self.counted_axis == ALL_AXES else self.top_shapes
        if list(map(self._counted, found)) != list(map(self._counted, expected)):
            one, other = (" and ".join(map(str, shapes)) or "no top" for shapes in (found, self.top_shapes))
            raise self.error(f"forward returned a top of shape {one}, but reshape returned {other}", "type")

    def _counted(self, shape: Shape | None) -> Shape | None:
        """Return a shape without the size of ``counted_axis``."""
        axis = self.counted_axis
        return shape if shape is None or axis is None else (*shape[:axis], *shape[axis + 1 :])

    def fit(self, bottom_shapes: list[Shape]) -> None:
        """Reshape for bottoms of these shapes, if they have changed."""
        if bottom_shapes != self.bottom_shapes:
            self.bottom_shapes, self._shapes_checked = bottom_shapes, False
            try:
                self.top_shapes = [tuple(s) for s in self.reshape(bottom_shapes)]
            except SpecError:
                self.bottom_shapes = []  # the next shapes are checked again
                raise

    def add_blob(self, shape: Sequence[int], filler: Any = None, value: float = 0.0) -> None:
        """Append a learnable blob, filled by a FillerParameter, or with ``value`` where ``filler`` is None.

        It has no memory before :meth:`allocate`.
        """
        axes = self.possible(shape)
        if filler is not None:
            try:
                fillers.check(filler, axes)
            except ValueError as fault:
                self.context.report(self.error(str(fault), *self._path_to(filler)))
                filler = None
        if not self.blobs:
            self.blobs = torch.nn.ParameterList()
        self.blobs.append(Learned(torch.empty(axes, device="meta")))
        self.blob_shapes.append(axes)
        self._fillings.append((filler, value))

    def allocate(self) -> None:
        """Give the learnable blobs memory on the net's device, and fill them in order."""
        device, fillings = self.context.device, self._fillings
        self._fillings = []
        for j, (filler, value) in enumerate(fillings if device.type != "meta" else ()):
            if filler is None:
                data = fillers.constant(self.blob_shapes[j], value, device)
            else:
                data = fillers.draw(filler, self.blob_shapes[j], self.context.random.on("cpu")).to(device)
            self.blobs[j] = Learned(data)

    def blob(self, index: int) -> torch.Tensor:
        """Return learnable blob ``index`` in this layer's shape (a PERMISSIVE sharer's owner may have another)."""
        tensor = values_of(self.blobs[index]) if index in self.held else self.blobs[index]
        return tensor if tensor.shape == self.blob_shapes[index] else tensor.view(self.blob_shapes[index])

    def param_spec(self, j: int, given: Param | None) -> Param:
        """Return how blob ``j`` is learned: as ``given`` by the prototxt, or else with multipliers of 1."""
        return given or Param("", 1.0, 1.0, False, None)

    @property
    def default_loss_weight(self) -> float:
        """The loss_weight of the first top where the prototxt gives none."""
        return float(self.is_loss)

    def values(self) -> list[torch.Tensor]:
        """Return the values of all learnable blobs, in this layer's shapes, without gradients, for reading."""
        return [values_of(self.blob(j)) for j in range(len(self.blobs))]

    def possible(self, shape: Sequence[int]) -> Shape:
        """Return a shape as a tuple. Raise SpecError for a negative size, or for more axes or numbers than in Caffe."""
        if min(shape, default=0) < 0:
            raise self.error(f"found shape {tuple(shape)}, expected no negative size")
        if len(shape) > MOST_AXES:
            raise self.error(f"found a blob of {len(shape):,} axes, expected at most {MOST_AXES}")
        if (numbers := max((math.prod(shape), *shape))) > MOST:  # also along one axis, if another is empty
            raise self.error(f"found shape {tuple(shape)}, {numbers:,} numbers, expected at most {MOST:,}")
        return tuple(shape)

    def _reshaped(self, bottom_shapes: list[Shape]) -> list[Shape]:
        """Return the result of ``reshape``, after checking that it has a possible shape for each top."""
        for i, shape in enumerate(() if self.takes_empty else bottom_shapes):
            if 0 in shape[1:]:
                raise self.error(f"found an empty bottom, of shape {shape}", "bottom", i)
        shapes: Any = self.reshape(bottom_shapes)
        if not isinstance(shapes, Sequence) or not all(isinstance(shape, Sequence) for shape in shapes):
            raise self.error(f"reshape returned {shapes!r}, expected one shape for each top, such as [(2, 3)]", "type")
        if len(shapes) != self.num_tops:
            raise self.error(f"reshape returned {len(shapes)} shape(s), expected {self.num_tops}, one for each top")
        return [self.possible(shape) for shape in shapes]

    def refuse(self, faults: Iterable[SpecError]) -> None:
        """Report all of these errors. If there are any, the layer is not built."""
        found = list(faults)
        for fault in found[:-1]:
            self.context.report(fault)
        if found:
            raise found[-1]

    def error(self, message: str, *path: str | int) -> SpecError:
        """Return a SpecError at a field of this layer, e.g. ``self.error("...", "pooling_param", "kernel_size")``."""
        return SpecError(message, self.context.at(*path))

    def canonical_axis(self, axis: int, shape: Shape, *path: str | int) -> int:
        """Return ``axis`` counted from the front; negative ones count from the end (Caffe: CanonicalAxisIndex)."""
        if not -len(shape) <= axis < len(shape):
            raise self.error(f"axis {axis} is out of range for a blob of {len(shape)} axes, shape {shape}", *path)
        return axis % len(shape)

    def _path_to(self, message: Any) -> tuple[str, ...]:
        """Return the path of this message in the layer's fields: ``("convolution_param", "weight_filler")``."""
        for outer, settings in self.param.ListFields():
            for inner, value in settings.ListFields() if hasattr(settings, "ListFields") else ():
                if value is message:
                    return outer.name, inner.name
        return ()

    def _wrong_counts(self) -> Iterator[SpecError]:
        for found, (least, most), what in (
            (len(self.bottom_shapes), self.bottoms, "bottom"),
            (self.num_tops, self.tops, "top"),
        ):
            if found < least or (most is not None and found > most):
                if most is None:
                    wanted = f"at least {least}"
                else:
                    wanted = str(least) if least == most else f"{least} to {most}"
                yield self.error(f"found {found} {what} blob(s), expected {wanted}", what)
        if self.same_tops and self.num_tops != len(self.bottom_shapes):
            yield self.error(
                f"found {self.num_tops} top blob(s) for {len(self.bottom_shapes)} bottom blob(s), expected as many",
                "top",
            )


def is_in_place(layer: Layer) -> bool:
    """Return whether a layer's first top is its first bottom."""
    return layer.param.top[:1] == layer.param.bottom[:1]


def refuse_in_place(layer: Layer) -> None:
    """Raise a SpecError if a layer's first top is its first bottom. For layers where Caffe refuses it too."""
    if is_in_place(layer):
        raise layer.error("cannot be computed in place, as in Caffe; give its top another name", "top")
