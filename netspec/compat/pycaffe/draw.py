"""``caffe.draw``: pictures of nets, drawn as by ``netspec draw``.

Caffe: python/caffe/draw.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from google.protobuf import text_format

from netspec.files.whole_file import write_whole
from netspec.proto.schema import TEST, TRAIN, phase_of
from netspec.proto.text import parse_net_text


def draw_net(
    caffe_net: Any, rankdir: str = "TB", ext: str = "png", phase: int | None = None, display_lrm: bool = False
) -> bytes:
    """Return the picture of a NetParameter in one of Graphviz' formats, or its text for "dot", "gv" and "raw".

    Both phases are in one picture unless one is given. ``rankdir`` and ``display_lrm`` have no effect: layers are drawn
    from top to bottom. Raises SpecError for an unknown format.
    """
    from netspec.inspect.draw.diagram import diagram_of  # imported here, so that pycaffe works without netspec/inspect
    from netspec.inspect.draw.dot import dot_of
    from netspec.inspect.draw.graphviz import render

    net, source = parse_net_text(text_format.MessageToString(caffe_net), caffe_net.name or "net")
    text = dot_of(diagram_of(net, source, [TRAIN, TEST] if phase is None else [phase_of(phase)]))
    return text.encode() if ext in ("dot", "gv", "raw") else render(text, ext)


def draw_net_to_file(
    caffe_net: Any, filename: str, rankdir: str = "TB", phase: int | None = None, display_lrm: bool = False
) -> None:
    """Draw a net into a file, in the format of its suffix; see :func:`draw_net`."""
    write_whole(filename, draw_net(caffe_net, rankdir, Path(filename).suffix[1:], phase, display_lrm))
