"""``netspec completion``, as the shells themselves complete."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from netspec.cli import main, parser

pytest.importorskip("shtab")
SHELLS = ("bash", "zsh", "fish")


@pytest.fixture
def script(capsys: pytest.CaptureFixture[str], tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    assert main(["completion", request.param]) == 0
    path = tmp_path / "_netspec"
    path.write_text(capsys.readouterr().out)
    return path


def complete(shell: str, script: Path, line: str, folder: Path) -> list[str]:
    """Return what a shell offers for the last word of a line."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not here")
    if shell == "fish":
        code = f"source {script}; complete -C '{line}'"
    else:
        words = line.split(" ")
        listed = " ".join(f"'{word}'" for word in words)
        code = "compopt() { :; }; "  # it works only while a line is edited
        code += f"source {script}; COMP_WORDS=({listed}); COMP_CWORD={len(words) - 1}; _shtab_netspec; "
        code += "printf '%s\\n' \"${COMPREPLY[@]}\""
    done = subprocess.run([program, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return [line.split("\t")[0] for line in done.stdout.split("\n") if line]


@pytest.mark.slow
@pytest.mark.parametrize(("script", "shell"), [("bash", "bash"), ("fish", "fish")], indirect=["script"])
def test_shells_complete_commands_options_and_files(script: Path, shell: str, tmp_path: Path) -> None:
    (tmp_path / "net.prototxt").write_text("")
    assert complete(shell, script, "netspec dr", tmp_path) == ["draw"]
    assert "--unfold" in complete(shell, script, "netspec draw --un", tmp_path)
    assert complete(shell, script, "netspec export --to on", tmp_path) == ["onnx"]
    assert "net.prototxt" in complete(shell, script, "netspec check net", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "shell"), [(shell, shell) for shell in SHELLS], indirect=["script"])
def test_scripts_have_every_command_and_valid_syntax(script: Path, shell: str) -> None:
    commands = parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    assert commands
    text = script.read_text()
    assert [name for name in commands if name not in text] == []
    if program := shutil.which(shell):
        subprocess.run([program, "-n", script], check=True)


def test_without_the_package_one_line_gives_advice(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    assert capsys.readouterr().err == "completion needs shtab: pip install shtab, or 'netspec-caffe[completion]'\n"
