"""Upgrades Caffe's nets and solvers from all older formats to the current one, with the positions of their parts.

Each pass takes a net and its map and returns new ones, or the same ones if nothing changes. The passes run in Caffe's
order, for text and for weights. Caffe silently drops some fields (in a net that is partly V0: its V1 layers, its
``state``); here they are kept.

Caffe: src/caffe/util/upgrade_proto.cpp, UpgradeNetAsNeeded, UpgradeSolverAsNeeded, UpgradeSnapshotPrefixProperty
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from google.protobuf.message import Message

from netspec import log
from netspec.errors import SpecError
from netspec.proto.schema import (
    BlobShape,
    LayerParameter,
    NetParameter,
    SolverParameter,
    V1LayerParameter,
    copy_without,
    fields_of,
    given,
)
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.upgrade.rewrite import Draft
from netspec.proto.upgrade.v0 import needs_v0_upgrade, upgrade_v0

Upgraded = tuple[NetParameter, SourceMap]

# V1's name of a type is the current name in capitals, with underscores.
_TYPES = """AbsVal Accuracy ArgMax BNLL Concat ContrastiveLoss Convolution Data Deconvolution Dropout DummyData Eltwise
    EuclideanLoss Exp Flatten HDF5Data HDF5Output HingeLoss Im2col ImageData InfogainLoss InnerProduct LRN MemoryData
    MultinomialLogisticLoss MVN Pooling Power ReLU Sigmoid SigmoidCrossEntropyLoss Silence Slice Softmax Split TanH
    Threshold WindowData"""
_V1_TYPES = {"NONE": "", "SOFTMAXLOSS": "SoftmaxWithLoss", **{name.upper(): name for name in _TYPES.split()}}
# Field of a V1 layer, one value per learnable array -> field of the ParamSpec that now holds them.
_PARAM_SPEC = {"param": "name", "blob_share_mode": "share_mode", "blobs_lr": "lr_mult", "weight_decay": "decay_mult"}

_DATA_PARAMETERS = {"DATA": "data_param", "IMAGE_DATA": "image_data_param", "WINDOW_DATA": "window_data_param"}
_TRANSFORM_FIELDS = ("scale", "mean_file", "crop_size", "mirror")

_SOLVER_TYPES = {name.upper(): name for name in ("SGD", "Nesterov", "AdaGrad", "RMSProp", "AdaDelta", "Adam")}
_SOLVER_NETS = ("net_param", "train_net_param", "test_net_param")


# ---- Nets ----


@dataclass(frozen=True)
class _Pass:
    """A pass, and Caffe's log of it: ``lines`` of upgrade_proto.cpp, and the variable parts of the messages."""

    needed: Callable[[NetParameter], bool]
    run: Callable[[NetParameter, SourceMap], Upgraded]
    lines: tuple[int, ...]
    attempt: str
    success: str
    note: str = ""


def upgrade_net(net: NetParameter, source: SourceMap) -> Upgraded:
    """Return a net in the current format, and its map; log the upgrades as Caffe does.

    Raises SpecError for a net that has both ``layer`` and ``layers``, and for the errors of the passes.
    """
    if len(net.layer) and len(net.layers):
        line = source.net.find("layer").line
        current = f" of line {line}" if line else ""
        raise SpecError(
            f'"layers" is the older format, but the net has "layer"{current} too; write all layers in the current '
            'format, layer { type: "Convolution" ... }',
            source.net.find("layers"),
        )
    for step in _PASSES:
        if step.needed(net):
            log.info(f"upgrade_proto.cpp:{step.lines[0]}", f"Attempting to upgrade {step.attempt}: {source.file}")
            net, source = step.run(net, source)
            log.info(f"upgrade_proto.cpp:{step.lines[1]}", f"Successfully upgraded {step.success}")
            if step.note:
                log.warning(f"upgrade_proto.cpp:{step.lines[2]}", f"Note that future Caffe releases will {step.note}")
    return net, source


def needs_data_upgrade(net: NetParameter) -> bool:
    """Return whether a V1 data layer has transformation fields among its own parameters."""
    return any(_own_transform(layer) for layer in net.layers)


def upgrade_data(net: NetParameter, source: SourceMap) -> Upgraded:
    """Return a V1 net with scale, mean_file, crop_size and mirror of its data layers in their transform_param."""
    if not needs_data_upgrade(net):
        return net, source
    result = copy_without(net, {"layers"})
    positions = []
    for layer, position in zip(net.layers, source.layers, strict=True):
        moved = _own_transform(layer)
        name = _data_parameters(layer)
        draft = Draft(result.layers.add(), position.where)
        draft.copy(layer, position, {name} if moved else ())
        if moved:
            parameters = getattr(layer, name)
            old = (position.fields.get(name) or (Position(position.where),))[0]
            draft.inner(name, old.where).copy(parameters, old, moved)
            transform = draft.inner("transform_param", old.where)
            for field in moved:
                transform.put(field, getattr(parameters, field), old.fields.get(field, ()))
        positions.append(draft.position())
    return result, source.with_layers(positions)


