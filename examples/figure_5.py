"""The paper's Figure 5 on your own sequences: nets, FAB-MAP 2.0 and thumbnails find the loops of one walk.

python3 figure_5.py SEQUENCE_1 SEQUENCE_2 --vocabulary OTHER_PLACE OFFICES --out figure_5
    --weights table_1/all_rooms/X/seed_1/X_iter_500.caffemodel table_1/without_HALL/X/seed_1/X_iter_600.caffemodel

The sequences show one place, in the layout of TUM RGB-D, with poses in one frame of reference. The last fifth of each,
which table_1.py keeps for tests, becomes a part of one walk. --start 0 shows whole sequences: for weights that were
trained without this place. FAB-MAP's vocabulary and tree are learned from images of another place; with several, each
is a method of its own. A match is right less than 2 m and 15 degrees away, as in the paper, and also less than 45.
OUT/report has the matrix of true loops, the matrix of each method, and precision against recall; OUT/table.json and the
last lines have R@1, average precision, and the times of the methods.
Run it in a clone, or in a folder with a copy of the clone's folder prototxt.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from table_1 import run

from loopclosure.places.sequences import read_sequence
from loopclosure.places.trajectory import Trajectory, write_rgb_list, write_trajectory

PAUSE_S = 60  # between two sequences of the walk
# The two angles of a report, and what follows the names of its measures.
ANGLES = {15: "", 45: "; 45 degrees"}


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="+", type=Path)
    parser.add_argument("--net", default="siamese_resnet27_512", help="folder in prototxt/normalized (%(default)s)")
    parser.add_argument("--weights", nargs="+", required=True, help="trained weights of the net, made by table_1.py")
    parser.add_argument(
        "--start",
        type=float,
        default=0.8,
        help="share of each sequence that is left out, since table_1.py trained and chose on it (default: 0.8)",
    )
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (default: 64)")
    parser.add_argument(
        "--exclude-seconds", default="10", help="frames that are nearer in time are no loop (default: 10)"
    )
    parser.add_argument(
        "--vocabulary", nargs="+", required=True, help="folders, lists or sequences with images of other places"
    )
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


def describe(arguments: argparse.Namespace, walk: Path) -> list[str]:
    """Write the descriptors of the walk by each file of weights; return the options of methods that compare them.

    A method has the name of the folder that table_1.py keeps the weights in, such as "all rooms".
    """
    net = Path("prototxt", "normalized", arguments.net, "deploy.prototxt")
    shape = f"data=1,3,{arguments.size},{arguments.size}"
    options = []
    for weights in arguments.weights:
        trained_on = Path(weights).resolve().parents[2].name
        features = arguments.out / f"{trained_on}.npz"
        extract = ["netspec", "extract", net, "--weights", weights, "--blob", "feat", "--shape", shape]
        extract += ["--mean", "128,128,128", "--scale", 1 / 128, "--images", walk / "rgb.txt", "--out", features]
        run(*extract)
        options += ["--method", f"net, {trained_on.replace('_', ' ')}=features:{features}"]
    return options


def learn(arguments: argparse.Namespace, walk: Path) -> list[str]:
    """Learn each vocabulary; return the options of the methods that use them, named by the folders of their images."""
    options = []
    for images in arguments.vocabulary:
        name = Path(images.partition(",")[0]).stem
        label = f"FAB-MAP 2.0, words of {name}"
        option = ["--method", f"{label}=fabmap", "--set", f"{label}.model={arguments.out / name}.words.npz"]
        run("loopclosure", "evaluate", walk, "--train", images, *option, "--out", arguments.out / name)
        options += option
    return options


def rows(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of each method in a report.json, by both angles.

    R@1 is the share of the frames with a loop whose best match is right; AP the average precision of all pairs.
    """
    loops = {15: summary["queries_with_a_loop"], 45: summary["wide_angle"]["queries_with_a_loop"]}
    found = []
    for method in summary["methods"]:
        row = {"method": method["name"], "images": summary["queries"]}
        for angle, suffix in ANGLES.items():
            best, pairs = (method["figures"][f"{name}{suffix}"] for name in ("best match of each query", "all pairs"))
            row[f"with a loop {angle}"] = loops[angle]
            row |= {f"R@1 {angle}": best["recall at 1"], f"AP {angle}": pairs["average precision"]}
        found.append(row)
    return found


def show_times(summary: dict[str, Any]) -> None:
    """Print the times of ``loopclosure evaluate`` for an image and for all images, and the paper's."""
    for method in summary["methods"]:
        for stage, seconds in method["seconds"].items():
            each = method["milliseconds_a_frame"].get(stage)
            text = "" if each is None else f", {each:.4g} ms an image"
            print(f"{method['name']}, {stage}: {seconds:.3g} s for {summary['queries']} images{text}")
    print("The paper: 0.23 s an image; the matrix of 1,000 images 2.8 s, by FAB-MAP 2.0 22 minutes")


def main() -> None:
    """Make the figure."""
    arguments = parse()
    walk = arguments.out / "walk"
    join(arguments.sequence, walk, arguments.start)
    methods = [*describe(arguments, walk), *learn(arguments, walk), "--method", "thumbnails"]
    report = arguments.out / "report"
    evaluate = ["loopclosure", "evaluate", walk, "--out", report, "--exclude-seconds", arguments.exclude_seconds]
    run(*evaluate, *methods)
    summary = json.loads((report / "report.json").read_text())
    table = rows(summary)
    (arguments.out / "table.json").write_text(json.dumps(table, indent=1))
    show_times(summary)
    for cells in table:
        values = [round(cell, 3) if isinstance(cell, float) else cell for cell in cells.values()]
        print(*(f"{name}: {value}" for name, value in zip(cells, values, strict=True)), sep=", ")


if __name__ == "__main__":
    main()
