"""The options of all commands: each is read or refused by name."""

import argparse
import ast
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from lmdb_build.cli import main as lmdb_build_main
from loopclosure.cli import main as loopclosure_main
from paths import GOLDEN, ROOT

NET, SOLVER, WEIGHTS = "train_val.prototxt", "solver.prototxt", "init.caffemodel"
THUMBNAILS = "loopclosure.descriptors.thumbnails:Thumbnailer"
# Command lines that together use every way in which a command works.
WAYS = {
    "netspec": [
        "check train_val.prototxt",
        "check solver.prototxt",
        "train solver.prototxt",
        "test --model train_val.prototxt --weights init.caffemodel --iterations 1",
        "time --model train_val.prototxt --iterations 1",
        "extract --model train_val.prototxt --weights init.caffemodel --blob feat --out f.npz",
        "extract --model train_val.prototxt --weights init.caffemodel --blob feat --out f.npz --images images",
        "export train_val.prototxt --to safetensors --out x.safetensors",
        "export train_val.prototxt --to torch --out x.py",
        "export train_val.prototxt --to onnx --out x.onnx",
        "fold train_val.prototxt --weights init.caffemodel --out folded",
        "draw train_val.prototxt --out net.svg",
        "draw train_val.prototxt --out net.html",
        "diff train_val.prototxt train_val.prototxt",
        "lint train_val.prototxt",
        "lint --rules",
        "plot train.log --out p.png",
        "data show pairs/test_lmdb --out s.png",
        "extract_features init.caffemodel train_val.prototxt feat features_lmdb 1 lmdb",
        "device_query",
        "upgrade_net_proto_text train_val.prototxt new.prototxt",
        "upgrade_net_proto_binary init.caffemodel new.caffemodel",
        "upgrade_solver_proto_text solver.prototxt new.prototxt",
        "layers",
        "install-caffe --build tree",
        "remove-caffe --build tree",
    ],
    "lmdb_build": [
        "walk walk --frames 3 --size 32x24",
        "sheet pairs.txt sheet.png",
        "convert ./ pairs.txt db",
        "imageset ./ images.txt db",
        "mean pairs/test_lmdb mean.binaryproto",
        "compare solver.prototxt --no-train --out out",
    ],
    "loopclosure": [
        "evaluate tum:walk/walk_1 --method thumbnails --exclude-frames 3 --out report",
        "evaluate images:images,truth=truth.png --method thumbnails --exclude-frames 1 --out report",
        "evaluate traverses:images,references=images --method thumbnails --out report",
        "detect walk/walk_1 --describe loopclosure.descriptors.thumbnails:Thumbnailer --exclude-recent 3 --out found",
        "detect walk/walk_1 --describe walk.npz --exclude-recent 1 --out found",
        "watch --video walk.avi --describe loopclosure.descriptors.thumbnails:Thumbnailer --out found",
        "close walk/walk_1 --loops loops.csv --drift 2 --out closed",
        "close images --loops loops.csv --odometry odometry.txt --out closed",
        "map build new walk/walk_1,limit=2",
        "map add map walk/walk_1,limit=2",
        "map query map walk/walk_1,limit=2 --out found",
        "map close map --out closed",
    ],
}
# Commands that this test does not start, and why.
NOT_STARTED = {
    "netspec": {
        "run": "the script ends the process; tests/netspec/compat/scripts",
    },
    "lmdb_build": {"pairs": "tests/lmdb_build/test_cli.py", "mnist": "needs MNIST", "cifar": "needs CIFAR-10"},
    "loopclosure": {},
}
SHARED = {"verbose", "plugin"}  # read before the command itself
HIDDEN = argparse.SUPPRESS
PROGRAMS = ("netspec", "lmdb_build", "loopclosure")
VALUES = {"shape": "data=1,1,28,28", "source": "pair_data=pairs/test_lmdb", "size": "8x8", "view_size": "8x8"}


