"""Which packages import which, and modules that must not import torch."""

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


BASE = {"errors", "log", "files", "terminal"}
OURS = ("netspec", "loopclosure", "lmdb_build")
STANDARD = {*sys.stdlib_module_names, "typing_extensions"} - {"argparse"}
LIBRARIES = {"cv2": "OpenCV", "google": "protobuf", "sklearn": "scikit-learn"}


def package_of(module: str) -> str:
    """Return the row of the table that a module belongs to."""
    top, *inside = module.split(".")
    if top != "netspec" or not inside:
        return top
    return "/".join(inside[:2]) if inside[:2] == ["layers", "contract"] else inside[0]


def imported() -> dict[str, set[str]]:
    """Return the packages and libraries that each package imports directly, also in functions and for type checkers."""
    found: dict[str, set[str]] = {}
    for path in (path for top in OURS for path in (ROOT / top).rglob("*.py")):
        package = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        names = found.setdefault(package, set())
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                whole = node.module == "netspec"
                modules = [f"netspec.{alias.name}" for alias in node.names] if whole else [str(node.module)]
            for module in modules:
                top = module.partition(".")[0]
                if top not in STANDARD:
                    names.add(package_of(module) if top in OURS else LIBRARIES.get(top, top))
        names.discard(package)
    return found


def test_the_table_of_imports_in_architecture_md_is_current() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text()
    table = re.findall(
        r"^\| `([\w/]+)` \| ([^|]*) \| ([^|]*) \|$", page.partition("## Imports between")[2], re.MULTILINE
    )
    entrance = {"netspec", "__init__", "__main__", "pycaffe", "dnn"}
    found = imported()
    assert {package for package, _, _ in table} == set(found) - entrance
    for package, packages, libraries in table:
        listed = {name.strip() for name in f"{packages},{libraries}".split(",") if name.strip()}
        reads = {"argparse"} if package in ("terminal", "cli", "loopclosure", "lmdb_build") else set()
        base = BASE if package not in BASE else set()
        assert found[package] - base - entrance - reads == listed, package


OPTIONAL = {"fast", "dialects", "export", "compat", "inspect"}
CORE = {"proto", "graph", "data", "exact", "layers", "layers/contract", "run", "net", "solver", *BASE}


def test_the_core_imports_no_optional_package() -> None:
    """The exceptions are ``load`` and ``netspec/__init__.py``."""
    found = imported()
    assert {name: names & (OPTIONAL | {"cli", "load"}) for name, names in found.items() if name in CORE} == {
        name: set() for name in CORE
    }
    assert not found["fast"] & (OPTIONAL | {"load", "cli"})


def test_nothing_imports_the_scripts() -> None:
    forbidden = {"tools", "prototxt", "tests", "benchmarks"}
    assert not [name for name, names in imported().items() if names & forbidden]


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
