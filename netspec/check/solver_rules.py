"""The rules for solvers. Their docstrings say why they are there; ``netspec lint --rules`` prints them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from netspec.check.findings import SETTINGS, SOLVER, Said, rule
from netspec.net.net import Net
from netspec.proto.source_map import Place

FAR = 0.1  # share of the records that a test may skip, or read twice
#: The settings that each rate policy, and each update rule, reads.
POLICY_SETTINGS = {
    "step": ("gamma", "stepsize"),
    "exp": ("gamma",),
    "inv": ("gamma", "power"),
    "multistep": ("gamma", "stepvalue"),
    "poly": ("power",),
    "sigmoid": ("gamma", "stepsize"),
}
RULE_SETTINGS = {
    "adagrad": ("delta",),
    "rmsprop": ("delta", "rms_decay"),
    "adadelta": ("delta",),
    "adam": ("delta", "momentum2"),
}


@rule("no-snapshot", SETTINGS)
def _snapshots(solver: Any, node: Place) -> Said:
    """A training without a snapshot leaves no weights behind."""
    if solver.snapshot > solver.max_iter:
        message = f"snapshot {solver.snapshot} is more than max_iter {solver.max_iter}: no effect; make it smaller"
        yield node.find("snapshot"), message
    elif not solver.snapshot and not solver.snapshot_after_train:
        yield node.where, "no snapshot is taken; set snapshot, or snapshot_after_train: true"


@rule("no-effect", SETTINGS)
def _settings(solver: Any, node: Place) -> Said:
    """A setting that the chosen policy or rule does not read may be meant for another one."""
    for name in settings_without_effect(solver):
        message = f"{name} has no effect with type {solver.type} and lr_policy {solver.lr_policy}; remove it"
        yield node.find(name), message


@rule("step-after-end", SETTINGS)
def _steps(solver: Any, node: Place) -> Said:
    """A step of the learning rate after the last iteration never comes."""
    steps = {"step": ("stepsize", [solver.stepsize]), "multistep": ("stepvalue", solver.stepvalue)}
    name, values = steps.get(solver.lr_policy, ("", []))
    for k, value in enumerate(values):
        if value >= solver.max_iter > 0:
            message = f"{name} {value} is not below max_iter {solver.max_iter}: that step never comes; change either"
            yield node.find(name, k), message


@rule("test-after-end", SETTINGS)
def _tests(solver: Any, node: Place) -> Said:
    """A test that comes after the last iteration is run only at the start, if at all."""
    if solver.test_iter and solver.test_interval > solver.max_iter:
        message = f"test_interval {solver.test_interval} is more than max_iter {solver.max_iter}; make it smaller"
        yield node.find("test_interval"), message


@rule("test-size", SOLVER)
def _test_sizes(solver: Any, node: Place, nets: Sequence[Net]) -> Said:
    """A test should read each record of its data once.

    Known where the data is open (``--data``); a tenth more or less is allowed.
    """
    for k, net in enumerate(nets[1:]):
        for layer in net.layers:
            records = getattr(layer, "num_records", 0)
            if records:
                batch, iterations = layer.top_shapes[0][0], solver.test_iter[k]
                read = iterations * batch
                if abs(read - records) > FAR * records:
                    found = f'test_iter {iterations} x batch {batch} = {read}, but layer "{layer.param.name}" has'
                    message = f"{found} {records} records; set test_iter: {-(-records // batch)}"
                    yield node.find("test_iter", k), message
                break


@rule("untrained-in-test", SOLVER)
def _untrained(solver: Any, node: Place, nets: Sequence[Net]) -> Said:
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
    for table, chosen in ((POLICY_SETTINGS, solver.lr_policy), (RULE_SETTINGS, solver.type.lower())):
        used = table.get(chosen, ())
        for name in dict.fromkeys(name for names in table.values() for name in names):
            given = len(getattr(solver, name)) if name == "stepvalue" else solver.HasField(name)
            if given and name not in used:
                yield name
