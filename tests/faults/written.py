"""Exports and drawings of damaged nets, for formats.py."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from xml.etree import ElementTree

from exported import onnx_model
from netspec.errors import SpecError
from netspec.export.formats.convert import blob_tensors
from netspec.export.formats.deploy import fold
from netspec.export.formats.module import torch_module
from netspec.export.formats.torch import torch_source
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.diagram import diagram_of
from netspec.inspect.draw.dot import dot_of
from netspec.inspect.draw.graphviz import render
from netspec.inspect.draw.page import net_page
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text, write_text

MOST = 1 << 22  # bytes of a net: large ones show nothing more


def _net(path: Path) -> Net:
    """Return the net of a damaged text. Raises SpecError for most."""
    message, source = parse_net_text(path.read_bytes().decode(errors="surrogateescape"), "net.prototxt")
    return build_net(with_state(message, TEST), source, BuildOptions(seed=0, limit=MOST))


def exported(path: Path) -> None:
    """Write a net in all forms: each parses, or a SpecError says why it cannot be."""
    net = _net(path)
    for write in (
        lambda: ast.parse(torch_source(net, "x.prototxt")[0]),
        lambda: torch_module(net),
        lambda: onnx_model(net)[0].SerializeToString(),
        lambda: write_text(fold(net)),
        lambda: {name: tensor.numpy() for name, tensor in blob_tensors(net).items()},
    ):
        try:
            write()
        except SpecError as fault:
            if "\n" in str(fault):
                raise ValueError("an error of several lines") from fault


def drawn(path: Path) -> None:
    """Draw a net as SVG and HTML: both parse."""
    message, source = parse_net_text(path.read_bytes().decode(errors="surrogateescape"), "net.prototxt")
    diagram = diagram_of(message, source, [TRAIN, TEST], BuildOptions(open_data=False, limit=MOST))
    ElementTree.fromstring(render(dot_of(diagram, unfolded=True), "svg"))
    html = net_page(diagram)
    json.loads(html.partition("const layers = ")[2].partition(";\n")[0])
    html.encode()
