"""The rules for imports between packages, and light imports that must stay light."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT


@pytest.mark.slow
def test_import_contracts_hold() -> None:
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
def test_importing_needs_no_torch(module: str) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


GROUND = {"errors", "log", "process", "files", "terminal"}
OURS = ("netspec", "loopclosure", "lmdb_build")
STANDARD = {*sys.stdlib_module_names, "typing_extensions"} - {"argparse"}
LIBRARIES = {"cv2": "OpenCV", "google": "protobuf", "sklearn": "scikit-learn", "PIL": "Pillow"}


def room_of(module: str) -> str:
    """The row of the table that a module belongs to."""
    top, *inside = module.split(".")
    if top != "netspec" or not inside:
        return top
    return "/".join(inside[:2]) if inside[:2] == ["layers", "contract"] else inside[0]


def imported() -> dict[str, set[str]]:
    """What each room imports directly, in functions and for type checkers too: rooms by name, libraries likewise."""
    found: dict[str, set[str]] = {}
    for path in (path for package in OURS for path in (ROOT / package).rglob("*.py")):
        room = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        names = found.setdefault(room, set())
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                whole = node.module == "netspec"
                modules = [f"netspec.{alias.name}" for alias in node.names] if whole else [str(node.module)]
            for module in modules:
                top = module.partition(".")[0]
                if top not in STANDARD:
                    names.add(room_of(module) if top in OURS else LIBRARIES.get(top, top))
        names.discard(room)
    return found


def test_the_table_of_rooms_is_true() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text()
    table = re.findall(
        r"^\| `([\w/]+)` \| ([^|]*) \| ([^|]*) \|$", page.partition("## What a room may")[2], re.MULTILINE
    )
    entrance = {"netspec", "__init__", "__main__", "pycaffe", "dnn"}
    found = imported()
    assert {room for room, _, _ in table} == set(found) - entrance
    for room, rooms, libraries in table:
        listed = {name.strip() for name in f"{rooms},{libraries}".split(",") if name.strip()}
        reads = {"argparse"} if room in ("terminal", "cli", "loopclosure", "lmdb_build") else set()
        ground = GROUND if room not in GROUND else set()
        assert found[room] - ground - entrance - reads == listed, room


WINGS = {"fast", "dialects", "export", "compat", "inspect"}
CORE = {"proto", "graph", "data", "exact", "layers", "layers/contract", "run", "net", "solver", *GROUND}


def test_the_core_imports_no_wing() -> None:
    """But for the public doors: ``load``, and the package itself."""
    found = imported()
    assert {room: names & (WINGS | {"cli", "load"}) for room, names in found.items() if room in CORE} == {
        room: set() for room in CORE
    }
    assert not found["fast"] & (WINGS | {"load", "cli"})


def test_nobody_imports_the_doors() -> None:
    forbidden = {"tools", "prototxt", "tests", "benchmarks"}
    assert not [room for room, names in imported().items() if names & forbidden]
