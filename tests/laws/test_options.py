"""No option is ignored: each one of each command, given alone, is read, or refused by its name."""

import argparse
import shlex
import shutil
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from paths import GOLDEN

pytestmark = pytest.mark.slow

NET, SOLVER, WEIGHTS = "train_val.prototxt", "solver.prototxt", "init.caffemodel"
FEATURES = f"--model {NET} --weights {WEIGHTS} --blob feat"
# A command line of each way in which a command works; those of one command have the same options.
WAYS = {
    "netspec": (
        f"check {NET}",
        f"check {SOLVER}",
        f"check {WEIGHTS}",
        f"train {SOLVER}",
        f"test --model {NET} --weights {WEIGHTS} --iterations 1",
        f"time --model {NET} --iterations 1",
        f"extract {FEATURES} --out f.npz",
        f"extract {FEATURES} --out f.npz --images images",
        f"export {NET} --to safetensors --out x.safetensors",
        f"export {NET} --to torch --out x.py",
        f"export {NET} --to onnx --out x.onnx",
        f"fold {NET} --weights {WEIGHTS} --out folded",
        f"draw {NET} --out net.svg",
        f"draw {NET} --out net.html",
        f"diff {NET} {NET}",
        f"fmt --check {NET}",
        f"fmt {NET}",
        f"lint {NET}",
        "lint --rules",
        "plot train.log --out p.png",
        "plot train.log --out p.html",
        "watch train.log",
        "watch train.log --once",
        "data stat pairs/test_lmdb",
        "data show pairs/test_lmdb --out s.png",
        f"filters {WEIGHTS} --out f.png",
        f"maps {FEATURES} --image images/0.png --out m.png",
        f"saliency {FEATURES} --image images/0.png --out s.png",
        f"saliency {FEATURES} --image images/0.png --to images/1.png --out s.png",
        "embedding features.npz --out e.png",
        f"bug-report {NET}",
        f"extract_features {WEIGHTS} {NET} feat features_lmdb 1 lmdb",
        "device_query",
        f"upgrade_net_proto_text {NET} new.prototxt",
        f"upgrade_net_proto_text {WEIGHTS} new.prototxt",
        f"upgrade_net_proto_binary {WEIGHTS} new.caffemodel",
        f"upgrade_solver_proto_text {SOLVER} new.prototxt",
        "layers",
        "completion bash",
        "install-caffe --build tree",
        "remove-caffe --build tree",
    ),
    "lmdb_build": (
        "walk walk --frames 3 --size 32x24",
        "views images --out views --batches 1 --size 1 --view-size 16x12",
        "sheet pairs.txt sheet.png",
        "join joined.txt pairs.txt pairs.txt",
        "convert ./ pairs.txt db",
        "imageset ./ images.txt db",
        "mean pairs/test_lmdb mean.binaryproto",
        f"compare {SOLVER} --no-train --out out",
    ),
}
# Commands that this test does not start, and why.
NOT_STARTED = {
    "netspec": {
        "lsp": "serves standard input; it has no options of its own",
        "run": "the script ends the process; tests/netspec/scripts",
    },
    "lmdb_build": {
        "pairs": "tests/lmdb_build/test_cli.py",
        "mnist": "needs MNIST",
        "cifar": "needs CIFAR-10",
    },
}
SHARED = {"help", "minloglevel", "logtostderr", "alsologtostderr", "verbose", "plugin", "limit"}  # read by run()
VALUES = {"shape": "data=1,1,28,28", "source": "pair_data=pairs/test_lmdb", "size": "8x8", "view_size": "8x8"}


class Watched(argparse.Namespace):
    """A namespace that notes which of its names a command reads."""

    read: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> object:
        if name == "run":  # from here on the command itself
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


def options(module: str, command: str) -> list[argparse.Action]:
    """The options of a command that have a name."""
    (commands,) = (a for a in import_module(module).parser()._actions if isinstance(a, argparse._SubParsersAction))
    found = commands.choices[command]._actions
    return [a for a in found if a.option_strings and a.dest not in SHARED]


def ways() -> list[tuple[str, str]]:
    return [(program, line) for program, lines in WAYS.items() for line in lines]


@pytest.mark.parametrize(("program", "line"), ways(), ids=lambda value: value.replace(" ", "_"))
def test_every_option_is_read_or_refused(
    folder: Path, program: str, line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    module = f"{program}.cli"
    words = shlex.split(line)

    def run(*more: str) -> int:
        Watched.read = set()
        with suppress(SystemExit):
            return import_module(module).main([*words, *more])
        return 0

    status = run()
    said = capfd.readouterr().err
    assert status != 2, said
    usual = set(Watched.read)
    typed = {word.partition("=")[0] for word in words}
    for option in options(module, words[0]):
        if option.dest in usual or typed & set(option.option_strings):
            continue
        value = VALUES.get(option.dest, str(next(iter(option.choices))) if option.choices else "1")
        name = option.option_strings[0]
        status = run(name, *([value] if option.nargs != 0 else []))
        said = capfd.readouterr().err
        refused = status == 2 and name in said.splitlines()[-1]
        assert refused or option.dest in Watched.read, f"{name} is ignored\n{said[-500:]}"


@pytest.mark.parametrize("program", WAYS)
def test_every_command_is_among_them(program: str) -> None:
    (commands,) = (
        a for a in import_module(f"{program}.cli").parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    assert {line.split()[0] for line in WAYS[program]} | set(NOT_STARTED[program]) == set(commands.choices)
