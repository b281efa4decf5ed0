"""What runs where a system has no fork, no fcntl and no symbolic links; tests/test_as_windows.py starts these tests."""

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

from netspec.data.database import Writer, open_reader
from netspec.export.engines.cache import entry
from netspec.files import whole_file as package
from netspec.files.limits import memory
from optional_packages import leveldb
from paths import GOLDEN, ROOT

SMALL = ROOT / "prototxt" / "many_negatives" / "siamese_words_256"
SCRIPT = f"""
import caffe
net = caffe.Net("{SMALL}/deploy.prototxt", "{SMALL}/siamese_words_256.caffemodel", caffe.TEST)
print(net.forward()["feat"].shape)
"""


def test_what_is_taken_away(tmp_path: Path) -> None:
    with pytest.raises(ImportError):
        import fcntl  # noqa: F401
    assert not hasattr(os, "fork")
    with pytest.raises(OSError, match="privilege"):
        (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(PermissionError):
        os.open(tmp_path, os.O_RDONLY)
    with (tmp_path / "file").open("wb"), pytest.raises(PermissionError):
        (tmp_path / "file").rename(tmp_path / "other")
    with (tmp_path / "file").open("rb") as file, pytest.raises(OSError, match="Bad file descriptor"):
        os.fsync(file.fileno())


def leftovers(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.suffix in (".unfinished", ".lock")]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return a function that runs a command in ``tmp_path`` and returns what it printed."""
    monkeypatch.chdir(tmp_path)

    def run(module: str, *words: object) -> str:
        status = import_module(module).main([str(word) for word in words])
        printed = "".join(capfd.readouterr())
        assert status == 0, printed
        for complaint in ("Traceback", "no file locks"):
            assert complaint not in printed
        assert not leftovers(tmp_path)
        return printed

    return run


def test_images_become_a_database_in_two_processes(run: Callable[..., str], tmp_path: Path) -> None:
    images = GOLDEN / "images"
    run("lmdb_build.cli", "imageset", "-workers", 2, f"{images}/png/", f"{images}/list.txt", "db")
    found, expected = (path.joinpath("data.mdb").read_bytes() for path in (tmp_path / "db", images / "lmdb_plain"))
    assert found == expected
    (tmp_path / "pairs.txt").write_text("0.png 1.png 1\n2.png 3.png 0\n")
    resize = "-resize_width", 28, "-resize_height", 28
    run("lmdb_build.cli", "convert", *resize, f"{images}/png/", "pairs.txt", "pairs")
    assert len(open_reader("pairs")) == 2


def test_a_training_writes_resumes_and_refuses_a_second_one(run: Callable[..., str], tmp_path: Path) -> None:
    for name in ("train/sgd_step", "pairs"):
        shutil.copytree(GOLDEN / name, tmp_path / Path(name).name)
    path = tmp_path / "sgd_step" / "solver.prototxt"
    path.write_text(path.read_text().replace("max_iter: 60", "max_iter: 4 snapshot: 2"))
    run("netspec.cli", "train", "--solver", path)
    whole = Path("sgd_step/ref_iter_4.caffemodel").read_bytes()
    Path("sgd_step/ref_iter_4.caffemodel").unlink()
    run("netspec.cli", "train", "--solver", path, "--snapshot", "sgd_step/ref_iter_2.solverstate")
    assert Path("sgd_step/ref_iter_4.caffemodel").read_bytes() == whole
    with package.only_one("sgd_step/.ref.lock", ""):
        assert import_module("netspec.cli").main(["train", "--solver", str(path)]) == 1


def test_a_net_is_exported_and_run_by_a_script(run: Callable[..., str]) -> None:
    files = f"{SMALL}/deploy.prototxt", "--weights", f"{SMALL}/siamese_words_256.caffemodel"
    run("netspec.cli", "export", *files, "--to", "torch", "--out", "net.py")
    Path("script.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "netspec", "run", "script.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "(1, 1856)\n"), done.stderr


def test_maps_and_loops(run: Callable[..., str], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    walls = [cv2.resize(rng.integers(0, 256, (12, 16, 3), np.uint8), (80, 60)) for _ in range(8)]
    (tmp_path / "walk").mkdir()
    for k in range(24):
        cv2.imwrite(f"walk/{k:02d}.png", walls[k % 8])
    run("loopclosure.cli", "map", "build", "map", "walk", "--describe", "small")
    run("loopclosure.cli", "map", "query", "map", "walk", "--out", "where")
    run("loopclosure.cli", "detect", "walk", "--describe", "small", "--out", "found")
    assert Path("found", "loops.csv").is_file()


def test_a_lock_ends_with_its_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = f"""
from {package.__name__} import *
held = only_one("x", ""), whole_folder("folder"), whole_file("file")
held[0].__enter__(), held[1].__enter__(), held[2].__enter__().write_text("half")
print(flush=True); input()
"""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdin=pipe, stdout=pipe) as process:
        assert process.stdout is not None
        process.stdout.readline()
        monkeypatch.setattr(package, "_swept", set())
        with package.whole_file(tmp_path / "other") as unfinished:
            unfinished.touch()
        assert len(leftovers(tmp_path)) == 2
        with pytest.raises(ValueError, match=f"locked by another process .process {process.pid}.; wait"):
            package.only_one(tmp_path / "x", "wait").__enter__()
        process.kill()
    monkeypatch.setattr(package, "_swept", set())
    with package.only_one(tmp_path / "x", ""), package.whole_file(tmp_path / "other") as unfinished:
        unfinished.touch()
    assert {path.name for path in tmp_path.iterdir()} - {path.name for path in leftovers(tmp_path)} == {"other"}


def test_a_damaged_model_in_the_cache_is_made_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def make(folder: Path) -> None:
        (folder / "model").write_bytes(b"m")

    folder = entry(tmp_path, "key", make)
    (folder / "model").write_bytes(b"n")
    with caplog.at_level(logging.WARNING):
        assert entry(tmp_path, "key", make) == folder
    assert (folder / "model").read_bytes() == b"m"
    assert len(list(tmp_path.glob(".damaged-*"))) == 1


@pytest.mark.parametrize("linked", [True, False])
def test_a_leveldb_is_read(linked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leveldb()

    def no_link(source: str, target: str) -> None:
        raise OSError("another drive")

    with Writer(str(tmp_path / "db"), "leveldb") as writer:
        writer.put(b"key", b"value")
    if not linked:
        monkeypatch.setattr(os, "link", no_link)
    for _ in range(2):
        assert open_reader(str(tmp_path / "db"), "leveldb").record(0) == b"value"


def test_the_memory_is_guessed() -> None:
    assert memory() == 8 << 30
