"""The rules for imports between packages, and light imports that must stay light."""

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


def test_nobody_imports_the_doors() -> None:
    for package in ("netspec", "loopclosure", "lmdb_build"):
        for path in (ROOT / package).rglob("*.py"):
            for line in path.read_text().splitlines():
                words = line.split()
                if words[:1] in (["import"], ["from"]):
                    assert words[1].split(".")[0] not in ("tools", "prototxt", "tests"), path
