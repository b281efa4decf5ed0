"""The nets that a solver trains and tests, each with its NetState.

Caffe: Solver::InitTrainNet, Solver::InitTestNets (src/caffe/solver.cpp)
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

from netspec import log
from netspec.errors import Report, SpecError, raise_fault
from netspec.files.kinds import nearest_existing
from netspec.graph.filter import filter_net, in_state
from netspec.proto.schema import TEST, TRAIN, NetParameter, NetState, SolverParameter
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.text import parse_net

TRAIN_NET = "train net"
TRAIN_FIELDS = ("net", "net_param", "train_net", "train_net_param")
_GENERIC = ("net_param", "net")  # used for training, and for one test net per remaining test_iter
_Read = tuple[str, NetParameter, SourceMap]


@dataclass(frozen=True)
class SolverNet:
    """A net of a solver with its ``state``. ``origin`` describes its source as in Caffe's log.

    ``lines`` are what Caffe logs when the net is filtered, of a net that is.
    """

    label: str
    origin: str
    net: NetParameter
    source: SourceMap
    lines: Sequence[logging.LogRecord] = ()

    def filtered(self) -> SolverNet:
        """Return the net with only the layers of its state. Raises SpecError."""
        with log.held_back() as lines:
            net, source = filter_net(self.net, self.source)
        return replace(self, net=net, source=source, lines=lines)


def seed_of(seed: int, label: str) -> int:
    """Return the seed of one of a solver's nets. All differ; the training net has the solver's seed."""
    from netspec.data.random_words import derived  # imported here, since reading a solver does not need NumPy

    return seed if label == TRAIN_NET else derived(seed, label)


def solver_nets(param: SolverParameter, node: Position, report: Report = raise_fault) -> list[SolverNet]:
    """Return the training net and the test nets. A file is read once, even if several nets use it.

    The test nets are in Caffe's order: each test_net_param, each test_net, then the general net for every remaining
    test_iter. ``report`` gets a SpecError for each wrong setting and each file that cannot be
    read; these nets are left out. It also gets a ForkFault for each unknown field, which is left out.
    """
    read = _Reader(param, node, report)
    described = []
    names = [name for name in TRAIN_FIELDS if param.HasField(name)]
    expected = f"expected exactly one of {', '.join(TRAIN_FIELDS)}"
    if not names:
        report(SpecError(f"the solver has no net to train, {expected}", node.where))
    if len(names) > 1:
        report(SpecError(f"found {' and '.join(names)}, {expected}", node.find(names[1])))
    found = [read(name) for name in names]
    if len(found) == 1 and found[0]:
        origin, net, source = found[0]
        stated = in_state(net, NetState(phase=TRAIN), net.state, param.train_state)
        described.append(SolverNet(TRAIN_NET, origin, stated, source))
    for i, test in enumerate(_test_nets(param, node, read, report)):
        if test:
            origin, net, source = test
            own = param.test_state[i : i + 1]
            stated = in_state(net, NetState(phase=TEST), net.state, *own)
            described.append(SolverNet(f"test net #{i}", origin, stated, source))
    return described


def _test_nets(param: SolverParameter, node: Position, read: _Reader, report: Report) -> list[_Read | None]:
    found = [read(name, i) for name in ("test_net_param", "test_net") for i in range(len(getattr(param, name)))]
    general = next((name for name in _GENERIC if param.HasField(name)), None)
    missing = len(param.test_iter) - len(found)
    a_net_is_named = any(param.HasField(name) for name in TRAIN_FIELDS)  # otherwise this was already reported
    if missing < 0 or (missing > 0 and general is None and a_net_is_named):
        expected = f"{len(found)}, one for each test_net and test_net_param" + (" (or more)" if general else "")
        report(SpecError(f"found {len(param.test_iter)} test_iter, expected {expected}", node.find("test_iter")))
    if general is not None:
        found += [read(general)] * missing
    if param.test_state and len(param.test_state) != len(found):
        expected = f"expected none or one for each of the {len(found)} test nets"
        report(SpecError(f"found {len(param.test_state)} test_state, {expected}", node.find("test_state")))
    if found and param.test_interval <= 0:
        message = f"found test_interval {param.test_interval}, expected more than 0, since the solver has a test net"
        report(SpecError(message, node.find("test_interval")))
    return found


class _Reader:
    """Reads the net that a field of the solver contains or names: its origin, the net and its map.

    None if it cannot be read, which is reported once.
    """

    def __init__(self, param: SolverParameter, node: Position, report: Report) -> None:
        self._param, self._node, self._report = param, node, report
        self._files: dict[str, tuple[NetParameter, SourceMap] | None] = {}

    def __call__(self, name: str, index: int | None = None) -> _Read | None:
        value = getattr(self._param, name) if index is None else getattr(self._param, name)[index]
        if not isinstance(value, str):
            nodes = self._node.fields.get(name, ())
            known = SourceMap.of(replace(nodes[index or 0], dialects=self._node.dialects)) if nodes else None
            return name, value, known or SourceMap.unknown(self._node.where.file, len(value.layer))
        if value not in self._files:
            try:
                self._files[value] = self._read(name, value, index or 0)
            except SpecError as fault:
                self._files[value] = None
                self._report(fault)
        read = self._files[value]
        return read and (f"{name} file: {value}", *read)

    def _read(self, name: str, path: str, index: int) -> tuple[NetParameter, SourceMap]:
        if not os.path.isfile(path):
            is_folder = os.path.isdir(path)
            found = "is a folder, expected a prototxt" if is_folder else f"is not a file{nearest_existing(path)}"
            raise SpecError(f'{name} "{path}" {found}', self._node.find(name, index))
        return parse_net(path, report=self._report)
