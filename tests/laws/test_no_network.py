"""No engine uses the network."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

pytestmark = pytest.mark.slow


ENGINE = (Path(__file__).parent / "programs" / "engine.py").read_text()


@pytest.mark.parametrize("engine", ["onnxruntime", "openvino"])
def test_an_engine_opens_no_connection_and_writes_no_file_in_the_home_folder(engine: str, tmp_path: Path) -> None:
    pytest.importorskip(engine)
    net, home = tmp_path / "net.prototxt", tmp_path / "home"
    net.write_text(
        'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 dim: 1 dim: 4 dim: 4 } } }\n'
        'layer { name: "y" type: "ReLU" bottom: "x" top: "y" }\n'
    )
    home.mkdir()
    here = {name: value for name, value in os.environ.items() if not name.startswith(("CI", "ORT_", "XDG_"))}
    env = {**here, "HOME": str(home), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", ENGINE, str(net), engine, str(tmp_path / "cache")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "looked up" not in done.stdout
    assert [path for path in home.rglob("*") if path.is_file()] == []
