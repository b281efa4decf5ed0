"""Importing the packages, building and running nets change no setting of the process; what is not imported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

CODE = """
import logging, os, signal, sys, warnings
import torch

def loggers():
    known = {name: log for name, log in logging.root.manager.loggerDict.items() if isinstance(log, logging.Logger)}
    ours = ("netspec", "loopclosure", "lmdb_build")
    return {
        name: (log.level, log.disabled, log.propagate, list(log.handlers))
        for name, log in {**known, "": logging.root}.items()
        if not name.startswith(ours)
    }

def settings():
    backends = torch.backends
    return {
        "environment": dict(os.environ),
        "signals": {number: signal.getsignal(number) for number in signal.valid_signals()},
        "logging": loggers(),
        "warnings": list(warnings.filters),
        "hooks": (list(sys.meta_path), sys.excepthook, sys.displayhook, list(sys.path), sys.getrecursionlimit()),
        "torch": (
            torch.get_num_threads(), torch.get_num_interop_threads(), torch.get_default_dtype(),
            torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.get_float32_matmul_precision(),
            torch.are_deterministic_algorithms_enabled(), torch.initial_seed(), tuple(torch.get_rng_state().tolist()),
            backends.cudnn.enabled, backends.cudnn.benchmark, backends.cudnn.allow_tf32, backends.cudnn.deterministic,
            backends.cuda.matmul.allow_tf32, backends.mkldnn.enabled, torch.get_default_device(),
        ),
    }

def compared(did):
    after = settings()
    for name, was in before.items():
        now = after[name]
        if name == "logging":  # others' loggers come with the libraries that are loaded
            now = {logger: how for logger, how in now.items() if logger in was}
        if name == "warnings":  # as above
            now = [each for each in now if each in was]
        assert now == was, (did, name, was, now)

{libraries}
before = settings()
{work}
assert "netspec.terminal.process" not in sys.modules  # which also has settings whose effect cannot be seen
"""
NET = """
import numpy as np
import netspec
compared("import")
net = netspec.load_net("deploy.prototxt", phase="TEST", seed=0, exact="all")
compared("build")
net(**{name: np.zeros(net.shapes[name], np.float32) for name in net.inputs})
compared("run")
"""
TRAINING = """
solver = netspec.load_solver("sgd_step/solver.prototxt", device="cpu")
compared("build")
solver.step(2)
compared("train")
solver.close()
"""
LOOPS = """
import numpy as np
import loopclosure, lmdb_build.databases, loopclosure.report.page
from loopclosure import LoopDetector
compared("import")
"""
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


# Not contextlib: python -m itself (3.11) imports it from the working directory, before netspec begins.
TRAPS = ("torch", "numpy", "cv2", "signal", "typing", "argparse", "__future__", "dataclasses", "logging")


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
