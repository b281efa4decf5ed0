"""Nets as pictures: a graph of layers and blobs, drawn by Graphviz.

Needs pydot (the extra ``pycaffe``); PDF and some other formats need Graphviz' program ``dot``.
Caffe: python/caffe/draw.py
"""

from __future__ import annotations

from typing import Any

from netspec.compat.pycaffe import errors
from netspec.compat.pycaffe.proto import caffe_pb2
from netspec.files.whole_file import write_whole

NEURON_LAYER_STYLE = {"shape": "record", "fillcolor": "#90EE90", "style": "filled"}
LAYER_STYLE_DEFAULT = {"shape": "record", "fillcolor": "#6495ED", "style": "filled"}
BLOB_STYLE = {"shape": "octagon", "fillcolor": "#E0E0E0", "style": "filled"}
_COLORS = {
    **dict.fromkeys(("Convolution", "Deconvolution"), "#FF5050"),
    "Pooling": "#FF9900",
    "InnerProduct": "#CC33FF",
}
_LEARNED = ("Convolution", "Deconvolution", "InnerProduct")
_TEXT_FORMATS = ("raw", "dot", "gv")  # formats that pydot writes by itself


def draw_net_to_file(
    caffe_net: Any, filename: str, rankdir: str = "LR", phase: int | None = None, display_lrm: bool = False
) -> None:
    """Draw a net into a file, in the format of its suffix; ``.raw``, ``.dot`` and ``.gv`` are Graphviz source."""
    extension = filename[filename.rfind(".") + 1 :]
    picture = draw_net(caffe_net, rankdir, extension, phase, display_lrm)
    write_whole(filename, picture)


def draw_net(
    caffe_net: Any, rankdir: str, ext: str = "png", phase: int | None = None, display_lrm: bool = False
) -> bytes:
    """Return the picture of a net in one of Graphviz' formats. Raises SpecError for an unknown format."""
    from netspec.inspect.draw.graphviz import render  # imported here, so that pycaffe works without netspec/inspect

    graph = get_pydot_graph(caffe_net, rankdir, phase=phase, display_lrm=display_lrm)
    text = graph.to_string()
    return text.encode() if ext in _TEXT_FORMATS else render(text, ext)


def get_pydot_graph(
    caffe_net: Any, rankdir: str = "LR", label_edges: bool = True, phase: int | None = None, display_lrm: bool = False
) -> Any:
    """Return the pydot graph of a NetParameter; ``rankdir`` is LR, TB or BT.

    With a phase, only layers that are included in it are drawn; ``display_lrm`` adds the learning-rate multipliers.
    """
    pydot = errors.load("pydot", "pycaffe", "caffe.draw")
    graph = pydot.Dot(caffe_net.name or "Net", graph_type="digraph", rankdir=rankdir)
    nodes: dict[str, Any] = {}
    edges = []
    for layer in caffe_net.layer:
        if phase is not None and not _included(layer, phase):
            continue
        key = f"{layer.name}_{layer.type}"
        in_place = len(layer.bottom) == 1 and list(layer.bottom) == list(layer.top)
        colored = {**LAYER_STYLE_DEFAULT, "fillcolor": choose_color_by_layertype(layer.type)}
        style = NEURON_LAYER_STYLE if in_place else colored
        nodes[key] = pydot.Node(get_layer_label(layer, rankdir, display_lrm), **style)
        for blob in layer.bottom:
            nodes[f"{blob}_blob"] = pydot.Node(_quoted(blob), **BLOB_STYLE)
            edges.append((f"{blob}_blob", key, '""'))
        for blob in layer.top:
            nodes[f"{blob}_blob"] = pydot.Node(_quoted(blob))
            edges.append((key, f"{blob}_blob", get_edge_label(layer) if label_edges else '""'))
    for node in nodes.values():
        graph.add_node(node)
    for source, target, label in edges:
        graph.add_edge(pydot.Edge(nodes[source], nodes[target], label=label))
    return graph


def get_layer_label(layer: Any, rankdir: str, display_lrm: bool = False) -> str:
    """Return the text in a layer's box: name, type, kernel, and the multipliers if requested."""
    separator = " " if rankdir in ("TB", "BT") else r"\n"
    kind, window = layer.type, None
    if layer.type == "Pooling":
        param = layer.pooling_param
        kind = f"Pooling {get_pooling_types_dict()[param.pool]}"
        window = param.kernel_size, param.stride, param.pad
    elif layer.type in ("Convolution", "Deconvolution"):
        param = layer.convolution_param
        window = tuple(
            values[0] if values else default
            for values, default in ((param.kernel_size, 1), (param.stride, 1), (param.pad, 0))
        )
    words = [layer.name, f"({kind})"]
    if window:
        words += [f"{name}: {value}" for name, value in zip(("kernel size", "stride", "pad"), window, strict=True)]
    if display_lrm and layer.type in _LEARNED and any(get_layer_lr_mult(layer)):
        words.append("lr mult: {:.1f}, {:.1f}".format(*get_layer_lr_mult(layer)))
    return _quoted(separator.join(words))


def get_layer_lr_mult(layer: Any) -> tuple[float, float]:
    """Return the learning-rate multipliers of weights and biases.

    Raises ValueError if the layer is not a Convolution, Deconvolution or InnerProduct, or has more than two.
    """
    if layer.type not in _LEARNED:
        raise ValueError(f"{layer.type} layers do not have a learning rate multiplier")
    if len(layer.param) > 2:
        raise ValueError("Could not parse the learning rate multiplier")
    weights, biases = [param.lr_mult for param in layer.param] + [1.0] * (2 - len(layer.param))
    return weights, biases


def get_edge_label(layer: Any) -> str:
    """Return the text at the tops of a layer: the batch size, or the number of channels or outputs."""
    if layer.type == "Data":
        return f"Batch {layer.data_param.batch_size}"
    if layer.type in ("Convolution", "Deconvolution"):
        return str(layer.convolution_param.num_output)
    if layer.type == "InnerProduct":
        return str(layer.inner_product_param.num_output)
    return '""'


def choose_color_by_layertype(layertype: str) -> str:
    """Return the color of a layer's box."""
    return _COLORS.get(layertype, LAYER_STYLE_DEFAULT["fillcolor"])


def get_pooling_types_dict() -> dict[int, str]:
    """Return the names of the pooling methods by their numbers."""
    return {number: name for name, number in caffe_pb2.PoolingParameter.PoolMethod.items()}


def _included(layer: Any, phase: int) -> bool:
    """Return whether a layer is included in a phase."""
    if layer.include and layer.exclude:
        raise ValueError(f"layer {layer.name} has both include and exclude specified.")
    if layer.include:
        return any(rule.phase == phase for rule in layer.include)
    return all(rule.phase != phase for rule in layer.exclude)


def _quoted(text: str) -> str:
    """Return a text in quotes, because colons and slashes are special to Graphviz."""
    return f'"{text}"'
