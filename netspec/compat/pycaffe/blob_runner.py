"""Runs forward and backward passes layer by layer through the memory of a net's blobs, as Caffe does.

In a net of netspec, tensors go from layer to layer, and autograd computes the gradients of all layers. Scripts for
pycaffe read and write blobs between the runs of two layers. So here each layer reads the memory of its bottoms and
writes that of its tops. Its backward pass reads the diffs of its tops, and the data that it needs, from that memory.

Caffe: Net::ForwardFromTo, Net::BackwardFromTo, Net::Reshape (src/caffe/net.cpp)
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial

import torch

from netspec import log
from netspec.compat.pycaffe.tapes import (
    Bound,
    Tape,
    by_autograd,
    gradient_of,
    not_shared,
    overwrites_shared,
    parameters,
    storages,
    undisturbed,
)
from netspec.exact.blas import one_thread
from netspec.graph.plan import AUTOMATIC
from netspec.layers.contract.base import Layer
from netspec.layers.contract.gradients import gradient_reads, gradients_from_memory
from netspec.layers.contract.learned import Seen
from netspec.layers.contract.reading import Constant
from netspec.layers.utility.live_blobs import Blob, BorrowedMemory
from netspec.layers.utility.pycaffe_shim import importable
from netspec.layers.utility.python import Python
from netspec.net.net import Net
from netspec.run.recorded import recorded
from netspec.run.walk import Step, walk

Hook = Callable[[int], object]


class BlobRunner:
    """The blobs of a net, and the passes that use them.

    ``names[k]`` is the name of ``blobs[k]``, in Caffe's order. ``bottoms[i]`` and ``tops[i]`` are the blobs of layer i,
    ``params[i]`` its learnable blobs. ``hooks`` are called with the index of a layer before and after it runs.
    """

    def __init__(self, net: Net) -> None:
        self.net = net
        self.names: list[str] = []
        self.blobs: list[Blob] = []
        self.bottom_ids: list[list[int]] = []
        self.top_ids: list[list[int]] = []
        self.hooks: dict[str, list[Hook]] = {
            f"{when}_{which}": [] for when in ("before", "after") for which in ("forward", "backward")
        }
        self._lock = threading.RLock()
        self._last: threading.Thread | None = None  # which ran the last forward pass
        self._overtaken = weakref.WeakSet[threading.Thread]()  # which ran earlier ones
        self._layers: list[Layer] = list(net.layers)
        self.params = [parameters(layer) for layer in self._layers]
        self._tapes: list[Tape | None] = [None] * len(self._layers)
        self._bound: list[Bound | None] = [None] * len(self._layers)
        for i in range(len(self._layers)):
            self._wire(i)
        self.bottoms = [[self.blobs[b] for b in ids] for ids in self.bottom_ids]
        self.tops = [[self.blobs[b] for b in ids] for ids in self.top_ids]
        self._losses = [
            [(top, weight) for top, weight in zip(tops, weights, strict=True) if weight]
            for tops, weights in zip(self.tops, net.loss_weights, strict=True)
        ]
        self._kept = [layer.filled_once() if isinstance(layer, Constant) else () for layer in self._layers]
        self._records = [self._is_recorded(i) for i in range(len(self._layers))]
        self._has_kernels = [self._can_bind(i) for i in range(len(self._layers))]
        self._keeps = ["kept" in gradient_reads(layer) and self._is_asked(i) for i, layer in enumerate(self._layers)]
        self._read: list[torch.Tensor | None] = [None] * len(self._layers)  # what each read in its last pass
        for i in range(len(self._layers)):
            self._set_up(i)
        self._prepares = self._can_prepare()
        self._given, self._results = self._ends()
        self._final_values = frozenset(v for v, *_ in (*self._given, *self._results))
        self._hand_on = not all(fresh for *_, fresh in self._results)
        self._no_loss = torch.zeros((), device=net.device)

    # Building

    def _wire(self, i: int) -> None:
        """Make the blobs that layer ``i`` adds (Caffe: AppendBottom, AppendTop)."""
        plan, layer = self.net.plan, self._layers[i]
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
            if "diff" in layer.shares:
                blob.diff_memory = self.blobs[bottoms[0]].diff_memory
        self.bottom_ids.append(bottoms)
        self.top_ids.append(tops)

    def _set_up(self, i: int) -> None:
        """Write the data that Caffe writes when it creates the layer."""
        layer = self._layers[i]
        if isinstance(layer, Python) and layer.code:
            layer.bottom[:], layer.top[:] = self.bottoms[i], self.tops[i]
            layer.code.blobs[:] = self.params[i]
        for top, constant in zip(self.tops[i], self._kept[i], strict=False):
            if constant is not None:
                top.data_memory.put(constant.clone())
        for top, weight in self._losses[i]:
            top.diff_memory.put(torch.full(top.shape, weight, device=self.net.device))

    def _ends(self) -> tuple[list[tuple[int, int]], list[tuple[int, Blob, bool, bool]]]:
        """Return the inputs as pairs of value and blob, and the last value of every other blob.

        The latter also say whether the blob shares memory with another, and whether the value has memory of its own.
        """
        given: list[tuple[int, int]] = []
        results: dict[int, tuple[int, Blob, bool, bool]] = {}
        for node, layer, ids in zip(self.net.plan.nodes, self._layers, self.top_ids, strict=True):
            for v, b in zip(node.tops, ids, strict=False):
                if layer.is_input:
                    given.append((v, b))
                else:
                    results[b] = v, self.blobs[b], "data" in layer.shares, self._is_fresh(layer)
        return given, list(results.values())

    def _is_fresh(self, layer: Layer) -> bool:
        """Return whether the top of a prepared layer has memory of its own, and not a bottom's."""
        speed = self.net.options.speed
        return speed is not None and speed.is_fresh(layer)

    def _is_recorded(self, i: int) -> bool:
        """Return whether autograd records layer ``i``. Other layers' backward passes need only the blobs' memory."""
        layer = self._layers[i]
        from_memory = isinstance(layer, Python) or layer.shares or gradient_reads(layer)
        return self._is_asked(i) and not from_memory

    def _is_asked(self, i: int) -> bool:
        """Return whether a gradient of a bottom or a learnable blob of layer ``i`` is needed."""
        plan = self.net.backward_plan
        return plan.layers[i] and (any(plan.computed[i]) or any(blob.requires_grad for blob in self._layers[i].blobs))

    def _can_bind(self, i: int) -> bool:
        """Return whether layer ``i`` has its own training kernels, so that autograd is not needed."""
        layer, speed = self._layers[i], self.net.options.speed
        return (
            speed is not None
            and self.net.device.type == "cpu"
            and not any(self._is_in_place(i, blob) for blob in self.bottoms[i])
            and all(blob.dtype == torch.float32 and blob.is_contiguous() for blob in layer.blobs)
            and all(layer.blob(j) is blob for j, blob in enumerate(layer.blobs))
            and speed.learns(layer)
        )

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
        written = {id(self.blobs[b].data_memory) for _, b in self._given}
        written |= {id(self.blobs[self.names.index(name)].diff_memory) for name in self.net.outputs}
        memories = {id(each): each for blob in self.blobs for each in (blob.data_memory, blob.diff_memory)}
        fresh = {key: memory for key, memory in memories.items() if key not in written}
        for memory in fresh.values():
            memory.leave_views()
        self._bound = [None] * len(self._layers)  # kernels keep the memory that they compute into
        self.net.forget_trainer()

    def forget(self, kernels: bool) -> None:
        """Forget the recorded runs, so that a later backward pass reads the present blobs. ``kernels``: those too."""
        self._tapes = [None] * len(self._layers)
        if kernels:
            self._bound = [None] * len(self._layers)

    @torch.no_grad()
    def forward(self, start: int, end: int) -> torch.Tensor:
        """Run layers ``start`` to ``end`` (inclusive). Return the weighted sum of their losses, a scalar."""
        self.upload()
        hooked = self.hooks["before_forward"] or self.hooks["after_forward"]
        if self._prepares and (start, end) == (0, len(self._layers) - 1) and not hooked:
            return self._forward_prepared()
        with one_thread() if any(self._has_kernels) else nullcontext():
            loss = walk(self._steps("forward", range(start, end + 1)), {}, self.net.options.exact)
        return self._no_loss if loss is None else loss

    def _steps(self, which: str, numbers: Iterable[int]) -> Iterator[Step]:
        """Yield the forward or backward passes of layers, with the hooks before and after them."""
        run = self._forward if which == "forward" else self._backward
        for i in numbers:
            for hook in self.hooks[f"before_{which}"]:
                yield Step(i, partial(hook, i), (), ())
            losses = tuple((j, weight) for j, (_, weight) in enumerate(self._losses[i])) if which == "forward" else ()
            yield Step(i, partial(run, i), (), (), losses)
            for hook in self.hooks[f"after_{which}"]:
                yield Step(i, partial(hook, i), (), ())

    def _can_prepare(self) -> bool:
        """Return whether a whole pass may run without blobs, because only the final content of each blob matters."""
        return (
            self.net.prepared is not None
            and self.net.device.type == "cpu"
            and not any(self._records)
            and not any(self._keeps)
            and not any(self._kept)
            and not any(isinstance(layer, Python) for layer in self._layers)
            and AUTOMATIC not in self.names
            and not overwrites_shared(self.net.plan.nodes, self.tops)
        )

    def _forward_prepared(self) -> torch.Tensor:
        """Run the whole net with prepared kernels (netspec/fast/prepared.py), and put the results into the blobs."""
        assert self.net.prepared is not None
        given = {v: self.blobs[b].data_memory.tensor(self.blobs[b].shape) for v, b in self._given}
        found = self.net.prepared.run(given, self._final_values)
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
        with one_thread() if any(self._has_kernels) else nullcontext():
            walk(self._steps("backward", range(start, end - 1, -1)), {}, self.net.options.exact)

    def reshape(self) -> None:
        """Give every blob the shape that follows from the shapes of the inputs. Nothing is computed."""
        for i in range(len(self._layers)):
            self._reshape(i)

    def share_with(self, other: BlobRunner) -> None:
        """Use the learnable blobs of another net (Caffe: ShareTrainedLayersWith). Gradients are not shared."""
        other.upload()
        mine = {layer.param.name: layer for layer in reversed(self._layers)}
        for theirs in other._layers:
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
            for blobs in self.params:
                for blob in blobs:
                    for memory in (blob.data_memory, blob.diff_memory):
                        if isinstance(memory, BorrowedMemory):
                            memory.upload()

    def _reshape(self, i: int) -> None:
        layer = self._layers[i]
        if layer.is_input or not self.bottoms[i]:
            return
        if isinstance(layer, Python):
            with importable():
                layer.code.reshape(self.bottoms[i], self.tops[i])
            return
        layer.fit([blob.shape for blob in self.bottoms[i]])
        for top, shape in zip(self.tops[i], layer.top_shapes, strict=True):
            if top.shape != shape:
                top.reshape(*shape)

    def _forward(self, i: int) -> tuple[torch.Tensor, ...]:
        """Run layer ``i``, and return its losses from the memory of its tops."""
        self._compute(i)
        return tuple([top.data_memory.tensor(top.shape) for top, _ in self._losses[i]])

    def _compute(self, i: int) -> None:
        layer, bottoms, tops = self._layers[i], self.bottoms[i], self.tops[i]
        if layer.is_input:
            return
        if isinstance(layer, Python):
            with importable():
                layer.code.reshape(bottoms, tops)
                layer.code.forward(bottoms, tops)
            return
        if layer.shares:
            self._reshape(i)
            return
        if self._records[i]:
            tape = self._tapes[i] = self._record(i)
            values, made = tape.leaves, tape.made
        else:
            values = [blob.data_memory.tensor(blob.shape) for blob in bottoms]
            if self._keeps[i]:
                self._read[i] = values[0].clone()
            made = layer.run(*values)
        kept = self._kept[i] or [None] * len(made)
        taken = storages(values or list(layer.blobs))
        for top, tensor, constant in zip(tops, made, kept, strict=True):
            if constant is None:
                top.put_data(not_shared(tensor.detach(), taken))

    def _record(self, i: int) -> Tape:
        """Run layer ``i`` by its kernels, or with autograd."""
        if bound := self._kernels(i):
            forward, backward = bound.kernels
            values = [blob.data_memory.tensor(blob.shape) for blob in self.bottoms[i]]
            holders = [blob.data_memory.holder(blob.count) for blob in self.bottoms[i]]
            made = forward(*values)
            return Tape(values, holders, (made,) if isinstance(made, torch.Tensor) else made, backward)
        leaves, holders = [], []
        for blob, wanted in zip(self.bottoms[i], self.net.backward_plan.computed[i], strict=True):
            memory = blob.data_memory
            value = memory.tensor(blob.shape)
            overwritten = memory.is_watched() and self._is_in_place(i, blob)
            leaves.append((value.clone() if overwritten else value.detach()).requires_grad_(wanted))
            holders.append(memory.holder(blob.count))
        with torch.enable_grad():
            made = self._layers[i].run(*leaves)
        return Tape(leaves, holders, made, partial(by_autograd, leaves, made))

    def _kernels(self, i: int) -> Bound | None:
        """Return the kernels of layer ``i`` for its present shapes, or None if autograd must record it."""
        layer, bound = self._layers[i], self._bound[i]
        if not self._has_kernels[i]:
            return None
        shapes = [blob.shape for blob in self.bottoms[i]]
        blobs = list(layer.blobs)
        learn = [blob.requires_grad for blob in blobs]
        if bound is None or (bound.shapes, bound.learn) != (shapes, learn) or not bound.seen.are(blobs):
            layer.fit(shapes)
            sums = tuple(gradient_of(blob) if blob.requires_grad else None for blob in layer.blobs)
            wanted = tuple(self.net.backward_plan.computed[i])
            made = self.net.options.speed.kernels(layer, wanted, sums)
            made = made or recorded(layer.run, wanted, list(layer.blobs))
            bound = self._bound[i] = Bound(shapes, learn, Seen(blobs), made)
        return bound

    def _tape(self, i: int) -> Tape:
        """Return the record of the last forward pass of layer ``i``, with the present values of its bottoms.

        If the layer has not run with these shapes, it is run first, without an effect on the net.
        """
        tape, bottoms = self._tapes[i], self.bottoms[i]
        if tape is None or any(leaf.shape != blob.shape for leaf, blob in zip(tape.leaves, bottoms, strict=True)):
            self._layers[i].fit([blob.shape for blob in bottoms])
            with undisturbed(self._layers[i]):
                return self._record(i)
        for leaf, holder, blob in zip(tape.leaves, tape.holders, bottoms, strict=True):
            if self._is_in_place(i, blob) or blob.data_memory.holder(blob.count) is holder:
                continue
            value = blob.data_memory.tensor(blob.shape)
            if value.data_ptr() != leaf.data_ptr():  # else it has the values, and torch refuses to copy some shapes
                leaf.data.copy_(value)
        return tape

    def _is_in_place(self, i: int, blob: Blob) -> bool:
        """Return whether layer ``i`` overwrites a bottom. It has then kept what its gradient needs."""
        return any(top is blob for top in self.tops[i])

    def _backward(self, i: int) -> None:
        if not self.net.backward_plan.layers[i]:
            return
        layer, bottoms, tops = self._layers[i], self.bottoms[i], self.tops[i]
        wanted = self.net.backward_plan.computed[i]
        if isinstance(layer, Python):
            with importable():
                layer.code.backward(tops, list(wanted), bottoms)
            return
        if "diff" in layer.shares:
            return
        diffs = [top.diff_memory.tensor(top.shape) for top in tops]
        if gradient_reads(layer):
            if any(wanted):
                top = tops[0].data_memory.tensor(tops[0].shape)
                values = [top if blob is tops[0] else blob.data_memory.tensor(blob.shape) for blob in bottoms]
                if self._keeps[i] and (read := self._read[i]) is not None and read.shape == values[0].shape:
                    values = [read]
                found = gradients_from_memory(layer, values, top, diffs[0])
                for blob, gradient, asked in zip(bottoms, found, wanted, strict=True):
                    if asked:
                        blob.diff_memory.put(gradient)
            return
        if not self._is_asked(i):
            return
        tape = self._tape(i)
        found = tape.backward(*diffs)
        if not any(wanted):
            return
        taken = storages(diffs)
        found = (found,) if isinstance(found, torch.Tensor) else found
        for blob, leaf, diff, asked in zip(bottoms, tape.leaves, found, wanted, strict=True):
            if asked:
                blob.diff_memory.put(not_shared(torch.zeros_like(leaf) if diff is None else diff, taken))
