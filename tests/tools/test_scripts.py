"""The scripts in tools/ find a Python with the required packages, or print the command to run in one line."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

SCRIPTS = sorted(
    path.name for path in (ROOT / "tools").iterdir() if path.is_file() and "from launch import run" in path.read_text()
)


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python without any package."""
    folder = tmp_path_factory.mktemp("python") / "bare"
    venv.create(folder, symlinks=True)
    return folder / "bin" / "python"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The scripts and the packages in a folder without ``.venv``."""
    folder = tmp_path / "project"
    shutil.copytree(ROOT / "tools", folder / "tools")
    for package in ("netspec", "loopclosure", "lmdb_build", "benchmarks"):
        (folder / package).symlink_to(ROOT / package)
    return folder


def run(project: Path, python: Path, script: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), str(project / "tools" / script), *words]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(command, cwd=project.parent, env=environment, capture_output=True, text=True, check=False)


def test_the_scripts_are_found() -> None:
    assert {"train.py", "convert_pairs_lmdb", "compare.py"} < set(SCRIPTS)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_uses_the_python_of_the_virtual_environment(script: str, project: Path, bare_python: Path) -> None:
    (project / ".venv").symlink_to(sys.prefix)
    done = run(project, bare_python, script, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: ")


def test_without_one_a_message_names_the_command_to_run(project: Path, bare_python: Path) -> None:
    done = run(project, bare_python, "train.py", "--help")
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{project}/tools/train.py: ")
    assert "No module named " in line
    assert line.endswith(f"to install the required packages: {bare_python} {project}/tools/install.py")


def test_arguments_and_the_exit_status_are_passed_on(project: Path, bare_python: Path) -> None:
    (project / ".venv").symlink_to(sys.prefix)
    (project.parent / "pairs.txt").write_text("0.png 1.png 1\n")
    words = ("-gray", "-resize_width=8", "-resize_height=8", f"{GOLDEN}/images/png/", "pairs.txt", "a db")
    assert run(project, bare_python, "convert_pairs_lmdb", *words).returncode == 0
    assert (project.parent / "a db" / "data.mdb").is_file()
    assert run(project, bare_python, "convert_pairs_lmdb", *words).returncode == 1
    assert run(project, bare_python, "convert_pairs_lmdb", "-grey", *words).returncode == 2
