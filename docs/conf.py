"""How Sphinx makes the site of these pages: ``tools/docs``."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from pygments.lexer import RegexLexer
from pygments.token import Comment, Keyword, Name, Number, Punctuation, String, Text

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

PROJECT = (ROOT / "pyproject.toml").read_text()
project = "netspec"
author = "the netspec authors"
release = version = re.findall(r'^version = "(.+?)"', PROJECT, re.M)[0]
REPOSITORY = re.findall(r'^Source = "(.+?)"', PROJECT, re.M)[0]
extensions = ["myst_parser", "reference"]
exclude_patterns = ["_build"]
highlight_language = "commands"
html_theme = "furo"
html_title = f"netspec {version}"
html_copy_source = html_use_index = False
smartquotes_action = "qe"  # two hyphens begin an option and must not become a dash
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["copy.js", "tables.js"]
html_theme_options = {
    "navigation_with_keys": True,
    "source_repository": REPOSITORY,
    "source_branch": "main",
    "source_directory": "docs/",
    "top_of_page_buttons": ["edit"],
}
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header", "misc.highlighting_failure"]  # READMEs start with any heading; logs lack a language

# The README of each folder and these files are pages, too.
PROJECT_PAGES = {f"{name}/README.md": f"project/{name}.md" for name in ("loopclosure", "prototxt", "benchmarks")} | {
    f"{name.upper()}.md": f"project/{name}.md" for name in ("changelog", "contributing", "architecture", "security")
}
LINK = re.compile(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]*)(#[^)]*)?\)")
BLOCK = re.compile(r"^```([^\n`]*)\n.*?^```$", re.M | re.S)
COMMENTED = re.compile(r"^([^\s#].*?) +(# .*)$", re.M)


class CommandLexer(RegexLexer):
    """Commands of a shell. An option is one token, so that no line is broken inside it. So is a comment."""

    name = "commands"
    tokens: ClassVar = {"root": [(r"(?<!\S)#.*", Comment), (r"(?<!\S)--?\w[\w-]*", Name.Attribute), (r"\s+|\S+", Text)]}


class PrototxtLexer(RegexLexer):
    """Protobuf's text format: names of fields and messages, strings, numbers, words of an enumeration."""

    name = "prototxt"
    tokens: ClassVar = {
        "root": [
            (r"#.*", Comment),
            (r"\w+(?=\s*\{)", Name.Class),
            (r"\w+(?=\s*:)", Name.Attribute),
            (r'"[^"\n]*"|\'[^\'\n]*\'', String),
            (r"-?[\d.]+(?:e[-+]?\d+)?", Number),
            (r"\w+", Keyword.Constant),
            (r"[{}:;,<>\[\]]", Punctuation),
            (r"\s+|.", Text),
        ]
    }


def rewrite(text: str, folder: Path) -> str:
    """Return the text of a page in ``folder`` as the site shows it.

    Links lead to pages; links to other files become text. A comment on a command is moved above it, to fit on a phone.
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
        destination = HERE / PROJECT_PAGES[name] if name in PROJECT_PAGES else path
        if name == "README.md":
            destination = HERE / "index.md"
        if destination.suffix != ".md" or not destination.is_relative_to(HERE):
            return f"{label} (`{name}`)" if label.strip("`") != name else label
        return f"[{label}](/{destination.relative_to(HERE).as_posix()}{anchor})"

    return LINK.sub(replaced, text)


def _rewrite_page(app: Any, docname: str, source: list[str]) -> None:
    source[0] = rewrite(source[0], (HERE / docname).parent)


def _rewrite_included(app: Any, relative_path: Path, parent: str, content: list[str]) -> None:
    content[0] = rewrite(content[0], (HERE / relative_path).resolve().parent)


def _add_captions(app: Any, doctree: nodes.document) -> None:
    """Show the description of a picture below it. A click opens the picture in its full size."""
    for number, paragraph in enumerate(list(doctree.findall(nodes.paragraph))):
        if len(paragraph) == 1 and isinstance(picture := paragraph[0], nodes.image):
            picture["scale"] = 100
            caption = nodes.caption("", picture["alt"])
            paragraph.replace_self(nodes.figure("", picture, caption, ids=[f"picture-{number}"]))


def _write_search_texts(app: Any, exception: Exception | None) -> None:
    """Write the text of all pages for the search (search.js), which cannot load pages that are opened from a disk."""
    if exception is None and app.builder.format == "html":
        texts = {name: app.env.get_doctree(name).astext() for name in sorted(app.env.found_docs)}
        made = Path(app.outdir, "_static", "texts.js")
        made.write_text(f"const TEXTS = {json.dumps(texts)};\n", "utf-8")


def _add_search_scripts(app: Any, pagename: str, *_: object) -> None:
    if pagename == "search":
        for name in ("texts.js", "search.js"):
            app.add_js_file(name)


def setup(app: Any) -> None:
    """Have pages rewritten, code in colors, captions below pictures, and a search that shows text."""
    app.add_lexer("commands", CommandLexer)
    app.add_lexer("prototxt", PrototxtLexer)
    app.connect("doctree-read", _add_captions)
    app.connect("html-page-context", _add_search_scripts)
    app.connect("build-finished", _write_search_texts)
    app.connect("source-read", _rewrite_page)
    app.connect("include-read", _rewrite_included)
