"""The pages of docs/: their commands and snippets run as they stand, and their site has no bad link."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
NAMED = re.compile(r"`([\w.]+)`[^`]*:\s*$")  # the name of the file, before the block that is its text
# The same commands on less, so that a page runs in seconds.
LESS = {
    "paper.md": {
        "--frames 250": "--frames 60",
        "--train 1600": "--train 96",
        "--val 400": "--val 50",
        "max_iter: 300": "max_iter: 4",
        "test_iter: 8 ": "test_iter: 1 ",
        "_interval: 50": "_interval: 4",
        "snapshot: 50": "snapshot: 4",
    }
}


def run(folder: Path, words: list[str]) -> None:
    programs = str(Path(sys.executable).parent)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{words[-1]}\n{done.stderr[-3000:]}"


@pytest.mark.parametrize("page", ["start.md", "layer.md", "paper.md"])
def test_a_page_runs_as_it_stands(page: str, tmp_path: Path) -> None:
    text = (ROOT / "docs" / page).read_text()
    for old, new in LESS.get(page, {}).items():
        text = text.replace(old, new)
    if page == "paper.md":
        for path in (ROOT / "prototxt").rglob("*.prototxt"):
            copy = tmp_path / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            content = path.read_text()
            for old, new in LESS[page].items():
                content = content.replace(old, new)
            copy.write_text(content)
        for path in (ROOT / "prototxt").rglob("*.caffemodel"):
            (tmp_path / path.relative_to(ROOT)).symlink_to(path)
    ran = 0
    for block in BLOCK.finditer(text):
        language, content = block[1], block[2]
        named = NAMED.search(text[: block.start()])
        if language in ("prototxt", "python") and named:
            (tmp_path / named[1]).write_text(content)
        elif language == "python":
            (tmp_path / "snippet.py").write_text(content)
            run(tmp_path, [sys.executable, "snippet.py"])
            ran += 1
        elif not language:
            run(tmp_path, ["bash", "-euc", content])
            ran += 1
    assert ran >= 3


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
    run(ROOT, [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(folder)])
    return folder


def test_the_site_has_no_bad_link_and_loads_nothing_from_elsewhere(site: Path) -> None:
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


def test_every_layer_and_command_is_in_the_reference(site: Path) -> None:
    from netspec.cli import parser
    from netspec.layers import layer_types

    layers = (site / "reference" / "layers.html").read_text()
    assert all(f">{kind}<" in layers for kind in layer_types())
    commands = (site / "reference" / "commands.html").read_text()
    (choices,) = (action.choices for action in parser()._actions if action.dest == "command")
    assert all(f">netspec {name}<" in commands for name in choices or ())
