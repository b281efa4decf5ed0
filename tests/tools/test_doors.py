"""The scripts in tools/ find a Python with the required packages, or say in one line what to run."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

DOORS = sorted(
    path.name
    for path in (ROOT / "tools").iterdir()
    if path.is_file() and "python" in path.read_text().partition("\n")[0]
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


def run(project: Path, python: Path, door: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), str(project / "tools" / door), *words]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(command, cwd=project.parent, env=environment, capture_output=True, text=True, check=False)


def test_there_are_doors() -> None:
    assert {"train.py", "convert_pairs_lmdb", "convert_imageset", "compute_image_mean", "compare.py"} < set(DOORS)


@pytest.mark.parametrize("door", DOORS)
def test_a_door_takes_the_python_of_the_virtual_environment_beside_it(
    door: str, project: Path, bare_python: Path
) -> None:
    (project / ".venv").symlink_to(sys.prefix)
    done = run(project, bare_python, door, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: ")


@pytest.mark.parametrize("door", DOORS)
def test_without_one_it_says_what_to_run_in_one_line(door: str, project: Path, bare_python: Path) -> None:
    done = run(project, bare_python, door, "--help")
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{project}/tools/{door}: ")
    assert "No module named " in line
    assert line.endswith(f"bash {project}/tools/setup.sh")


def test_a_virtual_environment_that_lacks_the_packages_too_is_not_tried_for_ever(
    project: Path, bare_python: Path
) -> None:
    (project / ".venv").symlink_to(bare_python.parents[1])
    for python in (bare_python, project / ".venv" / "bin" / "python"):
        done = run(project, python, "convert_imageset", "--help")
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1


def test_arguments_and_the_exit_status_go_through(project: Path, bare_python: Path) -> None:
    (project / ".venv").symlink_to(sys.prefix)
    words = ("-gray", f"{GOLDEN}/images/png/", f"{GOLDEN}/images/list.txt", "a db")
    assert run(project, bare_python, "convert_imageset", *words).returncode == 0
    assert (project.parent / "a db" / "data.mdb").is_file()
    assert run(project, bare_python, "convert_imageset", *words).returncode == 1
    assert run(project, bare_python, "convert_imageset", "-grey", *words).returncode == 2
