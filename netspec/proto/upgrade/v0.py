"""Upgrades layers of 2013 to those of 2014: ``layers { layer { type: "conv" } }`` to ``layers { type: CONVOLUTION }``.

Caffe: src/caffe/util/upgrade_proto.cpp, UpgradeV0Net, UpgradeV0PaddingLayers, UpgradeV0LayerParameter
"""

from __future__ import annotations

from dataclasses import replace

from netspec import log
from netspec.errors import SpecError, did_you_mean
from netspec.proto.schema import NetParameter, V0LayerParameter, V1LayerParameter, copy_without, fields_of
from netspec.proto.source_map import Position, SourceMap
from netspec.proto.upgrade.rewrite import Draft

# V0's names of types are mostly V1's in lower case; a type's own parameters are named after V1's.
_SAME = """accuracy bnll concat data dropout euclidean_loss flatten hdf5_data hdf5_output im2col infogain_loss lrn
    multinomial_logistic_loss relu sigmoid softmax softmax_loss split tanh window_data"""
_RENAMED = {"conv": "CONVOLUTION", "images": "IMAGE_DATA", "innerproduct": "INNER_PRODUCT", "pool": "POOLING"}
_TYPES = _RENAMED | {name: name.upper() for name in _SAME.split()}

# V0 field -> its name in the parameters of each layer type.
_FIELDS = {
    "num_output": ("num_output", {"conv", "innerproduct"}),
    "biasterm": ("bias_term", {"conv", "innerproduct"}),
    "weight_filler": ("weight_filler", {"conv", "innerproduct"}),
    "bias_filler": ("bias_filler", {"conv", "innerproduct"}),
    "pad": ("pad", {"conv", "pool"}),
    "kernelsize": ("kernel_size", {"conv", "pool"}),
    "group": ("group", {"conv"}),
    "stride": ("stride", {"conv", "pool"}),
    "pool": ("pool", {"pool"}),
    "dropout_ratio": ("dropout_ratio", {"dropout"}),
    "local_size": ("local_size", {"lrn"}),
    "alpha": ("alpha", {"lrn"}),
    "beta": ("beta", {"lrn"}),
    "k": ("k", {"lrn"}),
    "source": ("source", {"data", "hdf5_data", "images", "window_data", "infogain_loss"}),
    "batchsize": ("batch_size", {"data", "hdf5_data", "images", "window_data"}),
    "rand_skip": ("rand_skip", {"data", "images"}),
    "shuffle_images": ("shuffle", {"images"}),
    "new_height": ("new_height", {"images"}),
    "new_width": ("new_width", {"images"}),
    "concat_dim": ("concat_dim", {"concat"}),
    "det_fg_threshold": ("fg_threshold", {"window_data"}),
    "det_bg_threshold": ("bg_threshold", {"window_data"}),
    "det_fg_fraction": ("fg_fraction", {"window_data"}),
    "det_context_pad": ("context_pad", {"window_data"}),
    "det_crop_mode": ("crop_mode", {"window_data"}),
}
_TRANSFORMS = {"scale": "scale", "meanfile": "mean_file", "cropsize": "crop_size", "mirror": "mirror"}
_UNCHANGED = ("name", "blobs", "blobs_lr", "weight_decay")


def needs_v0_upgrade(net: NetParameter) -> bool:
    """Return whether a net has a V0 layer."""
    return any(layer.HasField("layer") for layer in net.layers)


def upgrade_v0(net: NetParameter, source: SourceMap) -> tuple[NetParameter, SourceMap]:
    """Return a net with its V0 layers as V1 layers, padding layers merged into the layers they feed.

    Raises SpecError for an unknown layer type and for a padding layer that cannot be merged. A field that the layer
    type does not have is dropped with a warning, as in Caffe.
    """
    if not needs_v0_upgrade(net):
        return net, source
    net, source = merge_padding(net, source)
    result = copy_without(net, {"layers"})
    positions = []
    for layer, position in zip(net.layers, source.layers, strict=True):
        draft = Draft(result.layers.add(), position.where)
        draft.copy(layer, position, {"layer"})
        if layer.HasField("layer"):
            _upgrade_layer(layer.layer, _inner(position), draft)
        positions.append(draft.position())
    return result, source.with_layers(positions)


