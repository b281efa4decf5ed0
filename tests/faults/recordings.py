"""Small sequences and bags, and functions that read each to its end."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from loopclosure.places.bags import open_bag
from loopclosure.places.masks import read_matches
from loopclosure.places.pose_files import read_poses
from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import moved
from places_bags import Bag
from places_layouts import MOUNT, euroc_rows, kitti_rows, path, tum_rows, write_pictures

COUNT = 4
EUROC_LISTING, EUROC_SENSOR = "mav0/cam0/data.csv", "mav0/cam0/sensor.yaml"
EUROC_POSES = "mav0/state_groundtruth_estimate0/data.csv"
BAG_FILE = "x.db3"  # rosbags names it after its folder


def euroc(folder: Path) -> None:
    stamps = [1403636579 * 10**9 + i * 10**9 for i in range(COUNT)]
    write_pictures(folder / "mav0" / "cam0" / "data", [f"{stamp}.png" for stamp in stamps])
    rows = ", ".join(f"{value:g}" for value in MOUNT.ravel())
    texts = {
        EUROC_LISTING: "#timestamp [ns],filename\n" + "".join(f"{stamp},{stamp}.png\n" for stamp in stamps),
        EUROC_SENSOR: f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\nresolution: [32, 24]\n"
        "intrinsics: [28.5, 28.25, 15.5, 11.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n",
        EUROC_POSES: euroc_rows(path()[:COUNT] @ np.linalg.inv(MOUNT)),
    }
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def kitti(folder: Path) -> None:
    write_pictures(folder / "image_2", [f"{i:06d}.png" for i in range(COUNT)])
    (folder / "times.txt").write_text("".join(f"{i:.6e}\n" for i in range(COUNT)))
    (folder / "calib.txt").write_text("P0: 30 0 15.5 0 0 30 11.5 0 0 0 1 0\nP2: 30 0 15.5 1.8 0 30 11.5 0 0 0 1 0\n")
    (folder / "poses.txt").write_text(kitti_rows(path()[:COUNT]))


def read_folder(folder: Path) -> None:
    read_sequence(folder).with_poses()


def bag(file: Path) -> None:
    Bag(file, 1 if file.suffix == ".bag" else 2, "mono8", count=COUNT)


def read_bag(file: Path) -> None:
    with open_bag(file) as opened:
        for _ in opened.images():
            pass
        opened.camera()
        opened.poses()


def poses(file: Path) -> None:
    file.write_text(tum_rows(path()[:12]))


def all_poses(file: Path) -> None:
    moved(read_poses(file).poses, MOUNT)


def lists(file: Path) -> None:
    file.write_text("[[0, [0, 1]], [1, [1]], [2, [2, 3]]]")


def read_matches_of_four(file: Path) -> None:
    read_matches(file, 4, 5)
