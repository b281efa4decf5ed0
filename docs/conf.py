"""How Sphinx makes the site of these pages: ``tools/docs``."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

project = "netspec"
author = "the netspec authors"
extensions = ["myst_parser", "reference"]
exclude_patterns = ["_build"]
highlight_language = "text"
html_theme = "furo"
html_title = "netspec: the living Caffe"
html_copy_source = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header", "misc.highlighting_failure"]  # READMEs begin where they like; logs are no language

# The README of each folder is a page too.
ROOMS = {f"{name}/README.md": f"rooms/{name}.md" for name in ("netspec", "loopclosure", "prototxt", "benchmarks")}
LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]*)(#[^)]*)?\)")


def rewrite(text: str, folder: Path) -> str:
    """Return the text of a file of ``folder``, its links as the site has them; those without a page are text."""

    def replaced(found: re.Match[str]) -> str:
        label, target, anchor = found[1], found[2], found[3] or ""
        if not target or "://" in target:
            return found[0]
        path = (folder / target).resolve()
        if not path.is_relative_to(ROOT):
            return found[0]
        name = path.relative_to(ROOT).as_posix()
        destination = HERE / ROOMS[name] if name in ROOMS else path
        if name == "README.md":
            destination = HERE / "index.md"
        if destination.suffix != ".md" or not destination.is_relative_to(HERE):
            return f"{label} (`{name}`)" if label.strip("`") != name else label
        return f"[{label}](/{destination.relative_to(HERE).as_posix()}{anchor})"

    return LINK.sub(replaced, text)


def _page(app: Any, docname: str, source: list[str]) -> None:
    source[0] = rewrite(source[0], (HERE / docname).parent)


def _included(app: Any, relative_path: Path, parent: str, content: list[str]) -> None:
    content[0] = rewrite(content[0], (HERE / relative_path).resolve().parent)


def setup(app: Any) -> None:
    """Have links rewritten."""
    app.connect("source-read", _page)
    app.connect("include-read", _included)
