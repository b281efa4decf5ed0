"""The paper's Table I on your own sequences: pairs, databases, trainings, and the table.

python3 table_1.py --room desk_1 desk_2 --room kitchen --room hall_1 hall_2 --out table_1

Each --room has the sequences of one room, in the layout of TUM RGB-D, with poses in one frame of reference. The nets
are trained on parts of all rooms and judged on other parts. With --leave-one-out, each room is also left out of a
training once, and the nets are judged on it. Each command is printed before it runs. To continue after an interruption,
start the script again with the same options: complete files are kept, and an unfinished training is resumed.

The defaults suit a laptop. The paper's own size, on a GPU:
    --size 224 --batch 256 --iterations 30000 --train 30000 --validation 6000 --gpu 0
Run it in a clone, or in a folder with a copy of the clone's folder prototxt.
"""

import argparse
import json
import os
import re
import shlex
import sys
from importlib import import_module
from pathlib import Path
from statistics import mean

from loopclosure.report.table_one import PAPER, intervals, read_runs

NETS = ("siamese_8", "siamese_128", "siamese_resnet27_256", "siamese_resnet27_512")
ALL = "all rooms"
TEST_BATCH = 50


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", nargs="+", action="append", required=True, type=Path, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, default=Path("table_1"), help="folder for all files (default: table_1)")
    parser.add_argument("--nets", nargs="+", choices=NETS, default=NETS, help="the nets to train (default: all four)")
    parser.add_argument("--seeds", type=int, default=1, help="number of trainings of each net (default: 1)")
    parser.add_argument("--leave-one-out", action="store_true", help="also train without each room in turn")
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (default: 64)")
    parser.add_argument("--batch", type=int, default=32, help="pairs per iteration (default: 32)")
    parser.add_argument(
        "--iter-size", type=int, default=1, help="parts that a batch is computed in, to save memory (default: 1)"
    )
    parser.add_argument("--iterations", type=int, default=3000, help="iterations of each training (default: 3000)")
    parser.add_argument("--train", type=int, default=6000, help="largest number of training pairs (default: 6000)")
    parser.add_argument(
        "--validation", type=int, default=1200, help="validation pairs, at most, and as many test pairs (default: 1200)"
    )
    parser.add_argument(
        "--min-gap", default="1", help="minimum seconds between images of a pair, and between parts (default: 1)"
    )
    parser.add_argument("--gpu", help="number of the GPU (default: the CPU)")
    parser.add_argument(
        "--precision",
        default="fp32",
        help="precision of the trainings: fp32, or bf16 where the CPU or GPU has it (default: fp32)",
    )
    return parser.parse_args()


def run(*words: object) -> None:
    """Print a command of netspec, lmdb-build or loopclosure, and run it here; exit with its status if it fails."""
    program, *rest = (str(word) for word in words)
    print("$", shlex.join([program, *rest]), flush=True)
    status = import_module(f"{program.replace('-', '_')}.cli").main(rest)
    if status:
        sys.exit(status)


def make_pairs(arguments: argparse.Namespace, rooms: list[list[Path]], out: Path, counts: tuple[int, int, int]) -> None:
    """Write the lists and the databases of training, validation and test pairs of some rooms.

    A pair is positive if its poses are less than 2 m and 15 degrees apart, as in the paper. Each room is divided by
    time: 0.6 for training, 0.2 for validation, 0.2 for testing; test pairs alone are from the whole room.
    """
    root = os.path.commonpath([sequence.resolve().parent for room in arguments.room for sequence in room])
    shares = "0.6,0.2,0.2" if counts[0] else "0,0,1"
    names = ("train", "val", "test")
    if not all((out / f"{name}.txt").exists() for name, count in zip(names, counts, strict=True) if count):
        command = ["lmdb-build", "pairs", *(sequence for room in rooms for sequence in room), "--root", root]
        command += ["--split", "time", "--shares", shares, "--split-gap", arguments.min_gap]
        command += ["--min-gap", arguments.min_gap, "--different-scenes"]
        command += ["--at-most", "--out", out]
        for room in rooms:
            if len(room) > 1:
                command += ["--same-frame", ",".join(sequence.name for sequence in room)]
        for name, count in zip(names, counts, strict=True):
            command += [f"--{name}", count]
        run(*command)
    for name, count in zip(names, counts, strict=True):
        if count and not (out / f"{name}_lmdb").exists():
            size = ("-resize_width", arguments.size, "-resize_height", arguments.size)
            run("lmdb-build", "convert", *size, f"{root}/", out / f"{name}.txt", out / f"{name}_lmdb")


