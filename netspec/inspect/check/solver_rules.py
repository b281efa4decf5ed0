"""The rules for solvers. Their docstrings give the reasons; ``netspec lint --rules`` prints them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

from netspec.inspect.check.findings import SETTINGS, SOLVER, Findings, rule
from netspec.inspect.check.net_rules import own_settings
from netspec.net.net import Net
from netspec.proto.source_map import Position
from netspec.solver.lr_policy import POLICIES
from netspec.solver.update import RULES

TOLERANCE = 0.1  # share of the records that a test may skip or read twice


@rule("no-snapshot", SETTINGS)
def _snapshots(solver: Any, node: Position) -> Findings:
    """Without a snapshot, the trained weights are lost."""
    if solver.snapshot > solver.max_iter:
        message = f"snapshot {solver.snapshot} is more than max_iter {solver.max_iter}, so it has no effect; lower it"
        yield node.find("snapshot"), message
    elif not solver.snapshot and not solver.snapshot_after_train:
        yield node.where, "no snapshot is taken; set snapshot, or snapshot_after_train: true"


@rule("no-effect", SETTINGS)
def _settings(solver: Any, node: Position) -> Findings:
    """A setting that the chosen policy or rule ignores may be meant for another one."""
    for name in settings_without_effect(solver):
        message = f"{name} has no effect with type {solver.type} and lr_policy {solver.lr_policy}; remove it"
        yield node.find(name), message


@rule("step-after-end", SETTINGS)
def _steps(solver: Any, node: Position) -> Findings:
    """A step of the learning rate after the last iteration has no effect."""
    steps = {"step": ("stepsize", [solver.stepsize]), "multistep": ("stepvalue", solver.stepvalue)}
    name, values = steps.get(solver.lr_policy, ("", []))
    for k, value in enumerate(values):
        if value >= solver.max_iter > 0:
            message = f"{name} {value} is not below max_iter {solver.max_iter}, so it never happens; change one of them"
            yield node.find(name, k), message


@rule("test-after-end", SETTINGS)
def _tests(solver: Any, node: Position) -> Findings:
    """If the test interval is longer than the training, tests run only at the start, if at all."""
    if solver.test_iter and solver.test_interval > solver.max_iter:
        message = f"test_interval {solver.test_interval} is more than max_iter {solver.max_iter}; lower it"
        yield node.find("test_interval"), message


@rule("test-size", SOLVER)
def _test_sizes(solver: Any, node: Position, nets: Sequence[Net]) -> Findings:
    """A test should read each record of its data once.

    This rule needs the data (``--data``). It allows a tenth more or less.
    """
    for k, net in enumerate(nets[1:]):
        for layer in net.data_layers:
            if records := layer.num_records:
                batch, iterations = layer.top_shapes[0][0], solver.test_iter[k]
                read = iterations * batch
                if abs(read - records) > TOLERANCE * records:
                    found = f'test_iter {iterations} x batch {batch} = {read}, but layer "{layer.param.name}" has'
                    message = f"{found} {records} records; set test_iter: {-(-records // batch)}"
                    yield node.find("test_iter", k), message
                break


@rule("tested-on-training-data", SOLVER)
def _same_data(solver: Any, node: Position, nets: Sequence[Net]) -> Findings:
    """A test on the training data does not show how good the net is on other data.

    A data layer without a phase is also used in phase TEST, by `netspec test` or `lmdb-build compare`.
    """
    trained = {os.path.realpath(source): layer for _, layer, _, source in _sources(nets[0])} if nets else {}
    for net in nets[1:]:
        for i, layer, field, source in _sources(net):
            if os.path.realpath(source) in trained:
                position = net.plan.source.at(i, field, "source", layer=layer.name, type=layer.type)
                yield position, f'the test reads "{source}", which the net is trained on; use another database'
    if len(nets) == 1 and (solver.net or solver.HasField("net_param")):
        for i, layer, field, source in _sources(nets[0]):
            if not layer.include and not layer.exclude:
                position = nets[0].plan.source.at(i, field, "source", layer=layer.name, type=layer.type)
                message = (
                    f'a test would also read "{source}", which the net is trained on; add a data layer for phase TEST'
                )
                yield position, message


def _sources(net: Net) -> Iterator[tuple[int, Any, str, str]]:
    """Yield number, layer, settings and source of the layers that read a database or a list."""
    for i, layer in enumerate(net.plan.net.layer):
        for name, param in own_settings(layer) if not layer.bottom else ():
            if source := getattr(param, "source", ""):
                yield i, layer, name, source


@rule("filled-by-script", SOLVER)
def _filled_by_script(solver: Any, node: Position, nets: Sequence[Net]) -> Findings:
    """A net with inputs that no layer fills can only be trained by a script; ``netspec train`` refuses it."""
    for net in nets:
        for fault in net.missing_inputs():
            if fault.where:
                yield fault.where, f"{fault.message}, or fill them in a script"


@rule("untrained-in-test", SOLVER)
def _untrained(solver: Any, node: Position, nets: Sequence[Net]) -> Findings:
    """A test net gets its weights from the training net, layer by layer, by name.

    A layer that the training net does not have is tested with random weights.
    """
    trained = {layer.param.name for layer in nets[0].layers if layer.blob_shapes} if nets else set()
    for net in nets[1:]:
        for i, layer in enumerate(net.layers):
            if layer.blob_shapes and layer.param.name not in trained:
                where = net.plan.source.at(i, layer=layer.param.name, type=layer.param.type)
                yield where, "is tested with random weights: the training net has no layer of this name; rename one"


def settings_without_effect(solver: Any) -> Iterator[str]:
    """Yield the names of the settings that the solver's policy and rule do not read."""
    policies = {name: (*policy.needs, *policy.also) for name, policy in POLICIES.items()}
    rules = {name: rule.reads for name, rule in RULES.items()}
    for table, chosen in ((policies, solver.lr_policy), (rules, solver.type)):
        used = (*table.get(chosen, ()), "max_iter")
        for name in dict.fromkeys(name for names in table.values() for name in names):
            given = len(getattr(solver, name)) if name == "stepvalue" else solver.HasField(name)
            if given and name not in used:
                yield name
