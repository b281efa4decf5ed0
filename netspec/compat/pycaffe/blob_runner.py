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
from netspec.compat.pycaffe.steps import LayerStep, PythonStep
from netspec.compat.pycaffe.tapes import BorrowedMemory, not_shared, storages
from netspec.exact.blas import one_thread
from netspec.graph.plan import AUTOMATIC
from netspec.layers.utility.live_blobs import Blob
from netspec.layers.utility.python import Python
from netspec.layers.utility.shape import Flatten
from netspec.net.net import Net
from netspec.run.walk import Step, walk

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
        self._in_one_thread = any(step.has_kernels for step in self.steps)
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
        for step in self.steps:
            step.forget_kernels()  # they keep the memory that they compute into
        self.net.forget_trainer()

    def forget(self, kernels: bool) -> None:
        """Forget the recorded runs, so that a later backward pass reads the present blobs. ``kernels``: those too."""
        for step in self.steps:
            step.forget_run()
            if kernels:
                step.forget_kernels()

    @torch.no_grad()
    def forward(self, start: int, end: int) -> torch.Tensor:
        """Run layers ``start`` to ``end`` (inclusive). Return the weighted sum of their losses, a scalar."""
        self.upload()
        hooked = self.hooks["before_forward"] or self.hooks["after_forward"]
        with self.net.positions:
            if self._prepares and (start, end) == (0, len(self.steps) - 1) and not hooked:
                return self._forward_prepared()
            with one_thread() if self._in_one_thread else nullcontext():
                loss = walk(self._passes("forward", range(start, end + 1)), {}, self.net.options.exact)
        return self._no_loss if loss is None else loss

    def _passes(self, which: str, numbers: Iterable[int]) -> Iterator[Step]:
        """Yield the forward or backward passes of layers, with the hooks before and after them."""
        for i in numbers:
            step = self.steps[i]
            run = step.forward if which == "forward" else step.backward
            for hook in self.hooks[f"before_{which}"]:
                yield Step(i, partial(hook, i), (), ())
            losses = tuple((j, weight) for j, (_, weight) in enumerate(step.losses)) if which == "forward" else ()
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
        with one_thread() if self._in_one_thread else nullcontext():
            walk(self._passes("backward", range(start, end - 1, -1)), {}, self.net.options.exact)

    def reshape(self) -> None:
        """Give every blob the shape that follows from the shapes of the inputs. Nothing is computed."""
        for step in self.steps:
            step.reshape()

    def share_with(self, other: BlobRunner) -> None:
        """Use the learnable blobs of another net (Caffe: ShareTrainedLayersWith). Gradients are not shared."""
        other.upload()
        mine = {layer.param.name: layer for layer in reversed(self.net.layers)}
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