def write_net(arguments: argparse.Namespace, net: str, pairs: Path, folder: Path, seed: int) -> Path:
    """Write one of the paper's nets and its solver for these pairs; return the solver.

    Rate, momentum, decay and margin are the paper's. The rate is divided by 10 after each third of the iterations. The
    running means of BatchNorm look back over the same share of the training as in the paper's 30,000 iterations.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = Path("prototxt", "normalized", net, "train_val.prototxt").read_text()
    for old, new in {
        '"data/pairs_train_lmdb"': f'"{pairs / "train_lmdb"}"',
        '"data/pairs_val_lmdb"': f'"{pairs / "val_lmdb"}"',
        "batch_size: 256": f"batch_size: {arguments.batch // arguments.iter_size}",
        "batch_size: 250": f"batch_size: {TEST_BATCH}",
        "fraction: 0.999": f"fraction: {max(0.9, 1 - 30 / arguments.iterations):.4g}",
    }.items():
        text = text.replace(old, new)
    (folder / "train_val.prototxt").write_text(text)
    text = Path("prototxt", "normalized", net, "solver.prototxt").read_text()
    part = max(1, arguments.iterations // 6)
    for name, value in {
        "net": f'"{folder / "train_val.prototxt"}"',
        "test_iter": -(-arguments.validation // TEST_BATCH),
        "test_interval": part,
        "stepsize": max(1, arguments.iterations // 3),
        "max_iter": arguments.iterations,
        "display": 10,
        "average_loss": 10,
        "snapshot": part,
        "snapshot_prefix": f'"{folder / net}"',
        "random_seed": seed,
        "solver_mode": "CPU" if arguments.gpu is None else "GPU",
    }.items():
        text = re.sub(rf"^{name}: .*", f"{name}: {value}", text, flags=re.MULTILINE)
    (folder / "solver.prototxt").write_text(f"{text}iter_size: {arguments.iter_size}\n")
    return folder / "solver.prototxt"


def train(arguments: argparse.Namespace, pairs: Path, test: Path, out: Path) -> None:
    """Train each net with each seed on some pairs, and judge two snapshots on the validation and the test pairs.

    The two are that of the lowest validation loss and the last one, which may be the same.
    """
    for seed in range(1, arguments.seeds + 1):
        for net in arguments.nets:
            folder = out / net / f"seed_{seed}"
            solver = folder / "solver.prototxt"
            on = () if arguments.gpu is None else ("--gpu", arguments.gpu)
            if not (folder / "runs.json").exists():
                write_net(arguments, net, pairs, folder, seed)
                how = ("--resume", "--precision", arguments.precision)
                run("lmdb-build", "compare", solver, *how, "--test", test, *on, "--out", folder)
            best = json.loads((folder / "runs.json").read_text())[0]["iteration"]
            if best != arguments.iterations and not (folder / "last" / "runs.json").exists():
                how = ("--no-train", "--snapshot", "last")
                run("lmdb-build", "compare", solver, *how, "--test", test, *on, "--out", folder / "last")


def row(trained_on: str, net: str, snapshot: str, files: list[Path]) -> dict[str, object]:
    """Return the table's row of a net: means over the runs of its seeds, and 95 % intervals by bootstrap over pairs."""
    cells: dict[str, object] = {"net": net, "trained on": trained_on, "snapshot": snapshot, "seeds": len(files)}
    for judged in ("validation", "test"):
        runs = [read_runs(file, judged)[0] for file in files]
        ends = intervals(runs)
        for name, field in {"precision": "precision", "recall": "recall", "ROC AUC": "roc_auc"}.items():
            low, high = ends[field]
            cells[f"{judged} {name}"] = (
                f"{mean(getattr(run.metrics, field) for run in runs):.3f} ({low:.3f} to {high:.3f})"
            )
    cells["iteration"] = ", ".join(str(run.iteration) for run in runs)
    cells["precision in the paper"] = PAPER[NETS.index(net)][1]
    return cells


def main() -> None:
    """Make the table."""
    arguments = parse()
    if not Path("prototxt", "normalized").is_dir():
        sys.exit("no folder prototxt/normalized here; start this script in a clone, or copy its folder prototxt here")
    counts, out = (arguments.train, arguments.validation, arguments.validation), arguments.out
    names = (ALL, *(f"without {room[0].name}" for room in arguments.room))
    folders = {name: out / name.replace(" ", "_") for name in names}
    make_pairs(arguments, arguments.room, out / "pairs", counts)
    train(arguments, out / "pairs", out / "pairs" / "test_lmdb", folders[ALL])
    for left in arguments.room if arguments.leave_one_out else ():
        folder = folders[f"without {left[0].name}"]
        make_pairs(arguments, [room for room in arguments.room if room is not left], folder / "pairs", (*counts[:2], 0))
        make_pairs(arguments, [left], folder / "test", (0, 0, counts[2]))
        train(arguments, folder / "pairs", folder / "test" / "test_lmdb", folder)
    rows = []
    for name, folder in folders.items():
        for net in NETS:
            if best := sorted((folder / net).glob("seed_*/runs.json")):
                last = [last if (last := file.parent / "last" / "runs.json").exists() else file for file in best]
                rows += [row(name, net, "best", best), row(name, net, "last", last)]
    (out / "table.json").write_text(json.dumps(rows, indent=1))
    for cells in ({name: name for name in rows[0]}, *rows):
        print(*(f"{cell!s:<24}" for cell in cells.values()))


if __name__ == "__main__":
    main()
