"""What is written about a damaged net, and what the language server says to a damaged talk: for formats.py."""

from __future__ import annotations

import ast
import io
import json
import logging
import traceback
from pathlib import Path
from xml.etree import ElementTree

from case_files import read_texts
from netspec.errors import SpecError
from netspec.export.formats.convert import blob_tensors
from netspec.export.formats.deploy import fold
from netspec.export.formats.onnx import onnx_model
from netspec.export.formats.pt2 import torch_module
from netspec.export.formats.torch import torch_source
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.inspect.draw.diagram import diagram_of
from netspec.inspect.draw.picture import picture_of
from netspec.inspect.draw.svg import html_of, svg_of
from netspec.inspect.editor.messages import Messages
from netspec.inspect.editor.server import make_server
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text, write_text

MOST = 1 << 22  # bytes of a net: large ones show nothing more
(SENT,) = (list(map(json.loads, text.splitlines())) for text in read_texts("faults/talk.txt").values())


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
    picture = picture_of(diagram)
    ElementTree.fromstring(svg_of(picture).encode())
    html = html_of(diagram, picture)
    json.loads(html.partition("const layers = ")[2].partition(";\n")[0])
    html.encode()


def talk(path: Path) -> None:
    """Write what an editor says."""
    bodies = [json.dumps({"jsonrpc": "2.0", **message}).encode() for message in SENT]
    path.write_bytes(b"".join(b"Content-Length: %d\r\n\r\n%s" % (len(body), body) for body in bodies))


def answered(path: Path) -> None:
    """Let the server hear a talk; raise what it raised in netspec, which pygls logs."""
    raised: list[BaseException] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            fault = record.exc_info[1] if record.exc_info else None
            while fault is not None:
                last = traceback.extract_tb(fault.__traceback__)[-1].filename if fault.__traceback__ else ""
                if "/netspec/" in last and not type(fault).__name__.startswith("JsonRpc"):
                    raised.append(fault)
                fault = fault.__cause__

    logger, kept, answers = logging.getLogger("pygls"), Kept(), io.BytesIO()
    before, logger.propagate = logger.propagate, False
    logger.addHandler(kept)
    answers.close = lambda: None  # type: ignore[method-assign]
    try:
        make_server("1").start_io(Messages(io.BytesIO(path.read_bytes())), answers)  # type: ignore[arg-type]
    except SystemExit:
        pass
    finally:
        logger.removeHandler(kept)
        logger.propagate = before
    for fault in raised:
        raise fault
