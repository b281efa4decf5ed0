"""Nets written in Python: a call such as ``L.Convolution(bottom, num_output=20)`` makes a layer and returns its tops.

    n = NetSpec()
    n.data = L.Input(shape=dict(dim=[1, 3, 224, 224]))
    n.conv1 = L.Convolution(n.data, kernel_size=3, num_output=20, weight_filler=dict(type="xavier"))
    n.relu1 = L.ReLU(n.conv1, in_place=True)
    n.to_proto()  # a caffe_pb2.NetParameter; str() of it is a prototxt

Caffe: python/caffe/net_spec.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any

from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.errors import did_you_mean
from netspec.proto.forks import forks

Name = Callable[["Top | Function"], str]


class Top:
    """One blob that a layer writes: top number ``n`` of the layer ``fn``."""

    def __init__(self, fn: Function, n: int) -> None:
        self.fn = fn
        self.n = n

    def to_proto(self) -> Any:
        """Return the net of all layers that this blob needs, named after their types."""
        return to_proto(self)


class Function:
    """A layer: its type, the tops that it reads, and its parameters.

    ``ntop`` is the number of its tops, by default 1. With ``in_place=True`` its tops have the names of its bottoms. The
    other parameters are fields of the message for its type (such as ``num_output`` in ``convolution_param``), or of
    LayerParameter. Raises TypeError for an input that is not a Top.
    """

    def __init__(self, type_name: str, inputs: Iterable[Any], params: Mapping[str, Any]) -> None:
        self.type_name = type_name
        self.inputs = tuple(inputs)
        for number, given in enumerate(self.inputs):
            if not isinstance(given, Top):
                raise TypeError(f"{type_name} input {number} is not a Top (type is {type(given)})")
        self.params = dict(params)
        self.ntop: int = self.params.pop("ntop", 1)
        self.in_place: bool = self.params.pop("in_place", False)
        self.tops = tuple(Top(self, n) for n in range(self.ntop))

    def to_layer(self, bottoms: Iterable[str], name_of: Name) -> Any:
        """Return the LayerParameter; ``name_of`` returns the names of tops, and of layers without a name."""
        layer = caffe_pb2.LayerParameter(type=self.type_name, bottom=bottoms)
        layer.top.extend(layer.bottom if self.in_place else [name_of(top) for top in self.tops])
        layer.name = name_of(self.tops[0] if self.tops else self)
        own = _own_message(layer, self.type_name)
        own_fields = layer.DESCRIPTOR.fields_by_name[own].message_type.fields_by_name if own else ()
        for name, value in self.params.items():
            # As in Caffe, a field that exists in both goes to the layer's own message, unless it is a message itself.
            in_layer = name in layer.DESCRIPTOR.fields_by_name
            if name in own_fields and not (in_layer and name.endswith("param")):
                assign_proto(getattr(layer, own), name, value)
            elif in_layer:
                assign_proto(layer, name, value)
            else:
                raise AttributeError(self._unknown(layer, own, name))
        return layer

    def _unknown(self, layer: Any, own: str, name: str) -> str:
        messages = [layer.DESCRIPTOR]
        if own:
            messages.append(layer.DESCRIPTOR.fields_by_name[own].message_type)
        owners = f"{own} and LayerParameter have" if own else "LayerParameter has"
        known = forks().additions()
        with_field = {d for message in messages for d in known.fields.get((message.full_name, name), ())}
        with_type = known.types.get(self.type_name, ())
        advice = known.advise(name, tuple(sorted(with_field))) or known.advise(self.type_name, with_type)
        fields = [field for message in messages for field in message.fields_by_name]
        hint = f"; {advice}" if advice else did_you_mean(name, fields)
        return f'layer of type "{self.type_name}": {owners} no field "{name}"{hint}'


def to_proto(*tops: Top) -> Any:
    """Return the net of all layers that the tops need, named after their types: ``Convolution1``."""
    return _net(tops, {})


class NetSpec:
    """A net. Blobs and layers are named after the attribute or key that they are assigned to."""

    tops: dict[str, Any]

    def __init__(self) -> None:
        super().__setattr__("tops", {})

    def __setattr__(self, name: str, value: Any) -> None:
        self.tops[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # attributes that copy and pickle look for
            raise AttributeError(name)
        if name not in self.tops:
            raise _NoSuchTop(f"the net has no top {name!r}{did_you_mean(name, list(self.tops))}")
        return self.tops[name]

    def __delattr__(self, name: str) -> None:
        del self.tops[name]

    __setitem__ = __setattr__
    __getitem__ = __getattr__
    __delitem__ = __delattr__

    def keys(self) -> list[str]:
        """Return the assigned names, as in SSD."""
        return list(self.tops)

    def vals(self) -> list[Any]:
        """Return the assigned values, as in SSD."""
        return list(self.tops.values())

    def update(self, name: str, params: Mapping[str, Any]) -> None:
        """Change parameters of the layer of a top, as in SSD."""
        _function(self[name]).params.update(params)

    def to_proto(self) -> Any:
        """Return the net of all layers that the assigned tops need."""
        return _net(self.tops.values(), {top: name for name, top in self.tops.items()})


class _NoSuchTop(AttributeError, KeyError):
    """Caffe raises KeyError; ``hasattr`` needs AttributeError."""

    __str__ = Exception.__str__


def _net(wanted: Iterable[Top | Function], names: dict[Any, str]) -> Any:
    """Return the net of the layers that some tops need, each layer after those that it reads from."""
    autonames: Counter[str] = Counter()
    layers: dict[Function, Any] = {}

    def name_of(item: Top | Function) -> str:
        if item not in names:
            type_name = (item.fn if isinstance(item, Top) else item).type_name
            autonames[type_name] += 1
            names[item] = f"{type_name}{autonames[type_name]}"
        return names[item]

    for item in wanted:
        pending = [_function(item)]
        while pending:
            fn = pending[-1]
            missing = [top.fn for top in fn.inputs if top.fn not in layers]
            if fn in layers or not missing:
                pending.pop()
                if fn not in layers:
                    layers[fn] = fn.to_layer([layers[top.fn].top[top.n] for top in fn.inputs], name_of)
            else:
                pending.append(missing[0])
    return caffe_pb2.NetParameter(layer=layers.values())


def _function(item: Any) -> Function:
    if isinstance(item, Top):
        return item.fn
    if isinstance(item, Function):
        return item
    raise TypeError(
        f"expected a Top, or a layer without tops, found {type(item)}; a layer with ntop=2 gives a tuple of tops"
    )


def assign_proto(proto: Any, name: str, value: Any) -> None:
    """Set a field: a dict fills a message, a list a repeated field; a single value becomes a list of one.

    Raises AttributeError for an unknown field, TypeError or ValueError for a value of the wrong type.
    """
    field = getattr(proto, name)
    repeated = hasattr(field, "extend")
    if repeated and not isinstance(value, (list, tuple)):
        value = [value]
    if repeated:
        for item in value:
            if isinstance(item, dict):
                _fill(field.add(), item)
            else:
                field.extend([item])
    elif isinstance(value, dict):
        _fill(field, value)
    elif hasattr(field, "CopyFrom"):
        field.CopyFrom(value)
    else:
        setattr(proto, name, value)


def _fill(message: Any, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        assign_proto(message, name, value)


def param_name_dict() -> dict[str, str]:
    """Return, for each layer type, the field of LayerParameter with its parameters: ``{"Pooling": "pooling", ...}``.

    The ending "_param" is removed.
    """
    return _param_names(caffe_pb2.LayerParameter.DESCRIPTOR)


@cache
def _param_names(layer: Any) -> dict[str, str]:
    return {
        field.message_type.name.removesuffix("Parameter"): field.name.removesuffix("_param")
        for field in layer.fields
        if field.name.endswith("_param")
    }


def _own_message(layer: Any, type_name: str) -> str:
    names = _param_names(layer.DESCRIPTOR)
    return f"{names[type_name]}_param" if type_name in names else ""


class Layers:
    """``L``: ``L.Type(*bottoms, **params)`` returns the layer's top or tuple of tops, or the layer if it has none."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def layer(*bottoms: Any, **params: Any) -> Any:
            made = Function(name, bottoms, params)
            if made.ntop == 0:
                return made
            return made.tops[0] if made.ntop == 1 else made.tops

        return layer


class Parameters:
    """``P``: ``P.Pooling.MAX`` is the enum value MAX of PoolingParameter."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(caffe_pb2, f"{name}Parameter")


layers = Layers()
params = Parameters()