def merge_padding(net: NetParameter, source: SourceMap) -> tuple[NetParameter, SourceMap]:
    """Return a V0 net without its padding layers: the convolution or pooling after each one gets its padding.

    Raises SpecError if a padding layer feeds any other layer, or does not have one bottom and one top.
    """
    result = copy_without(net, {"layers"})
    positions: list[Position] = []
    producers: dict[str, tuple[V1LayerParameter, Position] | None] = dict.fromkeys(net.input)
    for layer, position in zip(net.layers, source.layers, strict=True):
        if layer.layer.type == "padding":
            for what in ("bottom", "top"):
                if len(getattr(layer, what)) != 1:
                    raise _error(
                        f"a padding layer must have one {what}, found {len(getattr(layer, what))}",
                        layer,
                        position,
                        what,
                    )
        else:
            draft = Draft(result.layers.add(), position.where)
            draft.copy(layer, position)
            for index, bottom in enumerate(layer.bottom):
                if bottom not in producers:
                    known = did_you_mean(bottom, list(producers))
                    raise _error(f'unknown bottom blob "{bottom}"{known}', layer, position, "bottom", index)
                producer = producers[bottom]
                if producer is not None and producer[0].layer.type == "padding":
                    _merge(producer, layer, position, draft)
            positions.append(draft.position())
        producers |= dict.fromkeys(layer.top, (layer, position))
    return result, source.with_layers(positions)


def _merge(
    producer: tuple[V1LayerParameter, Position], layer: V1LayerParameter, position: Position, draft: Draft
) -> None:
    padding, padding_position = producer
    if layer.layer.type not in ("conv", "pool") or len(layer.bottom) != 1:
        fault = f'padding layer "{padding.layer.name}" feeds it; only a conv or pool with one bottom can be padded'
        raise _error(fault, layer, position, "bottom")
    draft.message.ClearField("bottom")
    draft.positions.pop("bottom", None)
    draft.put("bottom", padding.bottom, padding_position.fields.get("bottom", ()))
    inner = draft.inner("layer", position.where)
    inner.put("pad", padding.layer.pad, _inner(padding_position).fields.get("pad", ()))


def _upgrade_layer(old: V0LayerParameter, position: Position, draft: Draft) -> None:
    """Copy the fields of a V0LayerParameter into the draft of a V1 layer."""
    draft.copy(old, position, {n for n in fields_of(old.DESCRIPTOR) if n not in _UNCHANGED})
    if old.HasField("type"):
        if old.type not in _TYPES:
            where = replace(position.find("type"), layer=old.name)
            raise SpecError(f'unknown V0 layer type "{old.type}"{did_you_mean(old.type, list(_TYPES))}', where)
        draft.put("type", V1LayerParameter.LayerType.Value(_TYPES[old.type]), position.fields.get("type", ()))
    for name, field in fields_of(old.DESCRIPTOR).items():
        if name in _UNCHANGED or name == "type" or not field.present(old):
            continue
        value, positions = field.get(old), position.fields.get(name, ())
        new_name, types = _FIELDS.get(name, ("", ()))
        if name in _TRANSFORMS:
            draft.inner("transform_param", position.where).put(_TRANSFORMS[name], value, positions)
        elif old.type in types:
            draft.inner(f"{_TYPES[old.type].lower()}_param", position.where).put(new_name, value, positions)
        elif name == "hdf5_output_param" and old.type == "hdf5_output":
            draft.put(name, value, positions)
        else:
            where = position.find(name)
            log.warning("upgrade_proto.cpp:230", f"{where}: Unknown parameter {name} for layer type {old.type}")


def _inner(position: Position) -> Position:
    """Return the positions of the V0 part of a layer, or of the layer itself if they are unknown."""
    inner = position.fields.get("layer", ())
    return inner[0] if inner else Position(position.where)


def _error(message: str, layer: V1LayerParameter, position: Position, *path: str | int) -> SpecError:
    return SpecError(message, replace(position.find(*path), layer=layer.layer.name, type=layer.layer.type))
