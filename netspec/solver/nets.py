"""Which nets a solver trains and tests, each in its state.

Caffe: Solver::InitTrainNet, Solver::InitTestNets (src/caffe/solver.cpp)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netspec.errors import SpecError
from netspec.graph.filter import merged_state
from netspec.proto.schema import NetParameter, NetState, SolverParameter
from netspec.proto.source_map import Place, SourceMap
from netspec.proto.text import parse_net

TRAIN_FIELDS = ("net", "net_param", "train_net", "train_net_param")
_GENERIC = ("net_param", "net")  # they serve for training and, as often as test_iter says, for testing


@dataclass(frozen=True)
class SolverNet:
    """A net of a solver, not yet filtered: its ``state`` is set. ``origin`` is its source as Caffe words it."""

    label: str
    origin: str
    net: NetParameter
    source: SourceMap


def solver_nets(param: Any, node: Place) -> list[SolverNet]:
    """Return the training net and the test nets. Raises SpecError where the solver does not say clearly which."""
    return [train_net(param, node), *test_nets(param, node)]


def with_train_state(param: Any, level: int | None, stages: Iterable[str]) -> SolverParameter:
    """Return a copy in which the training net has this level (unless None) and these stages besides its own."""
    stated = SolverParameter()
    stated.CopyFrom(param)
    if level is not None:
        stated.train_state.level = level
    stated.train_state.stage.extend(stages)
    return stated


def train_net(param: Any, node: Place) -> SolverNet:
    """Return the net to train: exactly one of the four fields gives it."""
    found = [name for name in TRAIN_FIELDS if param.HasField(name)]
    expected = f"expected exactly one of {', '.join(TRAIN_FIELDS)}"
    if not found:
        raise SpecError(f"the solver names no net to train, {expected}", node.where)
    if len(found) > 1:
        raise SpecError(f"found {' and '.join(found)}, {expected}", node.find(found[1]))
    origin, net, source = _read(param, node, found[0])
    state = merged_state(NetState(phase="TRAIN"), net.state, param.train_state)
    return SolverNet("train net", origin, _in_state(net, state), source)


def test_nets(param: Any, node: Place) -> list[SolverNet]:
    """Return the nets to test, in Caffe's order: each test_net_param, each test_net, then the general net for every
    further test_iter.
    """
    read = [
        _read(param, node, name, i) for name in ("test_net_param", "test_net") for i in range(len(getattr(param, name)))
    ]
    general = next((name for name in _GENERIC if param.HasField(name)), None)
    missing = len(param.test_iter) - len(read)
    if missing < 0 or (missing > 0 and general is None):
        expected = f"{len(read)}, one for each test_net and test_net_param" + (" (or more)" if general else "")
        raise SpecError(f"found {len(param.test_iter)} test_iter, expected {expected}", node.find("test_iter"))
    if general is not None:
        read += [_read(param, node, general)] * missing
    if param.test_state and len(param.test_state) != len(read):
        message = (
            f"found {len(param.test_state)} test_state, expected none or one for each of the {len(read)} test nets"
        )
        raise SpecError(message, node.find("test_state"))
    if read and param.test_interval <= 0:
        message = f"found test_interval {param.test_interval}, expected more than 0, since there is a net to test"
        raise SpecError(message, node.find("test_interval"))
    nets = []
    for i, (origin, net, source) in enumerate(read):
        own = [param.test_state[i]] if param.test_state else []
        state = merged_state(NetState(phase="TEST"), net.state, *own)
        nets.append(SolverNet(f"test net #{i}", origin, _in_state(net, state), source))
    return nets


def _read(param: Any, node: Place, name: str, index: int | None = None) -> tuple[str, NetParameter, SourceMap]:
    """Return where a net came from, the net and its map: the field holds it, or the path of its file."""
    value = getattr(param, name) if index is None else getattr(param, name)[index]
    place = (name,) if index is None else (name, index)
    if isinstance(value, str):
        if not Path(value).is_file():
            message = f'{name} "{value}" is not a file; paths are relative to the working directory'
            raise SpecError(message, node.find(*place))
        return (f"{name} file: {value}", *parse_net(value))
    nodes = node.fields.get(name, ())
    known = SourceMap.of(nodes[index or 0]) if nodes else SourceMap.unknown(node.where.file, len(value.layer))
    return name, value, known


def _in_state(net: NetParameter, state: NetState) -> NetParameter:
    stated = NetParameter()
    stated.CopyFrom(net)
    stated.state.CopyFrom(state)
    return stated
