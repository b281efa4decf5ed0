"""Rerun accepts the files of --rerun as complete."""

import os
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest

from loopclosure.cli import main

WITHOUT = find_spec("rerun") is None
KNOWN = ["--features", "perfect.npz", "--threshold", "-0.2", "--exclude-recent", "10", "--out", "found"]


@pytest.fixture
def folder(two_laps: Path, two_laps_features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "laps").symlink_to(two_laps)
    (tmp_path / "perfect.npz").symlink_to(two_laps_features)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.skipif(WITHOUT, reason="not installed: rerun")
def test_recordings_of_detect_and_close(folder: Path) -> None:
    assert main(["detect", "laps", *KNOWN, "--rerun", "found.rrd"]) == 0
    closing = ["close", "laps", "--loops", "found/loops.csv", "--drift", "2", "--camera", "60,60,32,24"]
    assert main([*closing, "--out", "closed", "--rerun", "closed.rrd"]) == 0
    found = find_spec("rerun_cli")
    assert found is not None
    program = Path(str(found.origin)).with_name("rerun")
    for name, entities in (
        ("found.rrd", ("/image", "/match", "/score", "/loop", "/path/before", "/path/loops", "/path/camera")),
        ("closed.rrd", ("/image", "/path/before", "/path/after", "/path/true", "/path/camera/after")),
    ):
        for words, expected in ((["verify"], ["verified without error"]), (["print"], entities)):
            done = subprocess.run(
                [str(program), "rrd", *words, name],
                capture_output=True,
                text=True,
                check=False,
                env={**os.environ, "HOME": str(folder)},
            )
            said = done.stdout + done.stderr
            assert done.returncode == 0, said
            assert all(text in said for text in expected), said[-2000:]


@pytest.mark.skipif(not WITHOUT, reason="installed: rerun")
def test_without_rerun_the_command_stops_early(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detect", "laps", *KNOWN, "--rerun", "found.rrd"]) == 1
    assert capsys.readouterr().err == "rerun is not installed; pip install netspec-caffe[rerun]\n"
    assert not (folder / "found").exists()
