"""Runs forward and backward passes layer by layer through the memory of a net's blobs, as Caffe does.

In a net of netspec, tensors go from layer to layer, and autograd computes the gradients of all layers. Scripts for
pycaffe read and write blobs between the runs of two layers. So here each layer reads the memory of its bottoms and
writes that of its tops. Its backward pass reads the diffs of its tops, and the data that it needs, from that memory.

Caffe: Net::ForwardFromTo, Net::BackwardFromTo, Net::Reshape (src/caffe/net.cpp), include/caffe/layer.hpp
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from typing_extensions import override

from netspec import log
from netspec.graph.plan import AUTOMATIC
from netspec.layers.contract.base import Layer
from netspec.layers.contract.learned import blobs_of, values_of
from netspec.layers.utility.live_blobs import Blob, BlobVec, Memory, Shape, write
from netspec.layers.utility.pycaffe_shim import importable
from netspec.layers.utility.python import Python
from netspec.layers.utility.shape import Flatten
from netspec.net.net import Net
from netspec.run.overwritten import Overwritten, reader_of_memory
from netspec.run.walk import Loss, Step, walk

Hook = Callable[[int], object]


class BlobRunner:
    """The blobs of a net, its layers as ``steps``, and the passes that use them.

    ``names[k]`` is the name of ``blobs[k]``, in Caffe's order. ``hooks`` are called with the index of a layer before
    and after it runs.
    """

    def __init__(self, net: Net) -> None:
        self.net = net
        self.names: list[str] = []
        self.blobs: list[Blob] = []
        self.hooks: dict[str, list[Hook]] = {
            f"{when}_{which}": [] for when in ("before", "after") for which in ("forward", "backward")
        }
        self._lock = threading.RLock()
        self._last: threading.Thread | None = None  # which ran the last forward pass
        self._overtaken = weakref.WeakSet[threading.Thread]()  # which ran earlier ones
        self.steps = [self._step(i) for i in range(len(net.layers))]
        for step in self.steps:
            step.set_up()
        self._prepares = self._can_prepare()
        self._inputs, self._results = self._inputs_and_results()
        self._final_values = frozenset(v for v, *_ in (*self._inputs, *self._results))
        self._hand_on = not all(fresh for *_, fresh in self._results)
        self._no_loss = torch.zeros((), device=net.device)

    # Building

    def _step(self, i: int) -> LayerStep:
        """Return layer ``i`` with its blobs; make those that it adds (Caffe: AppendBottom, AppendTop)."""
        plan, layer = self.net.plan, self.net.layers[i]
        node = plan.nodes[i]
        current = {name: b for b, name in enumerate(self.names)}
        bottoms = [current[plan.blobs[v]] for v in node.bottoms]
        tops = []
        for j, shape in enumerate(layer.top_shapes):
            if j < len(node.tops) and node.in_place[j]:
                tops.append(bottoms[j])
                continue
            blob = layer.top[j] if isinstance(layer, Python) and layer.code else Blob(shape)
            blob.data_memory.device = blob.diff_memory.device = self.net.device
            tops.append(len(self.blobs))
            self.blobs.append(blob)
            self.names.append(plan.blobs[node.tops[j]] if j < len(node.tops) else AUTOMATIC)
            if "data" in layer.shares:
                blob.data_memory = self.blobs[bottoms[0]].data_memory
            # Flatten shares it in its backward pass.
            if "diff" in layer.shares and (self.net.backward_plan.layers[i] or not isinstance(layer, Flatten)):
                blob.diff_memory = self.blobs[bottoms[0]].diff_memory
        made = PythonStep if isinstance(layer, Python) else LayerStep
        return made(self.net, i, self.blobs, bottoms, tops)

    def _inputs_and_results(self) -> tuple[list[tuple[int, int]], list[tuple[int, Blob, bool, bool]]]:
        """Return the inputs as pairs of value and blob, and the last value of every other blob.

        The latter also say whether the blob shares memory with another, and whether the value has memory of its own.
        """
        given: list[tuple[int, int]] = []
        results: dict[int, tuple[int, Blob, bool, bool]] = {}
        for step in self.steps:
            for v, b in zip(step.node.tops, step.top_ids, strict=False):
                if step.layer.is_input:
                    given.append((v, b))
                else:
                    results[b] = v, self.blobs[b], "data" in step.layer.shares, step.is_fresh
        return given, list(results.values())

    # Running

    @contextmanager
    def used(self, forward: bool = True) -> Iterator[None]:
        """A block in which only one thread uses the net, for a forward or backward pass.

        Arrays that a thread holds do not change when another thread runs the net. Raises RuntimeError for a backward
        pass after the forward pass of another thread.
        """
        with self._lock:
            thread = threading.current_thread()
            if self._last is not None and thread is not self._last:
                if not forward and thread in self._overtaken:
                    advice = "give each thread its own net (share_with), or hold a lock during both passes"
                    raise RuntimeError(f"backward: another thread has run this net since; {advice}")
                self._leave_views()
            if forward:
                if self._last is not None:
                    self._overtaken.add(self._last)
                self._overtaken.discard(thread)
                self._last = thread
            yield

    def _leave_views(self) -> None:
        """Leave the present memory to the views of it. Later passes use other memory."""
        written = {id(self.blobs[b].data_memory) for _, b in self._inputs}
        written |= {id(self.blobs[self.names.index(name)].diff_memory) for name in self.net.outputs}
        memories = {id(each): each for blob in self.blobs for each in (blob.data_memory, blob.diff_memory)}
        fresh = {key: memory for key, memory in memories.items() if key not in written}
        for memory in fresh.values():
            memory.leave_views()

    @torch.no_grad()
    def forward(self, start: int, end: int) -> torch.Tensor:
        """Run layers ``start`` to ``end`` (inclusive). Return the weighted sum of their losses, a scalar."""
        self.upload()
        hooked = self.hooks["before_forward"] or self.hooks["after_forward"]
        with self.net.positions:
            if self._prepares and (start, end) == (0, len(self.steps) - 1) and not hooked:
                return self._forward_prepared()
            loss = walk(self._passes("forward", range(start, end + 1)), {}, self.net.options.exact)
        return self._no_loss if loss is None else loss

    def _passes(self, which: str, numbers: Iterable[int]) -> Iterator[Step]:
        """Yield the forward or backward passes of layers, with the hooks before and after them."""
        for i in numbers:
            step = self.steps[i]
            run = step.forward if which == "forward" else step.backward
            for hook in self.hooks[f"before_{which}"]:
                yield Step(i, partial(hook, i), (), ())
            losses = tuple(Loss(j, weight) for j, (_, weight) in enumerate(step.losses)) if which == "forward" else ()
            yield Step(i, run, (), (), losses)
            for hook in self.hooks[f"after_{which}"]:
                yield Step(i, partial(hook, i), (), ())

    def _can_prepare(self) -> bool:
        """Return whether a whole pass may run without blobs, because only the final content of each blob matters."""
        return (
            self.net.prepared is not None
            and self.net.device.type == "cpu"
            and not any(step.records or step.keeps_bottom or step.constants for step in self.steps)
            and not any(isinstance(step, PythonStep) for step in self.steps)
            and AUTOMATIC not in self.names
            and not self.overwrites_shared()
        )

    def overwrites_shared(self) -> bool:
        """Return whether a layer computes in place on memory that another blob shares."""
        sharing: dict[int, set[int]] = {}
        for step in self.steps:
            for top, in_place in zip(step.tops, step.node.in_place, strict=False):
                users = sharing.setdefault(id(top.data_memory), set())
                users.add(id(top))
                if in_place and len(users) > 1:
                    return True
        return False

    def _forward_prepared(self) -> torch.Tensor:
        """Run the whole net with prepared kernels (netspec/fast/prepared.py), and put the results into the blobs."""
        assert self.net.prepared is not None
        given = {v: self.blobs[b].data_memory.tensor(self.blobs[b].shape) for v, b in self._inputs}
        found = self.net.prepared.run_in_any_layout(given, self._final_values)
        assert found is not None, "a pass of pycaffe records no gradients"
        loss, values = found
        taken = storages(list(given.values())) if self._hand_on else set[int]()
        for v, blob, shares, fresh in self._results:
            tensor = values[v]
            if shares:
                if tensor.shape != blob.shape:
                    blob.reshape(*tensor.shape)
                continue
            blob.put_data(tensor if fresh else not_shared(tensor, taken))
            if not fresh:
                taken |= storages([tensor])
        return self._no_loss if loss is None else loss

    @torch.no_grad()
    def backward(self, start: int, end: int) -> None:
        """Run the backward passes of layers ``start`` down to ``end`` (inclusive), from the diffs of their tops.

        The diffs of bottoms are overwritten; those of learnable blobs are added to. Layers that need no backward pass
        are skipped.
        """
        self.upload()
        walk(self._passes("backward", range(start, end - 1, -1)), {}, self.net.options.exact)

    def reshape(self) -> None:
        """Give every blob the shape that follows from the shapes of the inputs. Nothing is computed."""
        for step in self.steps:
            step.reshape()

    def share_with(self, other: BlobRunner) -> None:
        """Use the learnable blobs of another net (Caffe: ShareTrainedLayersWith). Gradients are not shared."""
        other.upload()
        mine = self.net.layers_by_name()
        for theirs in other.net.layers:
            layer = mine.get(theirs.param.name)
            if layer is None:
                log.info("net.cpp:680", f"Ignoring source layer {theirs.param.name}")
                continue
            if layer.blob_shapes != theirs.blob_shapes:
                found = f"blobs {layer.blob_shapes} here, {theirs.blob_shapes} there"
                raise layer.error(f"cannot share param weights of the other net: {found}")
            for blob, source in zip(layer.blobs, theirs.blobs, strict=True):
                blob.data = source.data

    @torch.no_grad()
    def clear_param_diffs(self) -> None:
        """Set the gradients of all learnable blobs to 0 in place."""
        self.upload()
        for learnable in self.net.learnable:
            if learnable.parameter.grad is not None:
                learnable.parameter.grad.zero_()

    def upload(self) -> None:
        """Copy to the GPU what scripts wrote to learnable blobs, before they are used."""
        if self.net.device.type != "cpu":
            for step in self.steps:
                for blob in step.params:
                    for memory in (blob.data_memory, blob.diff_memory):
                        if isinstance(memory, BorrowedMemory):
                            memory.upload()


class Record(NamedTuple):
    """What autograd recorded of a run of a layer: the inputs ``leaves``, the outputs, and the state of its blobs."""

    leaves: list[torch.Tensor]
    tops: Sequence[torch.Tensor]
    blobs: list[tuple[int, int]]


class LayerStep:
    """A layer, its blobs ``bottoms`` and ``tops``, and their numbers in the net, ``bottom_ids`` and ``top_ids``.

    ``losses`` are its tops with a loss weight. ``records``: autograd records its forward pass, for its backward pass.
    """

    def __init__(self, net: Net, i: int, blobs: list[Blob], bottom_ids: list[int], top_ids: list[int]) -> None:
        self.layer: Layer = net.layers[i]
        self.node = net.plan.nodes[i]
        self.bottom_ids, self.top_ids = bottom_ids, top_ids
        self.bottoms, self.tops = [blobs[b] for b in bottom_ids], [blobs[b] for b in top_ids]
        self.params = parameters(self.layer)
        self._learned = blobs_of([self.layer])
        weights = zip(self.tops, net.loss_weights[i], strict=True)
        self.losses = [(top, weight) for top, weight in weights if weight]
        self.constants = self.layer.filled_once()
        self.reads = self.layer.gradient_reads
        self.reached, self.wanted = net.backward_plan.layers[i], net.backward_plan.written[i]
        self._reader = reader_of_memory(self.layer, self.node, net.plan) if self.reads else None
        self._speed: Any = net.options.speed
        self._device = net.device
        self.records = self._is_asked() and not (self.reads or self.layer.shares)
        self.keeps_bottom = "kept" in self.reads and self._is_asked()
        self._bottom: torch.Tensor | None = None  # what it read in its last pass, where it keeps that
        self._record: Record | None = None  # of its last pass

    def set_up(self) -> None:
        """Write the data that Caffe writes when it creates the layer."""
        for top, constant in zip(self.tops, self.constants, strict=False):
            if constant is not None:
                top.data_memory.put(constant.clone())
        for top, weight in self.losses:
            top.diff_memory.put(torch.full(top.shape, weight, device=self._device))

    @property
    def is_fresh(self) -> bool:
        """Whether the top of its prepared kernel has memory of its own, and not a bottom's."""
        return self._speed is not None and self._speed.is_fresh(self.layer)

    def _is_asked(self) -> bool:
        """Return whether a gradient of a bottom or a learnable blob is needed."""
        return self.reached and (any(self.wanted) or any(blob.requires_grad for blob in self.layer.blobs))

    def _is_in_place(self, blob: Blob) -> bool:
        """Return whether the layer overwrites a bottom. It has then kept what its gradient needs."""
        return any(top is blob for top in self.tops)

    def _is_shaped_like(self, blob: Blob, read: torch.Tensor) -> bool:
        """Return whether a bottom has the shape that it had when the layer read it.

        A layer in place may have given it its own shape since: MVN makes four axes.
        """
        return read.numel() == blob.count if self._is_in_place(blob) else read.shape == blob.shape

    # Running

    def reshape(self) -> None:
        """Give the tops the shapes that follow from those of the bottoms."""
        if self.layer.is_input or not self.bottoms:
            return
        self.layer.fit([blob.shape for blob in self.bottoms])
        for top, shape in zip(self.tops, self.layer.top_shapes, strict=True):
            if top.shape != shape:
                top.reshape(*shape)

    def forward(self) -> tuple[torch.Tensor, ...]:
        """Run the layer, and return its losses from the memory of its tops."""
        if self.layer.shares:
            self.reshape()
        elif not self.layer.is_input:
            self._compute()
        return tuple([top.data_memory.tensor(top.shape) for top, _ in self.losses])

    def _compute(self) -> None:
        if self.records:
            self._record = self._recorded()
            values, tops = self._record.leaves, self._record.tops
        else:
            values = [blob.data_memory.tensor(blob.shape) for blob in self.bottoms]
            if self.keeps_bottom:
                self._bottom = values[0].clone()
            tops = self.layer.run(*values)
        constants = self.constants or [None] * len(tops)
        taken = storages(values or list(self.layer.blobs))
        for top, tensor, constant in zip(self.tops, tops, constants, strict=True):
            if constant is None:
                top.put_data(not_shared(tensor.detach(), taken))

    def _recorded(self, kept: Record | None = None) -> Record:
        """Run the layer with autograd. The inputs are the memory of the bottoms, so what scripts write counts.

        ``kept`` has what it has read before in place of bottoms that it overwrites.
        """
        leaves = []
        for i, (blob, wanted) in enumerate(zip(self.bottoms, self.wanted, strict=True)):
            value = blob.data_memory.tensor(blob.shape)
            if self._is_in_place(blob):
                if kept:
                    value = kept.leaves[i]
                elif blob.data_memory.is_watched():
                    value = value.clone()
            leaves.append(value.detach().requires_grad_(wanted))
        with torch.enable_grad():
            tops = self.layer.run(*leaves)
        return Record(leaves, tops, self._state())

    def _state(self) -> list[tuple[int, int]]:
        """Return what changes when torch writes to a learnable blob, or gives it other memory."""
        return [(blob._version, blob.data_ptr()) for blob in self._learned()]

    def backward(self) -> None:
        """Write the diffs of the bottoms that need one from those of the tops, and add to those of learned blobs."""
        if not self.reached or "diff" in self.layer.shares:
            return
        tops = zip(self.tops, self.layer.top_shapes, strict=True)
        diffs = [top.diff_memory.tensor(_shape_of(top, made)) for top, made in tops]
        if self._reader:
            self._backward_from_memory(self._reader, diffs[0])
        elif self._is_asked():
            self._backward_from_record(self._present_record(), diffs)

    def _backward_from_record(self, record: Record, diffs: Sequence[torch.Tensor]) -> None:
        """Compute the gradients by autograd."""
        learned = [blob for blob in self._learned() if blob.requires_grad]
        sums = [gradient_of(blob) for blob in learned]  # exists, since layers may add to it themselves
        asked = [leaf for leaf in record.leaves if leaf.requires_grad]
        ends = [(top, diff) for top, diff in zip(record.tops, diffs, strict=True) if top.requires_grad]
        found: Sequence[torch.Tensor | None] = [None] * (len(asked) + len(learned))
        if ends:
            tops, given = zip(*ends, strict=True)
            found = torch.autograd.grad(tops, [*asked, *learned], given, retain_graph=True, allow_unused=True)
        for total, gradient in zip(sums, found[len(asked) :], strict=True):
            if gradient is not None:
                total.add_(gradient)
        taken, bottoms = (
            storages(diffs),
            [blob for blob, wanted in zip(self.bottoms, self.wanted, strict=True) if wanted],
        )
        for blob, leaf, diff in zip(bottoms, asked, found, strict=False):
            blob.diff_memory.put(not_shared(torch.zeros_like(leaf) if diff is None else diff, taken))

    def _backward_from_memory(self, reader: Overwritten, diff: torch.Tensor) -> None:
        """Compute the gradients from the present data, as Caffe does."""
        if not any(self.wanted):
            return
        first = self.tops[0]
        top = first.data_memory.tensor(diff.shape)
        values = [top if blob is first else blob.data_memory.tensor(blob.shape) for blob in self.bottoms]
        if self._bottom is not None and self._is_shaped_like(self.bottoms[0], self._bottom):
            values = [self._bottom]
        found = reader.gradients(values, top, diff)
        for blob, gradient, asked in zip(self.bottoms, found, self.wanted, strict=True):
            if asked:
                blob.diff_memory.put(gradient)

    def _present_record(self) -> Record:
        """Return the record of the last forward pass, with the present values of the bottoms.

        If the layer has not run with these shapes, or its blobs were updated since, it is run first, without an effect
        on the net.
        """
        record, bottoms = self._record, self.bottoms
        if record is not None and not all(map(self._is_shaped_like, bottoms, record.leaves)):
            record = None
        if record is None or record.blobs != self._state():
            with undisturbed(self.layer):
                self.layer.fit([blob.shape for blob in bottoms] if record is None else [x.shape for x in record.leaves])
                made = self._recorded(record)
            return made._replace(blobs=self._state())
        for leaf, blob in zip(record.leaves, bottoms, strict=True):
            value = leaf if self._is_in_place(blob) else blob.data_memory.tensor(blob.shape)
            if value.data_ptr() != leaf.data_ptr():  # else it has the values, and torch refuses to copy some shapes
                leaf.data.copy_(value)
        return record


