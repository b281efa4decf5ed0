"""The paper's Table I on your own sequences: pairs, databases, and the table of lmdb-build compare.

python3 table_1.py --room desk_1 desk_2 --room kitchen --room hall_1 hall_2 --out table_1

Each --room has the sequences of one room, in the layout of TUM RGB-D, with poses in one frame of reference. The nets
are trained on parts of all rooms and judged on other parts. With --leave-one-out, each room is also left out of a
training once, and the nets are judged on it. The same command again continues after an interruption. Run it in a clone,
or in a folder with a copy of the clone's folder prototxt. docs/paper.md has the paper's own size.
"""

import argparse
import os
import shlex
from importlib import import_module
from pathlib import Path

from netspec.proto.text import read_net, read_solver, write_text

NETS = ("siamese_8", "siamese_128", "siamese_resnet27_256", "siamese_resnet27_512")
TEST_BATCH, GAP = 50, 1  # the least seconds between the images of a pair, and between training and other images


def run(*words: object) -> None:
    """Print a command of netspec, lmdb-build or loopclosure, and run it here; exit with its status if it fails."""
    program, *rest = (str(word) for word in words)
    print("$", shlex.join([program, *rest]), flush=True)
    if status := import_module(f"{program.replace('-', '_')}.cli").main(rest):
        raise SystemExit(status)


def make_pairs(a: argparse.Namespace, rooms: list[list[Path]], out: Path, counts: dict[str, int]) -> None:
    """Write so many pairs of some rooms for each split, by the paper's rule; a room is divided by time."""
    root = os.path.commonpath([sequence.resolve().parent for room in a.room for sequence in room])
    shares = "0.6,0.2,0.2" if counts["train"] else "0,0,1"
    if not all((out / f"{name}.txt").exists() for name, count in counts.items() if count):
        words = [sequence for room in rooms for sequence in room]
        words += ["--root", root, "--split", "time", "--shares", shares, "--split-gap", GAP]
        words += ["--min-gap", GAP, "--different-scenes", "--at-most", "--out", out]
        for room in rooms:
            words += ["--same-frame", ",".join(sequence.name for sequence in room)] if len(room) > 1 else []
        run("lmdb-build", "pairs", *words, *(word for name in counts for word in (f"--{name}", counts[name])))
    for name, count in counts.items():
        if count and not (out / f"{name}_lmdb").exists():
            size = ("-resize_width", a.size, "-resize_height", a.size)
            run("lmdb-build", "convert", *size, f"{root}/", out / f"{name}.txt", out / f"{name}_lmdb")


def write_solvers(a: argparse.Namespace, name: str, pairs: Path, folder: Path) -> list[Path]:
    """Write one of the paper's nets for these pairs, and a solver for each seed; return the solvers.

    The settings are the paper's; rates and BatchNorm's means are for the same shares of the training.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source, solvers = Path("prototxt", "normalized", name), []
    net, solver = read_net(source / "train_val.prototxt"), read_solver(source / "solver.prototxt")
    train, validation = (layer.data_param for layer in net.layer if layer.type == "Data")
    train.source, train.batch_size = str(pairs / "train_lmdb"), a.batch
    validation.source, validation.batch_size = str(pairs / "val_lmdb"), TEST_BATCH
    for layer in net.layer:
        if layer.type == "BatchNorm":
            layer.batch_norm_param.moving_average_fraction = max(0.9, 1 - 30 / a.iterations)
    (folder / "train_val.prototxt").write_text(write_text(net))
    solver.net, solver.max_iter = str(folder / "train_val.prototxt"), a.iterations
    solver.test_iter[:], solver.stepsize = [-(-a.validation // TEST_BATCH)], max(1, a.iterations // 3)
    solver.test_interval = solver.snapshot = max(1, a.iterations // 6)
    for seed in range(1, a.seeds + 1):
        solvers.append(folder / f"seed_{seed}" / "solver.prototxt")
        solvers[-1].parent.mkdir(exist_ok=True)
        solver.random_seed, solver.solver_mode = seed, int(a.gpu is not None)
        solver.snapshot_prefix = str(solvers[-1].with_name(name))
        solvers[-1].write_text(write_text(solver))
    return solvers


def compare(a: argparse.Namespace, pairs: Path, test: Path, out: Path) -> None:
    """Train each net with each seed on some pairs, and judge it on the validation and the test pairs."""
    if not (out / "table.csv").exists():
        solvers = [solver for net in a.nets for solver in write_solvers(a, net, pairs, out / net)]
        words = ["--resume", "--precision", a.precision, "--test", test, *(["--gpu", a.gpu] if a.gpu else [])]
        run("lmdb-build", "compare", *solvers, *words, "--out", out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", nargs="+", action="append", required=True, type=Path, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, default=Path("table_1"), help="folder for all files (%(default)s)")
    parser.add_argument("--nets", nargs="+", choices=NETS, default=NETS, help="the nets to train (all four)")
    parser.add_argument("--seeds", type=int, default=1, help="number of trainings of each net (%(default)s)")
    parser.add_argument("--leave-one-out", action="store_true", help="also train without each room in turn")
    parser.add_argument("--size", type=int, default=64, help="side of the images in pixels (%(default)s)")
    parser.add_argument("--batch", type=int, default=32, help="pairs per iteration (%(default)s)")
    parser.add_argument("--iterations", type=int, default=3000, help="iterations of each training (%(default)s)")
    parser.add_argument("--train", type=int, default=6000, help="training pairs, at most (%(default)s)")
    parser.add_argument("--validation", type=int, default=1200, help="validation and test pairs, at most (%(default)s)")
    parser.add_argument("--gpu", help="number of the GPU (default: the CPU)")
    parser.add_argument("--precision", default="fp32", help="of the trainings: fp32, or bf16 if the machine has it")
    a = parser.parse_args()
    counts = {"train": a.train, "val": a.validation, "test": a.validation}
    make_pairs(a, a.room, a.out / "pairs", counts)
    compare(a, a.out / "pairs", a.out / "pairs" / "test_lmdb", a.out / "all_rooms")
    for left in a.room if a.leave_one_out else ():
        folder = a.out / f"without_{left[0].name}"
        make_pairs(a, [room for room in a.room if room is not left], folder / "pairs", {**counts, "test": 0})
        make_pairs(a, [left], folder / "test", {"train": 0, "val": 0, "test": a.validation})
        compare(a, folder / "pairs", folder / "test" / "test_lmdb", folder)


if __name__ == "__main__":
    main()