def _data_parameters(layer: V1LayerParameter) -> str:
    return _DATA_PARAMETERS.get(V1LayerParameter.LayerType.Name(layer.type), "")


def _own_transform(layer: V1LayerParameter) -> list[str]:
    name = _data_parameters(layer)
    return [field for field in _TRANSFORM_FIELDS if name and getattr(layer, name).HasField(field)]


def needs_v1_upgrade(net: NetParameter) -> bool:
    """Return whether a net has V1 layers."""
    return len(net.layers) > 0


def upgrade_v1(net: NetParameter, source: SourceMap) -> Upgraded:
    """Return a V1 net with ``layer`` for ``layers``: types by name, and one ParamSpec per learnable array."""
    if not needs_v1_upgrade(net):
        return net, source
    assert not net.layer, "upgrade_net refuses such a net"
    assert not needs_v0_upgrade(net), "upgrade_v0 goes first"
    result = copy_without(net, {"layers"})
    positions = []
    for layer, position in zip(net.layers, source.layers, strict=True):
        draft = Draft(result.layer.add(), position.where)
        draft.copy(layer, position, {"type", *_PARAM_SPEC})
        for field in given(layer):
            if field.name == "type":  # Caffe's, or a fork's own ones
                old = field.descriptor.enum_type.values_by_number[field.get(layer)].name
                name = _V1_TYPES.get(old.replace("_", ""), old.title().replace("_", ""))
                draft.put("type", name, position.fields.get("type", ()))
        _upgrade_param_specs(layer, position, draft)
        positions.append(draft.position())
    return result, source.with_layers(positions)


def _upgrade_param_specs(layer: V1LayerParameter, position: Position, draft: Draft) -> None:
    specs: list[Draft] = []
    for old_name, name in _PARAM_SPEC.items():
        positions = position.fields.get(old_name, ())
        for index, value in enumerate(getattr(layer, old_name)):
            at = positions[index : index + 1]
            if index == len(specs):
                specs.append(Draft(draft.message.param.add(), at[0].where if at else position.where))
            specs[index].put(name, value, at)
    if specs:
        draft.positions["param"] = tuple(spec.position() for spec in specs)


def needs_input_upgrade(net: NetParameter) -> bool:
    """Return whether a net declares inputs with its own fields, without Input layers."""
    return len(net.input) > 0


def upgrade_input(net: NetParameter, source: SourceMap) -> Upgraded:
    """Return a net with an Input layer named "input" before all others, for its ``input`` fields and their shapes.

    Inputs without any shape, as in old weights, are dropped. Raises SpecError if only some have a shape. Extra shapes,
    and input_dim if there is input_shape, are dropped with a warning; Caffe drops them silently.
    """
    if not needs_input_upgrade(net):
        return net, source
    names = ("input", "input_shape", "input_dim")
    result = copy_without(net, {*names, "layer"})
    kept = {name: nodes for name, nodes in source.net.fields.items() if name not in names}
    positions = list(source.layers)
    if len(net.input_shape) or len(net.input_dim):
        inputs = source.net.fields.get("input", ())
        draft = Draft(result.layer.add(name="input", type="Input"), source.net.find("input"))
        draft.put("top", net.input, inputs)
        shapes = draft.inner("input_param", draft.where)
        for index in range(len(net.input)):
            shapes.put("shape", *_input_shape(net, source.net, index))
        positions.insert(0, draft.position())
    for surplus in _surplus(net, source.net):
        log.warning("upgrade_proto.cpp:977", f"{surplus} is not used")
    result.layer.extend(net.layer)
    return result, replace(source, net=replace(source.net, fields=kept), layers=tuple(positions))


def _surplus(net: NetParameter, position: Position) -> list[str]:
    """Return the parts of the input fields that do not fit into the Input layer."""
    if not len(net.input_shape) and not len(net.input_dim):
        where = position.find("input")
        return [f"{where}: input without input_shape or input_dim"] if where.line else []
    inputs, found = len(net.input), []
    if len(net.input_shape) > inputs:
        found.append(f"{position.find('input_shape', inputs)}: input_shape beyond the {inputs} inputs")
    used = 0 if len(net.input_shape) else 4 * inputs
    if len(net.input_dim) > used:
        beyond = f"beyond four each of {inputs} inputs" if used else "together with input_shape"
        found.append(f"{position.find('input_dim', used)}: input_dim {beyond}")
    return found


def _input_shape(net: NetParameter, position: Position, index: int) -> tuple[Message, tuple[Position, ...]]:
    if len(net.input_shape):
        if index >= len(net.input_shape):
            fault = f"found {len(net.input_shape)} input_shape for {len(net.input)} inputs, expected one each"
            raise SpecError(fault, position.find("input", index))
        return net.input_shape[index], position.fields.get("input_shape", ())[index : index + 1]
    values = slice(4 * index, 4 * index + 4)
    if len(net.input_dim[values]) < 4:
        fault = f"found {len(net.input_dim)} input_dim for {len(net.input)} inputs, expected four each"
        raise SpecError(fault, position.find("input", index))
    dims = position.fields.get("input_dim", ())[values]
    return BlobShape(dim=net.input_dim[values]), tuple(Position(d.where, {"dim": dims}) for d in dims[:1])


