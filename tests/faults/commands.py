"""Commands that write files, with their inputs and checks of their outputs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import lmdb
import numpy as np

import lmdb_build.cli
import loopclosure.cli
import netspec.cli
from netspec.load import load_solver
from netspec.solver.snapshot import read_state
from paths import GOLDEN

Main = Callable[[list[str]], int]


@dataclass
class Case:
    """A command; its inputs are in its working directory, its outputs in the folder ``out`` there.

    ``check()`` reads the outputs and raises for broken ones; its result must always be the same, or None.
    """

    main: Main
    words: list[str]
    prepare: Callable[[], None]
    check: Callable[[], object]


def images(count: int) -> list[Path]:
    """Write pictures that are all different."""
    folder = Path("images")
    folder.mkdir()
    rng = np.random.default_rng(0)
    paths = [folder / f"{i:03d}.png" for i in range(count)]
    for path in paths:
        cv2.imwrite(str(path), rng.integers(0, 255, (48, 64, 3)).astype(np.uint8))
    return paths


def train_inputs() -> None:
    shutil.copytree(GOLDEN / "train" / "sgd_step", "sgd_step")
    Path("pairs").symlink_to(GOLDEN / "pairs")
    text = Path("sgd_step/solver.prototxt").read_text()
    for old, new in (("max_iter: 60", "max_iter: 40"), ("snapshot_after_train: false", "")):
        text = text.replace(old, new)
    lines = [line for line in text.splitlines() if not line.startswith(("snapshot", "random_seed", "test_i"))]
    lines = [line for line in lines if "test_" not in line]
    lines += ["snapshot: 5", 'snapshot_prefix: "out/x"', "random_seed: 1"]
    Path("solver.prototxt").write_text("\n".join(lines) + "\n")


def check_snapshots() -> object:
    """Read all snapshots, and resume from the last."""
    states = sorted(Path("out").glob("*.solverstate"), key=lambda path: int(path.stem.rpartition("_")[2]))
    for state in states:
        assert Path(read_state(state).learned_net).is_file(), f"{state} has no weights"
    if states:
        solver = load_solver("solver.prototxt", snapshot=states[-1])
        assert solver.iteration == int(states[-1].stem.rpartition("_")[2])
        solver.close()
    return None


def convert_inputs() -> None:
    paths = images(160)
    lines = [f"{a} {b} {i % 2}" for i, (a, b) in enumerate(zip(paths[::2], paths[1::2], strict=True))]
    Path("pairs.txt").write_text("\n".join(lines) + "\n")


def check_database() -> object:
    if not Path("out/db").exists():
        return None
    with lmdb.open("out/db", readonly=True, lock=False) as env, env.begin() as transaction:
        found = list(transaction.cursor())
    assert len(found) == 80, f"{len(found)} of 80 records"
    return found


def remove_database() -> None:
    shutil.rmtree("out/db", ignore_errors=True)


def extract_inputs() -> None:
    images(12)
    Path("net.prototxt").write_text(
        'input: "data" input_dim: 1 input_dim: 3 input_dim: 48 input_dim: 64\n'
        'layer { name: "p" type: "Pooling" bottom: "data" top: "p" pooling_param { pool: AVE global_pooling: true } }\n'
        'layer { name: "ip" type: "InnerProduct" bottom: "p" top: "ip" inner_product_param { num_output: 5000\n'
        'weight_filler { type: "constant" value: 0.01 } } }\n'
    )


def check_npz(path: str, *without: str) -> object:
    if not Path(path).exists():
        return None
    with np.load(path, allow_pickle=False) as archive:
        return [archive[name].tobytes() for name in sorted(archive.files) if name not in without]


def walk_inputs() -> None:
    images(30)
    np.save("truth.npy", np.eye(30, k=-15) + np.eye(30, k=-16))


def check_report() -> object:
    """Every file of the report is complete: pictures decode, the page ends, tables end with a newline."""
    for path in sorted(Path("out").iterdir()):
        if path.suffix == ".png":
            assert cv2.imread(str(path)) is not None, f"{path} is no picture"
        elif path.suffix in (".csv", ".json", ".html") and not path.name.startswith("."):
            assert path.read_text().endswith("\n") or path.read_text().rstrip().endswith("</html>"), f"{path} is cut"
    return None


THUMBNAILS = "loopclosure.descriptors.thumbnails:Thumbnailer"


def detect_inputs() -> None:
    images(30)


def log_inputs() -> None:
    shutil.copy(GOLDEN / "log" / "caffe_train.log", "train.log")


def database_inputs() -> None:
    Path("pairs").symlink_to(GOLDEN / "pairs")


CASES = {
    "train": Case(netspec.cli.main, ["train", "solver.prototxt"], train_inputs, check_snapshots),
    "convert": Case(
        lmdb_build.cli.main, ["convert", "--workers", "2", "", "pairs.txt", "out/db"], convert_inputs, check_database
    ),
    "extract": Case(
        netspec.cli.main,
        ["extract", "--model", "net.prototxt", "--blob", "ip", "--images", "images", "--out", "out/f.npz"],
        extract_inputs,
        lambda: check_npz("out/f.npz", "seconds_per_image"),
    ),
    "evaluate": Case(
        loopclosure.cli.main,
        ["evaluate", "images,truth=truth.npy", "--method", "thumbnails", "--out", "out"],
        walk_inputs,
        check_report,
    ),
    "detect": Case(
        loopclosure.cli.main,
        ["detect", "images", "--describe", THUMBNAILS, "--threshold", "0.5", "--out", "out", "--save", "out/d.npz"],
        detect_inputs,
        lambda: check_npz("out/d.npz"),
    ),
    "plot": Case(netspec.cli.main, ["plot", "train.log", "--out", "out/x.svg"], log_inputs, check_report),
    "data": Case(
        netspec.cli.main,
        ["data", "show", "pairs/test_lmdb", "--count", "4", "--out", "out/x.png"],
        database_inputs,
        check_report,
    ),
}
