"""The quick start keeps what is there, starts every command in its own folder, and ends with five lines."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from paths import ROOT

# What stands for the programs: it notes where it was started, and leaves the two files that the last lines are made of.
PROGRAM = """#!/usr/bin/env bash
echo "$PWD $(basename "$0") $*" >> "$ROOT/started"
case "$1" in
  compare) mkdir -p compare; printf 'net,precision,recall,accuracy\\nsmall,0.7,0.8,0.7251\\n' > compare/table.csv ;;
  close) echo "position, ATE RMSE [m]: 0.5124 before, 0.03211 after" ;;
esac
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A clone whose environment is ready, and has programs that do nothing."""
    folder = tmp_path / "clone"
    shutil.copytree(ROOT / "tools", folder / "tools")
    shutil.copytree(
        ROOT / "prototxt", folder / "prototxt", ignore=shutil.ignore_patterns("*.caffemodel", "SOURCES.csv")
    )
    shutil.copy(ROOT / "pyproject.toml", folder)
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("netspec", "lmdb-build", "loopclosure"):
        (programs / name).write_text(PROGRAM.replace("$ROOT", str(folder)))
        (programs / name).chmod(0o755)
    (folder / ".venv" / "installed").touch()
    return folder


def quickstart(project: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    # These describe the environment of this run of the tests, not the one of the project.
    own = {name: value for name, value in os.environ.items() if name not in ("VENV", "NEEDS")}
    command = [project / "tools" / "quickstart"]
    return subprocess.run(command, cwd=folder, env=own, capture_output=True, text=True, check=False)


def start(project: Path, folder: Path) -> list[str]:
    done = quickstart(project, folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_it_ends_with_five_lines_and_starts_all_in_one_folder(project: Path) -> None:
    out = "out/quickstart"
    assert start(project, project) == [
        f"A small net, trained here, labels 73 of 100 pairs of a new house correctly: {out}/compare/distances.png",
        f"The loops reduce the error of the path through that house from 0.51 m to 0.03 m: {out}/closed/paths.png",
        f"More pictures: {out}/pairs.png, {out}/compare/losses.png and the report {out}/report/report.html",
        f"What each command printed: {out}/quickstart.log",
        f"To continue there: source .venv/bin/activate && cd {out}",
    ]
    started = (project / "started").read_text().splitlines()
    assert len(started) == 10
    assert {line.split()[0] for line in started} == {str(project / out)}


@pytest.mark.slow
def test_a_second_run_deletes_nothing(project: Path, tmp_path: Path) -> None:
    start(project, project)
    trained = project / "out" / "quickstart" / "mine.caffemodel"
    trained.write_bytes(b"weights")
    lines = start(project, tmp_path)
    assert trained.read_bytes() == b"weights"
    assert lines[-1] == "To continue there: source clone/.venv/bin/activate && cd clone/out/quickstart-2"
    assert "clone/out/quickstart-3" in start(project, tmp_path)[-1]


def test_a_step_that_fails_is_reported(project: Path) -> None:
    (project / ".venv" / "bin" / "loopclosure").write_text("#!/bin/sh\necho no such net >&2; exit 1\n")
    done = quickstart(project, project)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-2:] == [
        "no such net",
        "The quick start stopped; see out/quickstart/quickstart.log",
    ]
