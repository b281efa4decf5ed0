"""Any optional package, or all of them, can be deleted: everything else gives the same results bit for bit."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

OPTIONAL = ("fast", "dialects", "export", "compat", "inspect")
RANDOM_NETS = 30
MOST_LINES = 18_036  # of Python in the core
NOT_CORE = (*OPTIONAL, "cli", "terminal", "pycaffe.py", "dnn.py")


def copy_without(missing: Sequence[str], folder: Path) -> Path:
    shutil.copytree(ROOT / "netspec", folder / "netspec")  # with __pycache__: compiling takes seconds
    for package in missing:
        shutil.rmtree(folder / "netspec" / package)
    return folder


# An editable installation would find the missing modules in the project itself.
START = """
import runpy, sys
sys.meta_path[:] = [each for each in sys.meta_path if "Editable" not in getattr(each, "__name__", "")]
sys.argv[:] = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
found = [m.__file__ for name, m in list(sys.modules.items()) if name.partition(".")[0] == "netspec" and m.__file__]
assert all(file.startswith(sys.path[0]) for file in found), found
"""


def run(program: Path, package: Path, *arguments: str) -> str:
    """Run a program with the package in a folder and the test helpers; return its output."""
    path = os.pathsep.join([str(package), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-c", START, str(program), *arguments]
    done = subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def numbers(package: Path) -> dict[str, str]:
    """Return hashes of the results of the core of a package."""
    return json.loads(run(ROOT / "tests" / "core_program.py", package, str(RANDOM_NETS)))


@pytest.fixture(scope="module")
def whole() -> dict[str, str]:
    return numbers(ROOT)


@pytest.mark.parametrize("missing", [("fast",), OPTIONAL[1:], OPTIONAL], ids=["fast", "all but fast", "all"])
def test_the_core_computes_the_same_without_optional_packages(
    missing: tuple[str, ...], whole: dict[str, str], tmp_path: Path
) -> None:
    found = numbers(copy_without(missing, tmp_path))
    assert {name: value for name, value in found.items() if value != whole[name]} == {}


@pytest.mark.parametrize(
    ("missing", "asked", "message"),
    [
        ("dialects", "netspec.use_dialect('ssd')", "netspec/dialects"),
        ("export", "netspec.load_net('net.prototxt', engine='onnxruntime')", "netspec/export"),
        (
            "fast",
            "from netspec.export.formats.deploy import fold; fold(netspec.load_net('net.prototxt'))",
            "netspec/fast",
        ),
    ],
    ids=["dialect", "engine", "fold"],
)
def test_a_missing_package_is_reported_when_it_is_needed(
    missing: str, asked: str, message: str, tmp_path: Path
) -> None:
    folder = copy_without([missing], tmp_path)
    text = 'layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }'
    (folder / "net.prototxt").write_text(text)
    program = folder / "program.py"
    program.write_text(f"import netspec\ntry:\n    {asked}\nexcept netspec.SpecError as fault:\n    print(fault)\n")
    assert message in run(program, folder)


def test_train_works_without_optional_packages_and_export_reports_its_own(tmp_path: Path) -> None:
    """The core trains with identical results; a command that needs a missing package reports it in one line."""
    folder = copy_without(OPTIONAL, tmp_path)
    for part in ("train/sgd_step", "pairs"):
        shutil.copytree(GOLDEN / part, folder / Path(part).name)
    program = folder / "program.py"
    program.write_text(
        "import sys\nfrom netspec.cli import main\n"
        "print(main(['train', '--solver', 'sgd_step/solver.prototxt', '-q']))\nsys.stderr = sys.stdout\n"
        "main(['export', 'sgd_step/train_val.prototxt', '--to', 'onnx', '--out', 'x.onnx'])\n"
    )
    line = "netspec/export: is missing from this installation; this command needs it\n"
    assert run(program, folder) == f"0\n{line}"
    trained = (folder / "sgd_step" / "ref_iter_60.caffemodel").read_bytes()
    subprocess.run(
        [sys.executable, "-m", "netspec", "train", "--solver", "sgd_step/solver.prototxt", "-q"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"},
        check=True,
    )
    assert (folder / "sgd_step" / "ref_iter_60.caffemodel").read_bytes() == trained


def test_the_core_does_not_grow() -> None:
    package = ROOT / "netspec"
    core = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in NOT_CORE]
    assert sum(len(path.read_text().splitlines()) for path in core) <= MOST_LINES
