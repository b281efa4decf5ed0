"""Commands that write files, with their inputs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import lmdb_build.cli
import loopclosure.cli
import netspec.cli
from paths import GOLDEN

Main = Callable[[list[str]], int]


@dataclass
class Case:
    """A command; its inputs are in its working directory, its outputs in the folder ``out`` there."""

    main: Main
    words: list[str]
    prepare: Callable[[], None]


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


def convert_inputs() -> None:
    paths = images(160)
    lines = [f"{a} {b} {i % 2}" for i, (a, b) in enumerate(zip(paths[::2], paths[1::2], strict=True))]
    Path("pairs.txt").write_text("\n".join(lines) + "\n")


def extract_inputs() -> None:
    images(12)
    Path("net.prototxt").write_text(
        'input: "data" input_dim: 1 input_dim: 3 input_dim: 48 input_dim: 64\n'
        'layer { name: "p" type: "Pooling" bottom: "data" top: "p" pooling_param { pool: AVE global_pooling: true } }\n'
        'layer { name: "ip" type: "InnerProduct" bottom: "p" top: "ip" inner_product_param { num_output: 5000\n'
        'weight_filler { type: "constant" value: 0.01 } } }\n'
    )


def walk_inputs() -> None:
    images(30)
    np.save("truth.npy", np.eye(30, k=-15) + np.eye(30, k=-16))


THUMBNAILS = "loopclosure.descriptors.thumbnails:Thumbnailer"


def detect_inputs() -> None:
    images(30)


CASES = {
    "train": Case(netspec.cli.main, ["train", "solver.prototxt"], train_inputs),
    "convert": Case(lmdb_build.cli.main, ["convert", "--workers", "2", "", "pairs.txt", "out/db"], convert_inputs),
    "extract": Case(
        netspec.cli.main,
        ["extract", "--model", "net.prototxt", "--blob", "ip", "--images", "images", "--out", "out/f.npz"],
        extract_inputs,
    ),
    "evaluate": Case(
        loopclosure.cli.main,
        ["evaluate", "images,truth=truth.npy", "--method", "thumbnails", "--out", "out"],
        walk_inputs,
    ),
    "detect": Case(
        loopclosure.cli.main,
        ["detect", "images", "--describe", THUMBNAILS, "--out", "out"],
        detect_inputs,
    ),
}
