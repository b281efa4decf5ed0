"""The processes of a training, started by torchrun. Each is a rank with one net on one device.

Tensors on the CPU are exchanged with gloo, and those on GPUs with NCCL. Every collective call returns: if a process has
ended or does not answer for ``TIMEOUT``, the call raises :class:`Lost`. After a request to end, a process waits only
``GRACE``, since gloo may not notice that another has ended.

Caffe: src/caffe/parallel.cpp
"""

from __future__ import annotations

import os
import pickle
import re
import time
from collections.abc import Callable, Iterable
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import distributed

from netspec.errors import SpecError

TIMEOUT = timedelta(minutes=30)  # a test must take less, since only the root runs it
GRACE = 15.0  # seconds; torchrun kills processes 30 s after its SIGTERM
_LOOK = timedelta(seconds=1)  # how often a waiting process checks for a request to end
_REQUESTS = (None, "snapshot", "stop")  # later ones have priority
T = TypeVar("T")


class Lost(SpecError):
    """Another process has ended, or does not answer."""


class FaultOfAll(SpecError):
    """An error that every process has received, so that only one of them reports it."""


class Processes:
    """This process, number ``rank`` of ``count``; the root is 0. By default there is one.

    ``seed`` is the same in all, for a solver without random_seed; None in a single process. ``is_ending`` says whether
    this process was asked to end.
    """

    def __init__(self, rank: int = 0, count: int = 1, seed: int | None = None) -> None:
        self.rank, self.count, self.seed = rank, count, seed
        self.is_ending: Callable[[], bool] = lambda: False

    @property
    def is_root(self) -> bool:
        """Whether this process tests, logs and takes snapshots."""
        return not self.rank

    def sum(self, tensors: Iterable[torch.Tensor]) -> None:
        """Replace each tensor by its sum over all processes."""
        if self.count > 1:
            self._wait(lambda: [(distributed.all_reduce(tensor, async_op=True), tensor) for tensor in tensors])

    def copy_root(self, tensors: Iterable[torch.Tensor]) -> None:
        """Replace each tensor by the root's."""
        if self.count > 1:
            self._wait(lambda: [(distributed.broadcast(tensor, 0, async_op=True), tensor) for tensor in tensors])

    def gather(self, value: T) -> list[T]:
        """Return the values of all processes, in every process."""
        if self.count == 1:
            return [value]
        own = torch.frombuffer(bytearray(pickle.dumps(value)), dtype=torch.uint8)
        sizes = [size.item() for size in self._all(torch.tensor([own.numel()]))]
        padded = torch.nn.functional.pad(own, (0, int(max(sizes)) - own.numel()))
        found = [row[: int(size)] for row, size in zip(self._all(padded), sizes, strict=True)]
        return [pickle.loads(row.numpy().tobytes()) for row in found]

    def _all(self, own: torch.Tensor) -> list[torch.Tensor]:
        """Return the tensors of all processes, which must have the same shape."""
        found = [torch.empty_like(own) for _ in range(self.count)]
        self._wait(lambda: [(distributed.all_gather(found, own, async_op=True), own)])
        return found

    def agree(self, request: str | None) -> str | None:
        """Return the strongest request of any process: "stop", "snapshot" or None."""
        if self.count == 1:
            return request
        code = torch.tensor(_REQUESTS.index(request))
        self._wait(lambda: [(distributed.all_reduce(code, distributed.ReduceOp.MAX, async_op=True), code)])
        return _REQUESTS[int(code)]

    def together(self, function: Callable[[], T]) -> T:
        """Call a function and return its result; raises FaultOfAll in every process if it raises an error in one."""
        made, fault = None, None
        try:
            made = function()
        except (SpecError, OSError) as found:
            if self.count == 1:
                raise
            fault = str(found)
        for rank, theirs in enumerate(self.gather(fault)):
            if theirs is not None:
                raise FaultOfAll(f"rank {rank}: {theirs}" if rank else theirs)
        return made  # type: ignore[return-value]  # no fault: the function has returned

    def leave(self) -> None:
        """Leave the process group at the end of a training."""
        if distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()

    def _wait(self, begin: Callable[[], list[tuple[Any, torch.Tensor]]]) -> None:
        """Start operations, each with its tensor, and wait for all. Raises Lost."""
        try:
            for work, tensor in begin():
                if tensor.is_cuda:  # NCCL would abort the operation after the first timeout
                    work.wait()
                else:
                    self._look_and_wait(work)
        except Lost:
            raise
        except (RuntimeError, ValueError) as fault:
            raise _lost(f"rank {self.rank} of {self.count}", fault) from None

    def _look_and_wait(self, work: Any) -> None:
        """Wait for an operation of gloo, but no longer than GRACE after a request to end."""
        end = float("inf")
        while True:
            try:
                work.wait(_LOOK)
                return
            except RuntimeError:
                if work.is_completed():
                    raise
            if time.monotonic() > end:
                raise _lost(f"rank {self.rank} of {self.count}", None)
            if self.is_ending():
                end = min(end, time.monotonic() + GRACE)


def join(count: int | None = None, rank: int | None = None, store: str | None = None) -> Processes:
    """Join the processes of this training, wait for all of them, and return this one.

    By default, count, rank and address come from torchrun's environment variables. Raises Lost.
    """
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and distributed.is_nccl_available() else "gloo"
    where: dict[str, Any] = {} if store is None else {"world_size": count, "rank": rank}
    try:
        distributed.init_process_group(backend, store or "env://", timeout=TIMEOUT, **where)
    except (RuntimeError, ValueError) as fault:
        raise _lost("the processes cannot connect to each other", fault) from None
    joined = Processes(distributed.get_rank(), distributed.get_world_size())
    joined.seed = joined.gather(int.from_bytes(os.urandom(4), "little"))[0]
    return joined


def _lost(who: str, fault: Exception | None) -> Lost:
    """Return the error for an operation that failed or timed out."""
    if fault is None:
        return Lost(f"{who}: another process ended, or has not answered for {GRACE:.0f} seconds")
    reason = re.sub(r"^\[\S+\] ", "", str(fault)).partition("\n")[0].partition(". ")[0]
    minutes = TIMEOUT.seconds // 60
    return Lost(f"{who}: another process ended, or has not answered for {minutes} minutes ({reason})")


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process, even if it is the only one."""
    return distributed.is_available() and distributed.is_torchelastic_launched()


def own_device() -> torch.device:
    """Return the GPU of this process: number LOCAL_RANK of its machine. Raises SpecError if there is no such GPU."""
    number, found = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if number >= found:
        message = f"torchrun started process {number} of this machine, but torch finds {found} GPU(s)"
        raise SpecError(f"{message}: give --nproc-per-node {found}, or use solver_mode: CPU")
    return torch.device("cuda", number)
