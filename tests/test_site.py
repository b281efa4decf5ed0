"""The site that tools/docs makes: no bad link, nothing loaded from elsewhere, all layers and commands."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow


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