def needs_batch_norm_upgrade(net: NetParameter) -> bool:
    """Return whether a BatchNorm layer has ParamSpecs that let training change its three arrays."""
    return any(_old_batch_norm(layer) for layer in net.layer)


def upgrade_batch_norm(net: NetParameter, source: SourceMap) -> Upgraded:
    """Return a net whose BatchNorm layers with three ParamSpecs have lr_mult 0 and decay_mult 0; names are kept."""
    if not needs_batch_norm_upgrade(net):
        return net, source
    result = copy_without(net, ())
    for layer in filter(_old_batch_norm, result.layer):
        for param in layer.param:
            param.lr_mult = 0
            param.decay_mult = 0
    return result, source


def _old_batch_norm(layer: LayerParameter) -> bool:
    return (
        layer.type == "BatchNorm"
        and len(layer.param) == 3
        and any(param.lr_mult != 0 or param.decay_mult != 0 for param in layer.param)
    )


_PASSES = (
    _Pass(
        needs_v0_upgrade,
        upgrade_v0,
        (23, 33, 36),
        "input file specified using deprecated V0LayerParameter",
        "file specified using deprecated V0LayerParameter",
        "not support V0NetParameter; netspec upgrade_net_proto_text and upgrade_net_proto_binary write the new format.",
    ),
    _Pass(
        needs_data_upgrade,
        upgrade_data,
        (44, 47, 49),
        "input file specified using deprecated transformation parameters",
        "file specified using deprecated data transformation parameters.",
        "only support transform_param messages for transformation fields.",
    ),
    _Pass(
        needs_v1_upgrade,
        upgrade_v1,
        (53, 61),
        "input file specified using deprecated V1LayerParameter",
        "file specified using deprecated V1LayerParameter",
    ),
    _Pass(
        needs_input_upgrade,
        upgrade_input,
        (67, 70, 72),
        "input file specified using deprecated input fields",
        "file specified using deprecated input fields.",
        "only support input layers and not input fields.",
    ),
    _Pass(
        needs_batch_norm_upgrade,
        upgrade_batch_norm,
        (77, 80),
        "batch norm layers using deprecated params",
        "batch norm layers using deprecated params.",
    ),
)


# ---- Solvers ----


def upgrade_solver(solver: SolverParameter, position: Position) -> tuple[SolverParameter, Position]:
    """Return a solver with ``type`` instead of ``solver_type`` and upgraded nets, and the positions of its parts.

    Raises SpecError if both are given.
    """
    file = position.where.file
    nets = [name for name in _SOLVER_NETS if fields_of(solver.DESCRIPTOR)[name].present(solver)]
    draft = Draft(SolverParameter(), position.where)
    draft.copy(solver, position, {"solver_type", *nets})
    for name in nets:
        value = getattr(solver, name)
        several = list(value) if name == "test_net_param" else [value]
        for index, net in enumerate(several):
            at = position.fields.get(name, ())[index : index + 1]
            source = SourceMap.of(at[0]) if at else SourceMap.unknown(file, len(net.layer) + len(net.layers))
            net, source = upgrade_net(net, source)
            draft.put(name, net, (source.as_net(),) if at else ())
    if solver.HasField("solver_type"):
        if solver.HasField("type"):
            raise SpecError(
                'both "type" and the older "solver_type" are given; keep "type"', position.find("solver_type")
            )
        log.info(
            "upgrade_proto.cpp:1084",
            f"Attempting to upgrade input file specified using deprecated 'solver_type' field (enum)': {file}",
        )
        old = SolverParameter.SolverType.Name(solver.solver_type)
        draft.put("type", _SOLVER_TYPES[old], position.fields.get("solver_type", ()))
        log.info(
            "upgrade_proto.cpp:1091",
            "Successfully upgraded file specified using deprecated 'solver_type' field (enum) to 'type' field "
            "(string).",
        )
        log.warning(
            "upgrade_proto.cpp:1093",
            "Note that future Caffe releases will only support 'type' field (string) for a solver's type.",
        )
    return draft.message, replace(draft.position(), dialects=position.dialects)


def upgrade_snapshot_prefix(solver: SolverParameter, path: str | Path) -> SolverParameter:
    """Return a solver with a snapshot_prefix. If it has none: its file's path without extension; if it is a directory:
    the file's stem in that directory.
    """
    stem = os.path.splitext(str(path))[0]
    result = copy_without(solver, ())
    if not solver.HasField("snapshot_prefix"):
        result.snapshot_prefix = stem
        message = f"snapshot_prefix was not specified and is set to {result.snapshot_prefix}"
        log.info("upgrade_proto.cpp:1108", message)
    elif os.path.isdir(solver.snapshot_prefix):
        result.snapshot_prefix = os.path.join(solver.snapshot_prefix, os.path.basename(stem))
        log.info(
            "upgrade_proto.cpp:1113", f"snapshot_prefix was a directory and is replaced to {result.snapshot_prefix}"
        )
    return result
