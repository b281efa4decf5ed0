"""How Sphinx makes the site of these pages: ``tools/docs``."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any, ClassVar

from pygments.lexer import RegexLexer
from pygments.token import Comment, Name, Text

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

project = "netspec"
author = "the netspec authors"
extensions = ["myst_parser", "reference"]
exclude_patterns = ["_build"]
highlight_language = "commands"
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
BLOCK = re.compile(r"^```([^\n`]*)\n.*?^```$", re.M | re.S)
COMMENTED = re.compile(r"^([^\s#].*?) +(# .*)$", re.M)


class CommandLexer(RegexLexer):
    """Commands of a shell: an option is a token, so that no line breaks within it; so is a comment."""

    name = "commands"
    tokens: ClassVar = {"root": [(r"(?<!\S)#.*", Comment), (r"(?<!\S)--?\w[\w-]*", Name.Attribute), (r"\s+|\S+", Text)]}


def rewrite(text: str, folder: Path) -> str:
    """Return the text of a file of ``folder`` as the site has it.

    Links lead to pages; those without one are text. What a command does stands above it, where it fits on a phone.
    """
    text = BLOCK.sub(lambda block: block[0] if block[1] else COMMENTED.sub(r"\2\n\1", block[0]), text)

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
    """Have pages rewritten, and commands told from their comments."""
    app.add_lexer("commands", CommandLexer)
    app.connect("source-read", _page)
    app.connect("include-read", _included)
