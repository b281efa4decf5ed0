"""Starts Python in a temporary folder for tests of ``netspec run``."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def python(tmp_path: Path) -> Run:
    """``python(*words, rc=0, files={path: text}, **environment)``: what Python did in a folder with these files."""

    def command(*words: str, rc: int = 0, files: dict[str, str] | None = None, **environment: str) -> Any:
        for name, text in (files or {}).items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "latin-1")
        environment = {**os.environ, **environment}
        words = (sys.executable, *words)
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == rc, done.stderr
        return done

    return command


@pytest.fixture
def run(python: Run) -> Run:
    """``run(*words, s=text, ...)``: likewise ``netspec run``, with the text in s.py."""

    def command(*words: str, files: dict[str, str] | None = None, s: str = "", **more: Any) -> Any:
        return python("-m", "netspec", "run", *words, files={**(files or {}), "s.py": s}, **more)

    return command
