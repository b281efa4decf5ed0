"""A library leaves its process as it is: importing, building and running change no setting of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from case_files import read_texts
from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

CODE, NET, TRAINING, LOOPS = read_texts("laws/process.txt").values()
LIBRARIES = "import torch._dynamo, cv2, h5py, scipy.linalg.blas, google.protobuf"  # they have settings of their own
SMALL = """layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1 dim: 8 dim: 8 } } }
layer { name: "c" type: "Convolution" bottom: "data" top: "c" convolution_param { num_output: 2 kernel_size: 3 } }
layer { name: "s" type: "Sigmoid" bottom: "c" top: "s" }"""


@pytest.mark.parametrize("work", [NET + TRAINING, LOOPS], ids=["net", "loops"])
def test_a_library_changes_no_setting_of_its_process(work: str, tmp_path: Path) -> None:
    for folder in ("sgd_step", "pairs"):
        found = next(GOLDEN.glob(f"**/{folder}"))
        (tmp_path / folder).symlink_to(found)
    (tmp_path / "deploy.prototxt").write_text(SMALL)
    code = CODE.replace("{libraries}", LIBRARIES).replace("{work}", work)
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "SYSTEMROOT") if name in os.environ}
    environment = {**kept, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}  # this process may have been changed before
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


TRAPS = ("torch", "numpy", "cv2", "signal", "typing", "argparse", "__future__", "contextlib", "dataclasses", "logging")


@pytest.mark.parametrize(
    "words",
    [
        "-m netspec layers",
        "-m loopclosure detect nowhere --out x",
        "-m lmdb_build imageset --help",
        "-m torch.distributed.run -m netspec --version",
    ],
    ids=lambda words: " ".join(words.split()[-3:-1]),
)
def test_nothing_in_the_working_directory_is_imported(words: str, tmp_path: Path) -> None:
    if "distributed" not in words:  # it imports them before netspec begins
        traps = tmp_path
    else:
        traps = tmp_path / "work"
        traps.mkdir()
    for name in TRAPS:
        (traps / f"{name}.py").write_text(f"print('RAN {name}')")
    command = [sys.executable, *words.split()]
    if "distributed" in words:
        command = [sys.executable, "-P", *words.split()] if sys.version_info >= (3, 11) else command
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(command, cwd=traps, env=environment, capture_output=True, text=True)
    assert "RAN" not in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