class Watched(argparse.Namespace):
    """A namespace that records which of its names a command reads."""

    read: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> object:
        if name == "function":  # from here on the command itself
            Watched.read = set()
        Watched.read.add(name)
        return super().__getattribute__(name)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(argparse, "Namespace", Watched)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    for name in (NET, WEIGHTS):
        shutil.copy(GOLDEN / "snapshot" / name, tmp_path)
    text = f'net: "{NET}" base_lr: 0.1 lr_policy: "fixed" max_iter: 1 snapshot_prefix: "s" snapshot_after_train: false'
    Path(SOLVER).write_text(text)
    images = Path("images")
    images.mkdir()
    for k in range(3):
        cv2.imwrite(f"images/{k}.png", np.random.default_rng(k).integers(0, 256, (28, 28), np.uint8))
    Path("pairs.txt").write_text("images/0.png images/1.png 1\nimages/1.png images/2.png 0\n")
    Path("images.txt").write_text("images/0.png 1\nimages/1.png 2\n")
    np.savez("features.npz", features=np.eye(3, dtype=np.float32), names=np.array(["0.png", "1.png", "2.png"]))
    shutil.copy(GOLDEN / "log" / "caffe_train.log", "train.log")
    return tmp_path


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a walk, its features, a report of it, and its loops as a list and as a graph."""
    folder = tmp_path_factory.mktemp("drive")
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert lmdb_build_main(["walk", "walk", "--frames", "20", "--size", "40x32"]) == 0
        names = np.array([path.name for path in sorted(Path("walk/walk_1/rgb").iterdir())])
        video = cv2.VideoWriter("walk.avi", cv2.VideoWriter.fourcc(*"MJPG"), 2, (40, 32))
        for name in names:
            video.write(np.array(cv2.imread(f"walk/walk_1/rgb/{name}")))
        video.release()
        np.savez("walk.npz", features=np.random.default_rng(0).random((20, 4), np.float32), names=names)
        known = ["walk/walk_1", "--describe", THUMBNAILS, "--exclude-recent", "3", "--out", "."]
        assert loopclosure_main(["detect", *known]) == 0
        assert loopclosure_main(["map", "build", "map", "walk/walk_1,limit=2"]) == 0
        again = ["walk/walk_1", "--method", "thumbnails", "--exclude-frames", "3"]
        assert loopclosure_main(["evaluate", *again, "--out", "report"]) == 0
    finally:
        os.chdir(before)
    cv2.imwrite(str(folder / "truth.png"), np.tril(np.full((3, 3), 255, np.uint8), -1))
    return folder


def options(program: str) -> dict[str, list[argparse.Action]]:
    """Return the options of each command of a program that its help shows, except ``--help`` itself."""
    found = ((name.strip(), each._actions) for name, each in parsers(import_module(f"{program}.cli").parser(), ""))
    return {
        name: [a for a in actions if a.option_strings and a.dest != "help" and a.help != HIDDEN]
        for name, actions in found
    }


def command_lines() -> list[tuple[str, str]]:
    return [(program, line) for program, lines in WAYS.items() for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize(("program", "line"), command_lines(), ids=lambda value: value.replace(" ", "_"))
def test_every_option_is_read_or_refused(
    folder: Path, program: str, line: str, capfd: pytest.CaptureFixture[str], drive: Path
) -> None:
    if program == "loopclosure":
        shutil.copytree(drive, folder, dirs_exist_ok=True)
        shutil.copytree(drive / "report", folder / "reports" / "other")
    words = shlex.split(line)
    main = import_module(f"{program}.cli").main
    own = next(found for name, found in options(program).items() if f"{line} ".startswith(f"{name} "))

    def run(*more: str) -> int:
        Watched.read = set()
        with suppress(SystemExit):
            return main([*words, *more])
        return 0

    status = run()
    said = capfd.readouterr().err
    assert status != 2, said
    usual = set(Watched.read)
    typed = {word.partition("=")[0] for word in words}
    for option in own:
        if option.dest in SHARED | usual or typed & set(option.option_strings):
            continue
        value = VALUES.get(option.dest, str(next(iter(option.choices))) if option.choices else "1")
        name = option.option_strings[0]
        status = run(name, *([value] if option.nargs != 0 else []))
        said = capfd.readouterr().err
        refused = status == 2 and name in said.splitlines()[-1]
        assert refused or option.dest in Watched.read, f"{name} is ignored\n{said[-500:]}"


@pytest.mark.parametrize("program", WAYS)
def test_every_command_is_tested(program: str) -> None:
    names = set(options(program)) - set(NOT_STARTED[program])
    assert {name for name in names if not any(f"{line} ".startswith(f"{name} ") for line in WAYS[program])} == set()


NOT_CHECKED = {"netspec fold"}  # its --out is the beginning of two names


@pytest.mark.parametrize("program", WAYS)
def test_outputs_are_checked_before_the_work(program: str) -> None:
    """Every ``--out``, ``--save`` and ``--scores`` is added by ``add_output``."""
    group = import_module(f"{program}.cli").parser()
    found = {}
    for name, parser in parsers(group, program):
        written = {action.dest for action in parser._actions} & {"out", "save", "scores", "output", "output_file"}
        if missing := written - set(parser.get_default("outputs") or ()):
            found[name] = missing
    assert set(found) <= NOT_CHECKED


def parsers(parser: argparse.ArgumentParser, words: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parser of each command."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield words, parser
    for group in groups:
        for name, below in group.choices.items():
            yield from parsers(below, f"{words} {name}")


OTHERS = {"--help", "--version", "--verbose", "--no-train"}
OF_GLOG = {"--minloglevel", "--logtostderr", "--alsologtostderr", "--log_dir"}
OF_OTHER_PROGRAMS = {"--nproc-per-node"}  # torchrun's
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def test_options_in_messages_exist() -> None:
    """Each ``--word`` of a string in the programs, except docstrings, is an option of some command."""
    actions = [each for program in PROGRAMS for found in options(program).values() for each in found]
    known = {word for each in actions for word in each.option_strings} | OTHERS | OF_GLOG | OF_OTHER_PROGRAMS
    found, gone = set(), []
    for path in [path for package in PROGRAMS for path in (ROOT / package).rglob("*.py")]:
        tree = ast.parse(path.read_text())
        bodies = [node.body[0] for node in ast.walk(tree) if isinstance(node, DOCUMENTED) and node.body]
        docstrings = {id(first.value) for first in bodies if isinstance(first, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                words = re.findall(r"(?<![\w(-])--[a-z][a-z0-9_-]+(?![\w:])", node.value)  # no name of CSS
                found.update(words)
                gone += [f"{path}:{node.lineno}: {word}" for word in words if word not in known | {"--no"}]
    assert not gone
    assert {"--weights", "--resume", "--gpu"} <= found, "messages are not looked at"
