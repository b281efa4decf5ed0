"""What ``pip install`` gives: a wheel with all files of the packages, and commands that work without the source."""

import configparser
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from netspec.inspect.features import shipped
from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

PACKAGES = ("lmdb_build", "loopclosure", "netspec")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
NETS = [path.relative_to(ROOT).as_posix() for path in (ROOT / "prototxt").rglob("*") if path.is_file()]
FILES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", *NETS)


def run(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # which names the source
    line = [str(word) for word in words]
    done = subprocess.run(line, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clone by the name that `git clone` gives it, alone in a folder."""
    source = tmp_path_factory.mktemp("projects") / "netspec"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    return source


@pytest.fixture(scope="module")
def wheel(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(*PIP, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", folder, source, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def commands(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the commands in an environment that has the wheel, and what it depends on from this one."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    venv.create(folder, symlinks=True)
    run(*PIP, "--python", folder / "bin" / "python", "install", "--no-deps", "--no-index", wheel, cwd=folder)
    (site,) = folder.glob("lib/python*/site-packages")
    # Only paths: an editable installation of this project would need its .pth file read.
    (site / "dependencies.pth").write_text("\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}))
    return folder / "bin"


def test_the_wheel_has_exactly_the_files_of_the_packages(wheel: Path) -> None:
    expected = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name != "README.md"
    }
    with zipfile.ZipFile(wheel) as file:
        found = {name for name in file.namelist() if ".dist-info/" not in name}
    named = tuple(f"prototxt/{net}/" for net in (shipped.DEFAULT, shipped.SMALL))
    expected |= {f"netspec/{name}" for name in NETS if name.endswith(".prototxt") or name.startswith(named)}
    assert found == expected
    assert wheel.stat().st_size < 12e6
    assert {"netspec/proto/caffe.desc", "netspec/py.typed", "netspec/inspect/features/shipped.py"} < found


def test_the_wheel_has_its_metadata(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        (info,) = {name.partition("/")[0] for name in file.namelist() if ".dist-info/" in name}
        metadata = file.read(f"{info}/METADATA").decode()
        points = configparser.ConfigParser()
        points.read_string(file.read(f"{info}/entry_points.txt").decode())
        assert any("licenses/LICENSE" in name for name in file.namelist())
    assert "\nName: netspec-caffe\n" in metadata
    assert dict(points["console_scripts"]) == {
        "netspec": "netspec.__main__:main",
        "loopclosure": "loopclosure.__main__:main",
        "lmdb-build": "lmdb_build.__main__:main",
    }


def test_the_other_commands_run_without_the_source(commands: Path, tmp_path: Path) -> None:
    net = GOLDEN / "snapshot" / "train_val.prototxt"
    table = run(commands / "netspec", "check", net, "--shape", "pair_data=4,2,28,28", cwd=tmp_path).stdout
    assert "ContrastiveLoss" in table
    assert "usage: loopclosure evaluate" in run(commands / "loopclosure", "evaluate", "--help", cwd=tmp_path).stdout
    code = "import netspec, loopclosure, lmdb_build; print(netspec.__file__)"
    where = Path(run(commands / "python", "-c", code, cwd=tmp_path).stdout.strip())
    assert where.is_relative_to(commands.parent)


def test_detect_works_without_options(commands: Path, tmp_path: Path) -> None:
    """The net, its weights and the settings come with the wheel."""
    run(commands / "lmdb-build", "walk", "w", "--frames", "40", "--size", "80x60", "--laps", "2", cwd=tmp_path)
    run(commands / "loopclosure", "detect", "w/walk_1", "--out", "found", cwd=tmp_path)
    assert (tmp_path / "found" / "loops.csv").is_file()
    code = "from netspec.inspect.features.shipped import folder; print(folder('siamese_8'))"
    paper = Path(run(commands / "python", "-c", code, cwd=tmp_path).stdout.strip())
    assert paper.is_relative_to(commands.parent)
    assert (paper / "train_val.prototxt").read_bytes() == (ROOT / "prototxt/siamese_8/train_val.prototxt").read_bytes()


def test_an_editable_installation_has_the_nets_also_in_the_folder_of_the_clone(source: Path, tmp_path: Path) -> None:
    """In the folder that holds a clone, Python finds the clone first: a package of this name without any file."""
    site = tmp_path / "site"
    venv.create(site, symlinks=True)
    editable = ("install", "--no-deps", "--no-index", "--no-build-isolation", "-e", source)
    (packages,) = site.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(
        "\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
    )
    run(*PIP, "--python", site / "bin" / "python", *editable, cwd=tmp_path)
    code = "from loopclosure import LoopDetector; import netspec; print(netspec.__file__, LoopDetector"
    for folder in (tmp_path, source.parent):
        said = run(site / "bin" / "python", "-c", f"{code}('small').settings.views)", cwd=folder).stdout.split()
        assert said == [str(source / "netspec" / "__init__.py"), "1"]
    assert "usage: netspec" in run(site / "bin" / "python", "-m", "netspec", "--help", cwd=source.parent).stdout


def test_every_weight_has_its_source_and_license() -> None:
    for folder in (ROOT / "prototxt" / "many_negatives").iterdir():
        assert (folder / f"{folder.name}.caffemodel").stat().st_size < 10e6
        said = (folder / "SOURCE.md").read_text()
        assert f"{folder.name}.caffemodel" in said
        assert "License: " in said
