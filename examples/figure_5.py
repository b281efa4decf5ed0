"""The paper's Figure 5 on your own sequences: a net, FAB-MAP 2.0 and thumbnails find the loops of one walk.

python3 figure_5.py SEQUENCE_1 SEQUENCE_2 --weights table_1/.../siamese_resnet27_512_iter_3000.caffemodel
    --vocabulary OTHER_PLACE --out figure_5

The sequences show one place, in the layout of TUM RGB-D, with poses in one frame of reference. The last fifth of each,
which table_1.py keeps for tests, becomes a part of one walk.
FAB-MAP's vocabulary and tree are learned from images of another place. The report in OUT/report has the matrix of
true loops, the matrix of each method, and precision against recall; the last lines have the times of the methods.
Run it in a clone, or in a folder with a copy of the clone's folder prototxt.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from table_1 import run

from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import Trajectory, write_rgb_list, write_trajectory

PAUSE_S = 60  # between two sequences of the walk


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="+", type=Path)
    parser.add_argument("--net", default="siamese_resnet27_512", help="folder in prototxt/normalized (%(default)s)")
    parser.add_argument("--weights", required=True, help="trained weights of the net")
    parser.add_argument(
        "--start",
        type=float,
        default=0.8,
        help="share of each sequence that is left out, since table_1.py trained and chose on it (default: 0.8)",
    )
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (default: 64)")
    parser.add_argument("--vocabulary", required=True, help="folder or sequence with images of another place")
    parser.add_argument("--out", type=Path, default=Path("figure_5"), help="folder for all files (default: figure_5)")
    return parser.parse_args()


def join(folders: list[Path], out: Path, start_share: float) -> None:
    """Write one sequence in TUM's layout with the last images and poses of several, one sequence after the other."""
    out.mkdir(parents=True, exist_ok=True)
    names, stamps, poses, start = [], [], [], 0.0
    for folder in folders:
        link = out / folder.name
        link.unlink(missing_ok=True)
        link.symlink_to(folder.resolve())
        sequence = read_sequence(folder, "tum").with_poses()
        assert sequence.stamps is not None
        assert sequence.poses is not None
        first = round(start_share * len(sequence.names))
        names += [f"{folder.name}/{name}" for name in sequence.names[first:]]
        stamps.append(sequence.stamps[first:] - sequence.stamps[first] + start)
        poses.append(sequence.poses[first:])
        start = stamps[-1][-1] + PAUSE_S
    times, known = np.concatenate(stamps), np.concatenate(poses)
    write_rgb_list(out / "rgb.txt", zip(times, names, strict=True))
    there = np.isfinite(known).all(axis=1)
    write_trajectory(out / "groundtruth.txt", Trajectory(times[there], known[there, :3], known[there, 3:]))


def show_times(path: Path) -> None:
    """Print the times of ``loopclosure evaluate`` for an image and for all images, and the paper's."""
    with path.open() as file:
        for row in csv.DictReader(file):
            each = f", {row['milliseconds a frame']:.6} ms an image" if row["milliseconds a frame"] else ""
            print(f"{row['method']}, {row['stage']}: {float(row['seconds']):.3g} s for {row['frames']} images{each}")
    print("The paper: 0.23 s an image; the matrix of 1,000 images 2.8 s, by FAB-MAP 2.0 22 minutes")


def main() -> None:
    """Make the figure."""
    arguments = parse()
    walk, features = arguments.out / "walk", arguments.out / "features.npz"
    join(arguments.sequence, walk, arguments.start)
    net = Path("prototxt", "normalized", arguments.net, "deploy.prototxt")
    shape = f"data=1,3,{arguments.size},{arguments.size}"
    extract = ["netspec", "extract", net, "--weights", arguments.weights, "--blob", "feat", "--shape", shape]
    extract += ["--mean", "128,128,128", "--scale", 1 / 128, "--images", walk / "rgb.txt", "--out", features]
    run(*extract)
    evaluate = ["loopclosure", "evaluate", walk, "--train", arguments.vocabulary, "--out", arguments.out / "report"]
    for method in (f"features:{features}", "fabmap", "thumbnails"):
        evaluate += ["--method", method]
    run(*evaluate)
    show_times(arguments.out / "report" / "times.csv")


if __name__ == "__main__":
    main()
