"""The layers of a net in a phase, level and set of stages (Caffe: Net::FilterNet, src/caffe/net.cpp)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from netspec import log
from netspec.errors import SpecError, several
from netspec.proto.schema import (
    PHASE_NAMES,
    LayerParameter,
    NetParameter,
    NetState,
    NetStateRule,
    PhaseValue,
    SolverParameter,
    copy_without,
)
from netspec.proto.source_map import SourceMap


def in_state(net: NetParameter, *states: NetState) -> NetParameter:
    """Return a copy of the net with the combined ``states``: later ones override earlier ones, and stages are added."""
    stated = NetParameter()
    stated.CopyFrom(net)
    stated.ClearField("state")
    for state in states:
        stated.state.MergeFrom(state)
    return stated


def with_state(
    net: NetParameter, phase: PhaseValue, level: int | None = None, stages: Iterable[str] = ()
) -> NetParameter:
    """Return a copy of the net with this phase, this level (unless None) and these additional stages in its state."""
    return in_state(net, net.state, NetState(phase=phase, level=level, stage=several(stages)))


def with_train_state(solver: SolverParameter, level: int | None, stages: Iterable[str]) -> SolverParameter:
    """Return a copy of the solver whose training net has this level (unless None) and these additional stages."""
    stated = SolverParameter()
    stated.CopyFrom(solver)
    stated.train_state.MergeFrom(NetState(level=level, stage=several(stages)))
    return stated


def filter_net(net: NetParameter, source: SourceMap) -> tuple[NetParameter, SourceMap]:
    """Return the net with only the layers that its ``state`` includes."""
    kept, left_out = list[int](), dict[str, tuple[str, str]]()
    for index, layer in enumerate(net.layer):
        if layer.include and layer.exclude:
            where = source.at(index, "exclude", layer=layer.name, type=layer.type)
            source.report(
                SpecError("found both include and exclude rules, expected only one kind; remove the other", where)
            )
        if _included(net.state, layer):
            kept.append(index)
        else:
            line = source.layers[index].where.line
            maker = f'layer "{layer.name}"{f" of line {line}" if line else ""}'
            left_out.update(dict.fromkeys(layer.top, (maker, _remedy(net.state, layer))))
    filtered = copy_without(net, {"layer"})
    filtered.layer.extend(net.layer[index] for index in kept)
    return filtered, replace(source.with_layers(source.layers[index] for index in kept), left_out=left_out)


def _remedy(state: NetState, layer: LayerParameter) -> str:
    """Return advice for a layer that is missing because the state of the net excludes it."""
    here, there = PHASE_NAMES[state.phase], PHASE_NAMES[1 - state.phase]
    if any(rule.HasField("phase") and rule.phase != state.phase for rule in layer.include):
        return f"in phase {there}; use --phase {there}, or add such a layer for phase {here}"
    return "in another stage or level; see --stage and --level"


def _included(state: NetState, layer: LayerParameter) -> bool:
    if layer.include:
        return any(_meets(state, rule, layer.name) for rule in layer.include)
    return not any(_meets(state, rule, layer.name) for rule in layer.exclude)


def _meets(state: NetState, rule: NetStateRule, name: str) -> bool:
    ending = f"specified by a rule in layer {name}"
    if rule.HasField("phase") and rule.phase != state.phase:
        log.info("net.cpp:296", f"The NetState phase ({state.phase}) differed from the phase ({rule.phase}) {ending}")
        return False
    if rule.HasField("min_level") and state.level < rule.min_level:
        log.info(
            "net.cpp:305", f"The NetState level ({state.level}) is below the min_level ({rule.min_level}) {ending}"
        )
        return False
    if rule.HasField("max_level") and state.level > rule.max_level:
        log.info(
            "net.cpp:314", f"The NetState level ({state.level}) is above the max_level ({rule.max_level}) {ending}"
        )
        return False
    for stage in rule.stage:
        if stage not in state.stage:
            log.info("net.cpp:328", f"The NetState did not contain stage '{stage}' {ending}")
            return False
    for stage in rule.not_stage:
        if stage in state.stage:
            log.info("net.cpp:342", f"The NetState contained a not_stage '{stage}' {ending}")
            return False
    return True
