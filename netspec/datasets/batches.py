"""The batches of a net's data layer."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import torch
from torch.utils.data import Dataset
from typing_extensions import override

from netspec.datasets.opened import Opened, PerProcess
from netspec.errors import SpecError, Where, did_you_mean
from netspec.graph.filter import filter_net, with_state
from netspec.graph.options import BuildOptions
from netspec.layers import layer_class
from netspec.layers.contract.context import Context
from netspec.layers.data.files import ReadingLayer
from netspec.proto.schema import PHASE_NAMES, PhaseValue, phase_of
from netspec.proto.text import parse_net

_State = tuple[PhaseValue, int, tuple[str, ...]]  # phase, level, stages


class Batches(Dataset[dict[str, torch.Tensor]]):
    """What a data layer of a net reads: item i is the batch of iteration i, blob -> float32 tensor (N, ...).

    ``model`` is a prototxt; of several data layers in its ``phase``, ``layer`` names the one. There are ``iterations``
    items, by default as many as read each record once; the last batch then goes on with the first records, as in Caffe.
    With a solver's ``random_seed`` as ``seed`` the batches are those of its training. Of ``ranks`` nets that train side
    by side this is number ``rank``. Give it to a DataLoader with ``batch_size=None``, and to go on at iteration k with
    ``sampler=range(k, end)``. Raises SpecError for faults of the files.
    """

    def __init__(
        self,
        model: str | Path,
        phase: str = "TRAIN",
        *,
        layer: str = "",
        level: int = 0,
        stages: Iterable[str] = (),
        iterations: int | None = None,
        seed: int = 0,
        rank: int = 0,
        ranks: int = 1,
    ) -> None:
        state = (phase_of(phase), level, tuple(stages))
        self._opened = PerProcess(partial(_open, str(model), state, layer, seed, rank, ranks))
        cursor = self._opened()[0].cursor
        self._iterations = iterations or -(-cursor.count // (cursor.batch_size * ranks))

    def __len__(self) -> int:
        return self._iterations

    @override
    def __getitem__(self, iteration: int) -> dict[str, torch.Tensor]:
        if not 0 <= iteration < self._iterations:
            raise IndexError(f"found iteration {iteration}, expected 0 to {self._iterations - 1}")
        source, tops = self._opened()
        return {top: torch.from_numpy(array) for top, array in zip(tops, source.batch(iteration), strict=False)}

    def keys(self, iteration: int) -> list[str]:
        """Return the keys (or file names) of the records of an iteration."""
        return self._opened()[0].keys(iteration)


def _open(model: str, state: _State, name: str, seed: int, rank: int, ranks: int) -> Opened:
    phase, level, stages = state
    net, source = parse_net(model)
    net, source = filter_net(with_state(net, phase, level, stages), source)
    readers = {}
    for index, param in enumerate(net.layer):
        cls = layer_class(param.type)
        if cls is not None and issubclass(cls, ReadingLayer):
            readers[param.name] = index, cls
    chosen = name or next(iter(readers), "")
    if chosen not in readers:
        known = ", ".join(readers) or "none"
        hint = did_you_mean(name, list(readers)) if name else ""
        message = f'no data layer "{name}"' if name else "no layer reads records"
        raise SpecError(f"{message} in phase {PHASE_NAMES[phase]}{hint or ';'} its data layers: {known}", Where(model))
    index, cls = readers[chosen]
    param = net.layer[index]
    param.phase = phase
    at = partial(source.at, index, layer=param.name, type=param.type)
    context = Context(phase, BuildOptions(data_seed=seed, rank=rank, ranks=ranks), at=at)
    return cls(param, [], context).source, tuple(param.top)