def _shape_of(top: Blob, made: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape that a layer gave to its top. A later layer in place may have given it another since."""
    return made if math.prod(made) == top.count else top.shape


class PythonStep(LayerStep):
    """A layer written in Python, whose code reads and writes the blobs itself."""

    layer: Python

    @override
    def set_up(self) -> None:
        if self.layer.code:
            self.layer.bottom[:], self.layer.top[:] = self.bottoms, self.tops
            self.layer.code.blobs = self.params
        super().set_up()

    @override
    def _is_asked(self) -> bool:
        return False  # its code computes its gradient

    @override
    def reshape(self) -> None:
        if self.bottoms:
            with importable():
                self.layer.code.reshape(self.bottoms, self.tops)

    @override
    def _compute(self) -> None:
        with importable():
            self.layer.code.reshape(self.bottoms, self.tops)
            self.layer.code.forward(self.bottoms, self.tops)

    @override
    def backward(self) -> None:
        if self.reached:
            with importable():
                self.layer.code.backward(self.tops, list(self.wanted), self.bottoms)


@contextmanager
def undisturbed(layer: Layer) -> Iterator[None]:
    """A block in which a layer runs without lasting effects on its blobs, its state, or random numbers."""
    blobs, remembered = [(blob, values_of(blob).clone(), blob._version) for blob in layer.blobs], dict(vars(layer))
    with layer.context.random.undisturbed():
        try:
            yield
        finally:
            vars(layer).update(remembered)
            with torch.no_grad():
                for blob, before, version in blobs:
                    if blob._version != version:  # autograd has recorded the others
                        blob.copy_(before)


def storages(tensors: Sequence[torch.Tensor]) -> set[int]:
    """Return the addresses of tensors in main memory. (Views of tensors on a GPU show a copy.)"""
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.device.type == "cpu"}


def not_shared(tensor: torch.Tensor, taken: set[int]) -> torch.Tensor:
    """Return the tensor, or a copy of it if its memory is in ``taken``."""
    aliased = tensor.device.type == "cpu" and tensor.untyped_storage().data_ptr() in taken
    return tensor.clone() if aliased else tensor


class BorrowedMemory(Memory):
    """The memory of a tensor that a net or a solver owns: a learnable blob's values, or their gradient.

    ``find`` returns the tensor. On a GPU views show a copy, which :meth:`upload` copies back.
    """

    def __init__(self, find: Callable[[], torch.Tensor], capacity: int) -> None:
        super().__init__()
        self.capacity = capacity
        self._find = find
        self._copy: torch.Tensor | None = None
        self._written = False

    @override
    def reserve(self, count: int) -> None:
        """Refuse more numbers than there are."""
        if count > self.capacity:
            raise ValueError(f"this blob has {self.capacity} numbers and cannot be reshaped to {count}")

    @override
    def view(self, shape: Shape) -> np.ndarray:
        tensor = self._find().detach()
        if tensor.device.type != "cpu":
            if self._copy is None:
                self._copy = torch.empty(tensor.shape, dtype=tensor.dtype)
            if not self._written:
                self._copy.copy_(tensor)
            tensor, self._written = self._copy, True
        return tensor.view(-1).numpy()[: math.prod(shape)].reshape(shape)

    @override
    def tensor(self, shape: Shape) -> torch.Tensor:
        return self._find().detach().view(-1)[: math.prod(shape)].view(shape)

    @override
    def put(self, tensor: torch.Tensor) -> None:
        """Write to the tensor."""
        write(self._find().detach().view(-1), tensor)

    @torch.no_grad()
    def upload(self) -> None:
        """Copy to the GPU what was written to views."""
        if self._written and self._copy is not None:
            self._find().detach().copy_(self._copy)
        self._written = False


def parameters(layer: Layer) -> BlobVec:
    """Return a layer's learnable blobs, as views of its parameters and of their gradients."""

    def view(j: int, shape: Shape) -> Blob:
        count = layer.blobs[j].numel()
        data = BorrowedMemory(lambda: layer.blobs[j], count)
        return Blob(shape, data, BorrowedMemory(lambda: gradient_of(layer.blobs[j]), count))

    return BlobVec(view(j, shape) for j, shape in enumerate(layer.blob_shapes))


def gradient_of(parameter: torch.Tensor) -> torch.Tensor:
    """Return the gradient of a parameter. Passes add to it, and never replace it."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
    return parameter.grad
