"""The processes that train one net together, as torchrun starts them: each is a rank with one net on one device.

Tensors of the CPU travel by gloo, those of GPUs by NCCL. Every collective call ends: where a process is gone, or has
not answered for ``TIMEOUT``, it raises :class:`Lost`.

Caffe: src/caffe/parallel.cpp
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import distributed

from netspec.errors import SpecError

TIMEOUT = timedelta(minutes=30)  # a test, which only the root runs, must take less
_REQUESTS = (None, "snapshot", "stop")  # a later one wins
T = TypeVar("T")


class Lost(SpecError):
    """Another process ended, or does not answer."""


class FaultOfAll(SpecError):
    """A fault that every process knows of, so that one of them may tell it."""


class Processes:
    """This process, number ``rank`` of ``count``; the root is 0. By default there is one.

    ``seed`` is the same in all, for a solver without random_seed; None in a single process.
    """

    def __init__(self, rank: int = 0, count: int = 1, seed: int | None = None) -> None:
        self.rank, self.count, self.seed = rank, count, seed

    @property
    def is_root(self) -> bool:
        """Whether this process tests, logs and takes snapshots."""
        return not self.rank

    def sum(self, tensors: Iterable[torch.Tensor]) -> None:
        """Replace each tensor by its sum over all processes."""
        if self.count > 1:
            with self._answered():
                for work in [distributed.all_reduce(tensor, async_op=True) for tensor in tensors]:
                    if work is not None:
                        work.wait()

    def copy_root(self, tensors: Iterable[torch.Tensor]) -> None:
        """Replace each tensor by the root's."""
        if self.count > 1:
            with self._answered():
                for tensor in tensors:
                    distributed.broadcast(tensor, 0)

    def gather(self, value: T) -> list[T]:
        """Return what each process gave, in every process."""
        if self.count == 1:
            return [value]
        found: list[Any] = [None] * self.count
        with self._answered():
            distributed.all_gather_object(found, value)
        return found

    def agree(self, request: str | None) -> str | None:
        """Return the strongest request of any process: "stop", "snapshot" or None."""
        if self.count == 1:
            return request
        code = torch.tensor(_REQUESTS.index(request))
        with self._answered():
            distributed.all_reduce(code, distributed.ReduceOp.MAX)
        return _REQUESTS[int(code)]

    def together(self, function: Callable[[], T]) -> T:
        """Return what a function returns; raises FaultOfAll in every process if it raises a fault in one."""
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
        """Leave the group, at the end of a training."""
        if distributed.is_available() and distributed.is_initialized():
            distributed.destroy_process_group()

    @contextmanager
    def _answered(self) -> Iterator[None]:
        try:
            yield
        except (RuntimeError, ValueError) as fault:
            raise _lost(f"rank {self.rank} of {self.count}", fault) from None


def join(count: int | None = None, rank: int | None = None, store: str | None = None) -> Processes:
    """Join the processes of this training and return this one; waits for all of them.

    By default count, rank and meeting place are those that torchrun gives in the environment. Raises Lost.
    """
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and distributed.is_nccl_available() else "gloo"
    where: dict[str, Any] = {} if store is None else {"world_size": count, "rank": rank}
    try:
        distributed.init_process_group(backend, store or "env://", timeout=TIMEOUT, **where)
    except (RuntimeError, ValueError) as fault:
        raise _lost("the processes do not meet", fault) from None
    joined = Processes(distributed.get_rank(), distributed.get_world_size())
    joined.seed = joined.gather(int.from_bytes(os.urandom(4), "little"))[0]
    return joined


def _lost(who: str, fault: Exception) -> Lost:
    reason = re.sub(r"^\[\S+\] ", "", str(fault)).partition("\n")[0].partition(". ")[0]
    minutes = TIMEOUT.seconds // 60
    return Lost(f"{who}: another process ended, or has not answered for {minutes} minutes ({reason})")


def started_by_torchrun() -> bool:
    """Return whether torchrun started this process, with others or alone."""
    return distributed.is_available() and distributed.is_torchelastic_launched()


def own_device() -> torch.device:
    """Return the GPU of this process: number LOCAL_RANK of its machine. Raises SpecError if there is no such GPU."""
    number, found = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
    if number >= found:
        message = f"torchrun started process {number} of this machine, but torch finds {found} GPU(s)"
        raise SpecError(f"{message}: give --nproc-per-node {found}, or use solver_mode: CPU")
    return torch.device("cuda", number)
