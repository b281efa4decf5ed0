"""Runs Graphviz, which lays out a graph and draws it as SVG or PNG.

The package graphviz-pure contains it. An installed ``dot`` works as well.
"""

from __future__ import annotations

import shutil
import subprocess
import sysconfig

from netspec.errors import SpecError

PNG_DPI = 144  # for text of 10 points


def render(text: str, kind: str) -> bytes:
    """Draw a graph in DOT, in one of Graphviz's formats, such as "svg", "png" or "pdf".

    Raises SpecError if Graphviz is missing or cannot draw the graph in this format.
    """
    scripts = sysconfig.get_path("scripts")
    brought = shutil.which("graphviz-pure", path=scripts) or shutil.which("graphviz-pure")
    programs = [program for program in (brought, shutil.which("dot")) if program]
    if not programs:
        raise SpecError("drawing a net needs Graphviz: pip install graphviz-pure")
    resolution = [f"-Gdpi={PNG_DPI}"] if kind == "png" else []
    reason = ""
    for program in programs:
        done = subprocess.run([program, f"-T{kind}", *resolution], input=text.encode(), capture_output=True)
        if done.returncode == 0 and done.stdout:
            return done.stdout
        reason = next(iter(done.stderr.decode("utf-8", "replace").strip().splitlines()), "it gave no reason")
    raise SpecError(f"Graphviz cannot draw this net as .{kind}: {reason}")
