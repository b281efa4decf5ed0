"""Which PyTorch is installed: on ARM64 without an NVIDIA GPU the small one, on a Jetson only NVIDIA's own."""

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from paths import ROOT

SMALL = ("torch<2.11",)
PINNED = ("-c", str(ROOT / "constraints.txt"), "torch")


@pytest.fixture
def chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    """Return a function that returns what pip would install on a machine."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import install  # pyright: ignore[reportMissingImports]

    def choose(machine: str, cpu: bool = False, nvidia: bool = False, jetson: bool = False, index: str = "") -> object:
        for name in install.INDEXES:
            monkeypatch.delenv(name, raising=False)
        if index:
            monkeypatch.setenv(install.INDEXES[0], index)
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.setattr(platform, "machine", lambda: machine)
        monkeypatch.setattr(install, "NVIDIA", tmp_path if nvidia else tmp_path / "none")
        monkeypatch.setattr(install, "JETSON", tmp_path if jetson else tmp_path / "none")
        return install._torch(cpu)

    return choose


def test_which_pytorch_is_installed(chosen: Callable[..., object], capsys: pytest.CaptureFixture[str]) -> None:
    assert chosen("x86_64") == PINNED
    assert "5.2 GB" in capsys.readouterr().err
    assert chosen("x86_64", cpu=True, index="https://example.org") == PINNED
    assert "5.2 GB" not in capsys.readouterr().err
    assert chosen("aarch64") == SMALL
    assert "1.4 GB" in capsys.readouterr().err
    assert chosen("aarch64", nvidia=True) == PINNED
    assert chosen("aarch64", nvidia=True, cpu=True) == SMALL
    assert chosen("aarch64", jetson=True, cpu=True) == SMALL
    assert chosen("aarch64", index="https://example.org") == PINNED


def test_what_cannot_be_chosen_is_said(chosen: Callable[..., object]) -> None:
    with pytest.raises(SystemExit, match=r"^--cpu: PyTorch for the CPU alone is in another index"):
        chosen("x86_64", cpu=True)
    with pytest.raises(SystemExit, match=r"^This is a Jetson: install NVIDIA's PyTorch into .* first"):
        chosen("aarch64", jetson=True)


@pytest.mark.skipif(os.name == "nt", reason="needs bash and the programs of .venv/bin")
def test_what_a_script_needs_is_not_what_its_programs_need(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    for name in ("bin/netspec", "installed-dev"):
        (tmp_path / name).touch()
    script = f'NEEDS=dev; VENV="{tmp_path}"; source "{ROOT}/tools/setup.sh"; env'
    own = {name: value for name, value in os.environ.items() if name not in ("VENV", "NEEDS")}
    done = subprocess.run(["bash", "-c", script], env=own, capture_output=True, text=True, check=True)
    assert f"PATH={tmp_path}/bin:" in done.stdout
    assert not {"VENV", "NEEDS"} & {line.partition("=")[0] for line in done.stdout.splitlines()}
