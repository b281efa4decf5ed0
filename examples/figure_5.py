"""The paper's Figure 5 on your own sequences: nets, FAB-MAP 2.0 and thumbnails find the loops of one walk.

python3 figure_5.py SEQUENCE_1 SEQUENCE_2 --vocabulary OTHER_PLACE OFFICES --out figure_5
    --weights table_1/all_rooms/X/seed_1/X_iter_500.caffemodel table_1/without_HALL/X/seed_1/X_iter_600.caffemodel

The sequences show one place, in the layout of TUM RGB-D, with poses in one frame of reference. The last fifth of each,
which table_1.py keeps for tests, becomes a part of one walk. --start 0 shows whole sequences: for weights that were
trained without this place. FAB-MAP's vocabulary and tree are learned from images of another place; with several, each
is a method of its own. A match is right less than 2 m and 15 degrees away, as in the paper, and also less than 45.
OUT/report is that of loopclosure evaluate: the matrices of true loops and of each method, precision against recall,
and in report.json recall at 1, average precision and the times. Run it in a clone, or in a folder with a copy of the
clone's folder prototxt.
"""

import argparse
from pathlib import Path

import numpy as np
from table_1 import run

PAUSE_S = 60  # between two sequences of the walk


def join(folders: list[Path], out: Path, start: float) -> None:
    """Write one sequence with the last images and poses of several, one sequence after the other."""
    out.mkdir(parents=True, exist_ok=True)
    images, poses, begin = [], [], 0.0
    for folder in folders:
        link = out / folder.name
        link.unlink(missing_ok=True)
        link.symlink_to(folder.resolve())
        listed, path = np.loadtxt(folder / "rgb.txt", str), np.loadtxt(folder / "groundtruth.txt")
        listed = listed[round(start * len(listed)) :]
        first, last = listed[[0, -1], 0].astype(float)
        path, later = path[(path[:, 0] >= first - 1) & (path[:, 0] <= last + 1)], begin - first
        images += [f"{float(stamp) + later:.6f} {folder.name}/{name}" for stamp, name in listed]
        poses.append(np.column_stack([path[:, 0] + later, path[:, 1:]]))
        begin = last + later + PAUSE_S
    (out / "rgb.txt").write_text("\n".join(images) + "\n")
    np.savetxt(out / "groundtruth.txt", np.concatenate(poses), "%.9f")


def main() -> None:
    """Make the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="+", type=Path)
    parser.add_argument("--net", default="siamese_resnet27_512", help="folder in prototxt/normalized (%(default)s)")
    parser.add_argument("--weights", nargs="+", required=True, type=Path, help="weights of the net, by table_1.py")
    parser.add_argument("--start", type=float, default=0.8, help="share of each sequence to leave out (%(default)s)")
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (%(default)s)")
    parser.add_argument("--exclude-seconds", default="10", help="nearer frames are no loop (%(default)s)")
    parser.add_argument("--vocabulary", nargs="+", required=True, help="folders, lists or sequences of other places")
    parser.add_argument("--out", type=Path, default=Path("figure_5"), help="folder for all files (%(default)s)")
    a = parser.parse_args()
    walk, methods = a.out / "walk", []
    join(a.sequence, walk, a.start)
    net, shape = Path("prototxt", "normalized", a.net, "deploy.prototxt"), f"data=1,3,{a.size},{a.size}"
    for weights in a.weights:  # a method has the name of the folder that table_1.py keeps the weights in
        trained_on = weights.resolve().parents[2].name
        features = a.out / f"{trained_on}.npz"
        words = ["--blob", "feat", "--shape", shape, "--mean", "128,128,128", "--scale", 1 / 128]
        run("netspec", "extract", net, "--weights", weights, *words, "--images", walk / "rgb.txt", "--out", features)
        methods += ["--method", f"net, {trained_on.replace('_', ' ')}=features:{features}"]
    for images in a.vocabulary:
        name = Path(images.partition(",")[0]).stem
        label, model = f"FAB-MAP 2.0, words of {name}", a.out / f"{name}.words.npz"
        method = ["--method", f"{label}=fabmap", "--set", f"{label}.model={model}"]
        run("loopclosure", "evaluate", walk, "--train", images, *method, "--out", a.out / name)
        methods += method
    words = ["--exclude-seconds", a.exclude_seconds, "--method", "thumbnails", "--out", a.out / "report"]
    run("loopclosure", "evaluate", walk, *methods, *words)


if __name__ == "__main__":
    main()
