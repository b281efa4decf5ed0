"""The paper's Figure 5 on your own sequences: a net, FAB-MAP 2.0 and thumbnails find the loops of one walk.

python3 figure_5.py SEQUENCE_1 SEQUENCE_2 --weights table_1/.../siamese_resnet27_512_iter_3000.caffemodel
    --vocabulary OTHER_PLACE --out figure_5

The sequences show one place, in the layout of TUM RGB-D, with poses in one frame of reference. They become one walk.
FAB-MAP's vocabulary and tree are learned from images of another place. The report in OUT/report has the matrix of
true loops, the matrix of each method, and precision against recall; the last lines have the times of the methods.
Run it in a clone, or in a folder with a copy of the clone's folder prototxt.
"""

import argparse
import csv
import shlex
import subprocess
import sys
from pathlib import Path

PAUSE_S = 60  # between two sequences of the walk


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="+", type=Path)
    parser.add_argument("--net", default="siamese_resnet27_512", help="folder in prototxt/normalized (%(default)s)")
    parser.add_argument("--weights", required=True, help="trained weights of the net")
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (default: 64)")
    parser.add_argument("--vocabulary", required=True, help="folder or sequence with images of another place")
    parser.add_argument("--out", type=Path, default=Path("figure_5"), help="folder for all files (default: figure_5)")
    return parser.parse_args()


def rows(path: Path) -> list[list[str]]:
    """Return the rows of a file in TUM's format, split into words; the first word is a time."""
    return [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]


def join(sequences: list[Path], out: Path) -> None:
    """Write one sequence in TUM's layout that has the images and poses of several, one after the other."""
    images, poses, start = [], [], 0.0
    for sequence in sequences:
        found = rows(sequence / "rgb.txt")
        first = float(found[0][0])
        link = out / sequence.name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(sequence.resolve())
        for joined, each in ((images, found), (poses, rows(sequence / "groundtruth.txt"))):
            joined += [[f"{float(row[0]) - first + start:.6f}", *row[1:]] for row in each]
        images[-len(found) :] = [[row[0], f"{sequence.name}/{row[1]}"] for row in images[-len(found) :]]
        start = float(images[-1][0]) + PAUSE_S
    for name, joined in (("rgb.txt", images), ("groundtruth.txt", poses)):
        (out / name).write_text("".join(" ".join(row) + "\n" for row in joined))


def run(*words: object) -> None:
    """Print a command and run it; exit with its status if it fails."""
    command = [str(word) for word in words]
    print("$", shlex.join(command), flush=True)
    status = subprocess.run([sys.executable, "-m", *command], check=False).returncode
    if status:
        sys.exit(status)


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
    join(arguments.sequence, walk)
    net = Path("prototxt", "normalized", arguments.net, "deploy.prototxt")
    shape = f"data=1,3,{arguments.size},{arguments.size}"
    prepared = ("--mean", "128,128,128", "--scale", 1 / 128)
    run(
        *("netspec", "extract", net, "--weights", arguments.weights, "--blob", "feat", "--shape", shape),
        *(*prepared, "--images", walk / "rgb.txt", "--out", features),
    )
    methods = [f"features:{features}", "fabmap", "thumbnails"]
    run(
        *("loopclosure", "evaluate", walk, *(word for method in methods for word in ("--method", method))),
        *("--train", arguments.vocabulary, "--out", arguments.out / "report"),
    )
    show_times(arguments.out / "report" / "times.csv")


if __name__ == "__main__":
    main()
