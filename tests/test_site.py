"""The site that tools/docs makes: no bad link, nothing loaded from elsewhere, all layers and commands."""

import re
import subprocess
import sys
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

COMMANDS = re.compile(r'<div class="highlight-commands.*?</div>', re.S)


class Links(HTMLParser):
    """The addresses that a page refers to, and the places in it that one can refer to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.places: set[str] = set()
        self.without_text: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.places.add(found.get("id") or "")
        self.targets += [found[key] or "" for key in ("href", "src") if key in found]
        if tag == "img" and not found.get("alt"):
            self.without_text.append(found.get("src") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_site_has_no_broken_links_and_no_external_resources(site: Path) -> None:
    pages = {page: Links(page) for page in site.rglob("*.html") if "_static" not in page.parts}
    assert len(pages) > 15
    for page, links in pages.items():
        assert not links.without_text, f"{page}: pictures without a text alternative"
        for target in links.targets:
            parts = urlparse(target)
            if parts.scheme:
                assert parts.scheme in ("https", "http", "data"), target
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert path.exists(), f"{page.name}: {target}"
            if parts.fragment and path in pages:
                assert unquote(parts.fragment) in pages[path].places, f"{page.name}: {target}"
        text = page.read_text()
        assert not re.search(r'<(?:script|img|iframe)[^>]*src="(?:https?:)?//', text)
        assert not re.search(r'<link[^>]*rel="stylesheet"[^>]*href="(?:https?:)?//', text)


def text_of(site: Path, pages: str) -> str:
    return "".join(page.read_text() for page in (site / "reference").glob(f"{pages}.html"))


def test_search_words_lead_to_their_pages(site: Path) -> None:
    index = (site / "searchindex.js").read_text()
    texts = (site / "_static" / "texts.js").read_text()
    for words, page in (
        ("custom layer", "layer"),
        ("fine-tune", "start"),
        ("mean.binaryproto", "start"),
        ("docker", "start"),
        ("gpu", "start"),
        ("pretrained", "trained"),
        ("which weights are there", "start"),
        ("rtab-map", "robot"),
    ):
        text = re.search(rf'"{page}": "((?:[^"\\]|\\.)*)"', texts)
        assert text is not None
        assert words in text[1].lower()
        assert f'"{page}"' in index


def test_every_layer_and_command_is_in_the_reference(site: Path) -> None:
    from netspec.cli import parser
    from netspec.layers import layer_types
    from netspec.proto.schema import SolverParameter

    layers = text_of(site, "layers-*")
    assert all(f">{kind}<" in layers for kind in layer_types())
    commands = text_of(site, "commands-*")
    (choices,) = (action.choices for action in parser()._actions if action.dest == "command")
    assert all(re.search(f">netspec {name}[< ]", commands) for name in choices or ())
    shown = re.sub(r"<[^>]+>", "", text_of(site, "solver"))
    assert all(re.search(rf"\b{field}\b", shown) for field in SolverParameter.DESCRIPTOR.fields_by_name)


def test_every_layer_is_drawn_with_its_shapes(site: Path) -> None:
    from netspec.layers import layer_types

    page = text_of(site, "layers-*")
    pictures = {
        found["kind"]: found
        for found in re.finditer(
            r'<svg class="shapes" viewBox="0 0 (?P<width>\S+) (?P<height>\S+)" role="img">'
            r"<title>(?P<kind>\w+) reads (?P<caption>.*?)</title>(?P<parts>.*?)</svg>",
            page,
        )
    }
    assert set(pictures) == set(layer_types()) - {"Python"}, "the class of a Python layer says its shapes"
    read = "left 2 × 4 × 5 × 6, right 2 × 4 × 5 × 6"  # the example in docs/reference/layers.prototxt
    gives = "conv_left 2 × 4 × 3 × 3, conv_right 2 × 4 × 3 × 3"
    assert pictures["Convolution"]["caption"] == f"{read} and gives {gives}; learned: 4 × 2 × 3 × 3, 4"
    for kind, picture in pictures.items():
        width, height = float(picture["width"]), float(picture["height"])
        for box in re.findall(r'<rect class="\w+" x="(\S+)" y="(\S+)" width="(\S+)" height="(\S+)"', picture["parts"]):
            x, y, w, h = map(float, box)
            assert 0 < x < x + w < width, kind
            assert 0 < y < y + h < height, kind
        for x, y, text in re.findall(r'<text class="\w+" x="(\S+)" y="(\S+)">([^<]*)<', picture["parts"]):
            reach = 3.3 * len(text)  # half of its width, at most, at 12 px
            assert reach < float(x) < width - reach, f"{kind}: {text}"
            assert 10 < float(y) < height, f"{kind}: {text}"


def test_each_command_has_a_description_above_it(site: Path) -> None:
    shown = [
        re.sub(r"<[^>]+>", "", block) for page in site.rglob("*.html") for block in COMMANDS.findall(page.read_text())
    ]
    assert len(shown) > 30
    assert any(re.search(r"^# one process, two GPUs\nnetspec train --solver", text, re.M) for text in shown)
    assert not [text for text in shown if re.search(r"^[^#\n]+ # ", text, re.M)]


def test_inline_code_fits_a_phone(site: Path) -> None:
    for page in site.rglob("*.html"):
        sentences = re.sub(r"<table.*?</table>", "", page.read_text(), flags=re.S)
        for word in re.findall(r'<span class="pre">([^<]*)</span>', sentences):
            assert len(unescape(word)) <= 45, f"{page.name}: {word}"  # they do not break: site.css
