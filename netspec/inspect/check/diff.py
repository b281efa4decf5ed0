"""Compares the meaning of two nets, two solvers or two weights files. Does not use torch.

A message becomes its settings: a table of the values that are not defaults, in one spelling. Two tables are compared
line by line.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Declared

from netspec import log
from netspec.errors import SpecError, Where, printable
from netspec.files.kinds import HDF5, head_of
from netspec.graph.filter import filter_net, with_state
from netspec.graph.plan import make_plan
from netspec.inspect.net_or_solver import parse_net_or_solver
from netspec.inspect.stored_weights import stored_weights
from netspec.proto.binary import is_net_binary
from netspec.proto.schema import PHASE_NAMES, TEST, TRAIN, Field, NetParameter, fields_of, given
from netspec.proto.source_map import Position
from netspec.proto.writer import scalar_text
from netspec.solver.nets import solver_nets

_NETS = ("net", "net_param", "train_net", "train_net_param", "test_net", "test_net_param", "train_state", "test_state")
_NOT_SETTINGS = ("layer", "layers", "state", "input", "input_shape", "input_dim")
_WIRING = ("name", "bottom", "top", "param", "blobs", "phase", "include", "exclude", "propagate_down", "loss_weight")
#: Fields whose absence has a different meaning than their default.
_PRESENCE_MATTERS = {
    *("caffe.BatchNormParameter.use_global_stats", "caffe.ArgMaxParameter.axis"),
    *("caffe.LossParameter.ignore_label", "caffe.LossParameter.normalization", "caffe.LossParameter.normalize"),
    *("caffe.PReLUParameter.filler", "caffe.ScaleParameter.filler"),
}
#: Fields of windows: the fields for each direction, and the default.
_WINDOWS = {
    "kernel_size": ("kernel_h", "kernel_w", "0"),
    "stride": ("stride_h", "stride_w", "1"),
    "pad": ("pad_h", "pad_w", "0"),
    "dilation": ("", "", "1"),
}
_OLD_NAMES = {"concat_dim": "axis", "slice_dim": "axis"}
_ABSENT = "absent"


@dataclass(frozen=True)
class Difference:
    """One difference, as a line of text, with its positions in the second file and in the other, if it has both."""

    where: Where
    message: str
    other: Where | None = None

    def __str__(self) -> str:
        other = f" ({replace(self.other, layer='', type='')})" if self.other else ""
        return printable(f"{self.where}: {self.message}{other}")


def compare_files(first: str | Path, second: str | Path, tolerance: float = 0.0) -> Iterator[Difference]:
    """Yield the differences between two nets, two solvers or two files of weights.

    ``tolerance`` is for the values of weights. Raises SpecError for files that cannot be read or are of two kinds.
    """
    kinds, read = zip(*map(_read, (first, second)), strict=True)
    if kinds[0] != kinds[1]:
        message = f"is {kinds[1]}, and {first} is {kinds[0]}; expected two files of the same kind"
        raise SpecError(message, Where(str(second)))
    if read[0] is None:
        yield from _compare_weights(first, second, tolerance)
    else:
        yield from (_compare_nets if isinstance(read[0][0], NetParameter) else _compare_solvers)(*read)


def _read(path: str | Path) -> tuple[str, Any]:
    """Return the kind of a file, and for a net or a solver the message and its positions."""
    named = Path(path).suffix in (".caffemodel", ".h5")  # also if damaged; its reader reports the damage
    if Path(path).is_file() and (named or is_net_binary(path) or head_of(path).startswith(HDF5)):
        return "a file of weights", None
    read = parse_net_or_solver(path)
    return "a net" if isinstance(read[0], NetParameter) else "a solver", read


class _Setting(NamedTuple):
    """A value as text, the text that its absence means, and where it is. A text of None equals every text."""

    text: str | None
    default: str
    path: tuple[str | int, ...]


Settings = dict[str, _Setting]


def _settings(message: Any, ignored: Collection[str] = (), at: str = "", path: tuple[str | int, ...] = ()) -> Settings:
    """Return the settings of a message, without the fields ``ignored`` of the outermost one; ``at`` begins each name.

    Spellings with the same meaning are equal: ``kernel_h`` and ``kernel_w`` for ``kernel_size``, one number for several
    equal ones, ``concat_dim`` for ``axis``.
    """
    found: Settings = {}
    done = set(ignored)
    fields, none = fields_of(message.DESCRIPTOR), type(message)()
    for name, (high, wide, default) in _WINDOWS.items() if "kernel_size" in fields else ():
        sides = [each for each in (high, wide) if each and fields[each].present(message)]
        names = [high, wide] if sides else [name] if name in fields and fields[name].present(message) else []
        sizes = " ".join(_text(fields[each], message) for each in names).split() or [default]
        sizes = sizes[:1] * 2 if len(set(sizes)) == 1 else sizes
        found[at + name] = _Setting("x".join(sizes), f"{default}x{default}", (*path, *(sides or names)[:1]))
        done.update((name, high, wide))
    for field in given(message):
        if field.name in done:
            continue
        name, here = at + _OLD_NAMES.get(field.name, field.name), (*path, field.name)
        matters = field.descriptor.full_name in _PRESENCE_MATTERS
        if field.type != Declared.TYPE_MESSAGE:
            found[name] = _Setting(_text(field, message), _ABSENT if matters else _text(field, none), here)
            continue
        values = field.get(message) if field.repeated else [field.get(message)]
        for k, value in enumerate(values):
            found |= _settings(value, (), f"{name}[{k}]." if field.repeated else f"{name}.", (*here, k))
        if field.repeated or matters:
            found[f"number of {name}"] = _Setting(str(len(values)), "0", here)
    return found


def _text(field: Field, message: Any) -> str:
    value = field.get(message)
    return " ".join(scalar_text(field, each) for each in (value if field.repeated else [value])) or _ABSENT


class _Part(NamedTuple):
    """A part of a file that has settings: its place as it is reported, and the positions of its fields."""

    where: Where
    position: Position
    settings: Settings


def _compare_parts(old: dict[str, _Part], new: dict[str, _Part]) -> Iterator[Difference]:
    """Yield the parts that only one file has, and the settings that differ in the others."""
    for mine, others, which in ((old, new, "second"), (new, old, "first")):
        for key in (key for key in mine if key not in others):
            yield Difference(mine[key].where, f"is only here, not in the {which} file")
    for key in (key for key in new if key in old):
        (_, there, was), (where, here, now) = old[key], new[key]
        for name in dict.fromkeys([*now, *was]):
            after, before = now.get(name) or was[name], was.get(name) or now[name]
            texts = [side[name].text if name in side else after.default for side in (now, was)]
            if texts[0] != texts[1] and None not in texts:
                found = replace(here.find(*after.path), layer=where.layer, type=where.type)
                yield Difference(found, f"{name} is {texts[0]}, was {texts[1]}", there.find(*before.path))


def _keys(layers: Sequence[Any]) -> list[str]:
    """Return the name of each layer; a second layer of that name is ``name (2)``."""
    names = [layer.name for layer in layers]
    return [f"{name} ({n + 1})" if (n := names[:k].count(name)) else name for k, name in enumerate(names)]


def _parts(net: Any, source: Any) -> dict[str, _Part]:
    """Return the net itself, with its rules about levels and stages, and its layers in its ``state``."""
    whole = _settings(net, _NOT_SETTINGS)
    for i, (key, layer) in enumerate(zip(_keys(net.layer), net.layer, strict=True)):
        for name in ("include", "exclude"):
            for k, rule in enumerate(getattr(layer, name)):
                whole |= _settings(rule, ("phase",), f'layer "{key}": {name}[{k}].', ("layer", i, name, k))
    found = {"": _Part(source.net.where, source.as_net(), whole)}
    with log.silent():
        net, source = filter_net(net, source)
    plan = make_plan(net, source.reporting_to(lambda fault: None))
    keys = _keys(net.layer)
    makers = {
        v: f'top {j} of layer "{key}"' for key, n in zip(keys, plan.nodes, strict=True) for j, v in enumerate(n.tops)
    }
    for key, layer, node, position in zip(keys, net.layer, plan.nodes, source.layers, strict=True):
        settings = _settings(layer, _WIRING)
        weights = [f"{weight:g}" for weight in layer.loss_weight] or ["1"] * layer.type.endswith("Loss")
        settings["loss_weight"] = _Setting(" ".join(weights) or _ABSENT, _ABSENT, ("loss_weight",))
        for k, blob in enumerate(layer.top):
            settings[f"top {k}"] = _Setting(None if node.in_place[k] else f'"{blob}"', _ABSENT, ("top", k))
        for k, (value, blocked) in enumerate(zip(node.bottoms, node.blocked, strict=True)):
            settings[f"bottom {k}"] = _Setting(makers.get(value, "made by no layer"), _ABSENT, ("bottom", k))
            settings[f"propagate_down {k}"] = _Setting("false" if blocked else "true", "true", ("propagate_down", k))
        for k, param in enumerate(layer.param):
            settings |= _settings(param, ("name",), f"param[{k}].", ("param", k))
        for k, param in enumerate(node.params):
            if param.owner:
                shared = f'blob {param.owner[1]} of layer "{keys[param.owner[0]]}"'
                settings[f"param[{k}]"] = _Setting(shared, "the layer's own", ("param", k))
        found[key] = _Part(replace(position.where, layer=layer.name, type=layer.type), position, settings)
    return found


def _compare_nets(first: tuple[Any, Any], second: tuple[Any, Any]) -> Iterator[Difference]:
    """Yield the differences in phase TRAIN, in phase TEST, or in both."""
    found: dict[str, tuple[Difference, list[str]]] = {}
    for phase in (TRAIN, TEST):
        one, other = ((with_state(net, phase), source) for net, source in (first, second))
        for each in _compare_parts(_parts(*one), _parts(*other)):
            found.setdefault(str(each), (each, []))[1].append(PHASE_NAMES[phase])
    for each, phases in found.values():
        yield each if len(phases) == 2 else replace(each, message=f"in phase {phases[0]} {each.message}")


def _compare_solvers(first: tuple[Any, Position], second: tuple[Any, Position]) -> Iterator[Difference]:
    """Yield the differences between the settings and between the nets. Paths of readable nets are not compared."""
    parts = (_Part(node.where, node, _settings(solver, _NETS)) for solver, node in (first, second))
    yield from _compare_parts(*({"": part} for part in parts))
    old, new = (solver_nets(solver, node) for solver, node in (first, second))
    found: dict[str, Difference] = {}
    for was, now in zip(old, new, strict=False):
        for each in _compare_parts(_parts(was.net, was.source), _parts(now.net, now.source)):
            found.setdefault(str(each), replace(each, message=f"{now.label}: {each.message}"))
    yield from found.values()


def _compare_weights(first: str | Path, second: str | Path, tolerance: float) -> Iterator[Difference]:
    """Yield the layers that only one file has, and the blobs that differ; leading axes of size 1 do not count."""
    old, new = stored_weights(first), stored_weights(second)
    for mine, others, path, which in ((old, new, first, "second"), (new, old, second, "first")):
        for name in (name for name in mine if name not in others):
            yield Difference(Where(str(path), layer=name), f"is only here, not in the {which} file")
    for name in (name for name in new if name in old):
        where = Where(str(second), layer=name)
        if len(new[name]) != len(old[name]):
            yield Difference(where, f"{len(new[name])} blobs, were {len(old[name])}")
        for k, (was, now) in enumerate(zip(old[name], new[name], strict=False)):
            if said := _difference(was, now, tolerance):
                yield Difference(where, f"blob {k}: {said}")


def _difference(was: np.ndarray, now: np.ndarray, tolerance: float) -> str:
    shapes = ["x".join(map(str, array.shape)) or "scalar" for array in (was, now)]
    if np.trim_zeros(np.array(was.shape) - 1, "f").tolist() != np.trim_zeros(np.array(now.shape) - 1, "f").tolist():
        return f"shape is {shapes[1]}, was {shapes[0]}"
    a, b = was.reshape(-1).astype(np.float64), now.reshape(-1).astype(np.float64)
    with np.errstate(invalid="ignore"):
        apart = np.where(
            (a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.nan_to_num(np.abs(a - b), nan=np.inf, posinf=np.inf)
        )
    count = int((apart > tolerance).sum())
    return f"{count} of {a.size} values differ, by {apart.max():.3g} at most" if count else ""
