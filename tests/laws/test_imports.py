"""Rules for imports, modules that must not import torch, and names that pages and examples use."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT


@pytest.mark.slow
def test_lint_imports_finds_no_violation() -> None:
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([program, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "netspec",
        "netspec.proto.text",
        "netspec.data",
        "netspec.graph.plan",
        "netspec.cli",
        "lmdb_build.cli",
        "loopclosure.cli",
    ],
)
def test_importing_does_not_import_torch(module: str) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


OURS = ("netspec", "loopclosure", "lmdb_build")
# What others import. docs/layer.md has the interface for layers of one's own, docs/engines.md the class Describer.
PUBLIC = {
    *OURS,
    "netspec.dnn",
    "netspec.inspect.features.describer",
    "netspec.layers",
    "netspec.proto.schema",
    "netspec.proto.text",
    "netspec.pycaffe",
}
PAGES = [ROOT / "README.md", *ROOT.glob("*/README.md"), *ROOT.glob("docs/**/*.md")]


def code_of(path: Path) -> list[str]:
    """Return the Python in a file: an example, or the blocks of a page."""
    text = path.read_text()
    return [text] if path.suffix == ".py" else re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("path", [*PAGES, *ROOT.glob("examples/**/*.py")], ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_and_examples_import_public_names(path: Path) -> None:
    found = set()
    for node in (node for code in code_of(path) for node in ast.walk(ast.parse(code))):
        found |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
        found |= {str(node.module)} if isinstance(node, ast.ImportFrom) else set()
        if isinstance(node, ast.ImportFrom) and node.module in OURS:
            package = __import__(node.module)
            public = {*package.__all__, *(name.rpartition(".")[2] for name in PUBLIC)}
            assert {alias.name for alias in node.names} <= public
    assert {module for module in found if module.partition(".")[0] in OURS} <= PUBLIC
