#!/usr/bin/env python3
"""Train nets on the same pairs and print the table that compares them (the paper's Table I).

    tools/compare.py prototxt/small/siamese_8/solver.prototxt prototxt/small/siamese_128/solver.prototxt

Each step leaves a file in --out: the training's log, the descriptors of both databases' pairs, then the run file from
which the table and the pictures are made.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from loopclosure.errors import InputError
from loopclosure.report.table_one import read_runs, text_table, write_report
from netspec.check.training_log import read_test_scores
from netspec.errors import SpecError, Where
from netspec.graph.filter import filter_net, with_state
from netspec.proto.text import parse_net, read_solver

SHOWN = re.compile(r"\] (Iteration \d+|    Test net output|Snapshotting to|Optimization Done)")
PHASES = {"train": 0, "validation": 1}


@dataclass(frozen=True)
class Entry:
    """What the table needs to know of one solver's net."""

    solver: str
    net: str
    name: str
    prefix: str
    tests: int
    bottoms: tuple[str, ...]  # of the ContrastiveLoss: two descriptors and the label
    loss: str
    sources: dict[str, dict[str, str]]  # train, validation -> data layer -> database


def read_entry(path: str) -> Entry:
    """Read what is needed off the solver and its net."""
    solver = read_solver(path)
    if not solver.net:
        raise SpecError("no net: expected one net for both phases", Where(path))
    net, source = parse_net(solver.net)
    losses = [layer for layer in net.layer if layer.type == "ContrastiveLoss"]
    if not losses:
        raise SpecError("no ContrastiveLoss layer: expected a Siamese net", Where(solver.net))
    sources = {}
    for kind, phase in PHASES.items():
        filtered, _ = filter_net(with_state(net, phase), source)
        sources[kind] = {
            layer.name: layer.data_param.source for layer in filtered.layer if layer.HasField("data_param")
        }
    return Entry(
        solver=path,
        net=solver.net,
        name=net.name or Path(path).parent.name,
        prefix=solver.snapshot_prefix,
        tests=solver.test_iter[0] if solver.test_iter else 1,
        bottoms=tuple(losses[0].bottom),
        loss=losses[0].top[0] if losses[0].top else "",
        sources=sources,
    )


def netspec(*arguments: str, log: Path) -> None:
    """Run one netspec command; keep its log in a file and show the lines that tell progress."""
    command = [sys.executable, "-m", "netspec", *arguments]
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path}
    with (
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process,
        log.open("w") as file,
    ):
        assert process.stderr is not None
        line = ""
        for line in process.stderr:
            file.write(line)
            if SHOWN.search(line):
                print(line, end="", file=sys.stderr, flush=True)
    if process.returncode:
        print(line, end="", file=sys.stderr)
        sys.exit(process.returncode)


def snapshots(entry: Entry, log: Path) -> dict[int, Path]:
    """Return the snapshots there are, by iteration: those that the log tells of, where it tells of any."""
    folder = Path(entry.prefix).parent
    pattern = re.compile(re.escape(Path(entry.prefix).name) + r"_iter_(\d+)\.caffemodel(\.h5)?$")
    found = {int(m[1]): path for path in folder.glob("*") if (m := pattern.match(path.name))}
    if not found:
        raise SpecError("no snapshot of this net; train it first (without --no-train)", Where(entry.prefix))
    written = set(log.read_text(errors="replace").split()) if log.is_file() else set()
    return {iteration: path for iteration, path in found.items() if str(path) in written} or found


def best_snapshot(entry: Entry, log: Path, out: Path) -> tuple[int, Path, list[tuple[int, float]]]:
    """Return iteration and path of the snapshot with the smallest validation loss, and all validation losses met.

    Snapshots whose training left no log here are scored by ``netspec test``.
    """
    saved = snapshots(entry, log)
    losses = dict(read_test_scores(log, entry.loss)) if log.is_file() else {}
    for iteration, path in sorted(saved.items()):
        if iteration not in losses:
            score = out / f"{entry.name}_{iteration}.test.log"
            netspec("test", "--model", entry.net, "--weights", str(path), "--iterations", str(entry.tests), log=score)
            match = re.search(rf"\] {re.escape(entry.loss)} = (\S+)", score.read_text())
            losses[iteration] = float(match[1]) if match else float("inf")
    best = min(saved, key=lambda iteration: (losses[iteration], iteration))
    return best, saved[best], sorted(losses.items())


def main() -> int:
    """Run the chain; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("solvers", nargs="+", metavar="SOLVER", help="solver prototxt files of Siamese nets")
    parser.add_argument("--no-train", action="store_true", help="take the snapshots that there are")
    parser.add_argument(
        "--out", type=Path, default=Path("out/compare"), help="folder for all files (default: out/compare)"
    )
    parser.add_argument("--gpu", default="", help="the GPU to run on")
    arguments = parser.parse_args()
    gpu = ["--gpu", arguments.gpu] if arguments.gpu else []
    try:
        out: Path = arguments.out
        out.mkdir(parents=True, exist_ok=True)
        entries = [read_entry(path) for path in arguments.solvers]
        runs = []
        for entry in entries:
            log = out / f"{entry.name}.log"
            if not arguments.no_train:
                print(f"Training {entry.name} ({entry.solver})", file=sys.stderr)
                netspec("train", "--solver", entry.solver, *gpu, log=log)
            iteration, weights, losses = best_snapshot(entry, log, out)
            run = {
                "name": entry.name,
                "iteration": iteration,
                "losses": losses,
                "descriptors": entry.bottoms[:2],
                "label": entry.bottoms[2],
            }
            for kind in PHASES:
                print(f"Distances of the {kind} pairs: {entry.name}, iteration {iteration}", file=sys.stderr)
                features = out / f"{entry.name}.{kind}.npz"
                sources = [
                    word
                    for layer, database in zip(entry.sources["validation"], entry.sources[kind].values(), strict=True)
                    for word in ("--source", f"{layer}={database}")
                ]
                netspec(
                    *("extract", "--model", entry.net, "--weights", str(weights), "--blob", *entry.bottoms),
                    *(*sources, "--phase", "TEST", "--out", str(features), *gpu),
                    log=out / f"{entry.name}.extract.log",
                )
                run[kind] = str(features)
            runs.append(run)
        file = out / "runs.json"
        file.write_text(json.dumps(runs, indent=1))
        judged = read_runs(file)
        print(text_table(judged))
        for path in write_report(judged, out):
            print(f"wrote {path}", file=sys.stderr)
    except (SpecError, InputError) as fault:
        print(fault, file=sys.stderr)
        return 1
    return 0


sys.exit(main())
