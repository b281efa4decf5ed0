"""Compares nets trained on the same pairs, as in the paper's Table I, by running netspec's commands.

Files in the output folder, for each net:

    NAME.log, NAME.scores.json            its training (netspec train --scores); NAME.2 is the second of one net
    NAME.ITERATION.scores.json            a snapshot that the training did not test (netspec test --scores)
    NAME.train.npz, NAME.validation.npz   the descriptors of both databases' pairs (netspec extract)
    NAME.test.npz                         those of the test pairs, if a database of them is given

Each file has a log of the command that made it beside it. The tables and the pictures are made from runs.json.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from loopclosure.report.table_one import read_runs, text_table, write_report
from netspec import log
from netspec.cli.scores import Score, read_scores
from netspec.errors import SpecError, Where
from netspec.files.whole_file import write_whole
from netspec.graph.filter import filter_net, with_state
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net, read_solver

PHASES = {"train": TRAIN, "validation": TEST}
TESTING = re.compile(r"\] Iteration \d+, Testing net")
PROGRESS = ("    Test net output", "Snapshotting to", "Optimization Done")  # lines of the log to show
LOSS = re.compile(r"\] Iteration (\d+)(?: \(.*\))?, loss = (\S+)")
Say = Callable[[str], None]
Step = Callable[[int, int, str], None]  # iterations done, iterations in total, loss


@dataclass(frozen=True)
class Entry:
    """The facts about a solver and its net that the comparison needs.

    bottoms  bottoms of its ContrastiveLoss: two descriptors and the label
    loss     top of its ContrastiveLoss
    length   number of training iterations
    tests    number of batches per test
    sources  train, validation -> data layer -> database
    number   which of the trainings of its net, from 1; they have different seeds
    """

    solver: str
    net: str
    name: str
    prefix: str
    length: int
    tests: int
    bottoms: tuple[str, ...]
    loss: str
    sources: dict[str, dict[str, str]]
    number: int = 1

    @property
    def stem(self) -> str:
        """The name as part of a file's name."""
        return re.sub(r"[^\w.-]", "_", self.name) + (f".{self.number}" if self.number > 1 else "")


def read_entry(path: str) -> Entry:
    """Read a solver and its net. Raises SpecError if it is not a Siamese net."""
    solver = read_solver(path)
    if not solver.net:
        raise SpecError("no net: expected one net for both phases", Where(path))
    net, source = parse_net(solver.net)
    losses = [layer for layer in net.layer if layer.type == "ContrastiveLoss"]
    if not losses:
        raise SpecError("no ContrastiveLoss layer: expected a Siamese net", Where(solver.net))
    if not losses[0].top:
        raise SpecError(
            f'its ContrastiveLoss "{losses[0].name}" has no top; name one, so that tests show the loss',
            Where(solver.net),
        )
    with log.silent():  # about the layers that belong to the other phase
        of = {kind: filter_net(with_state(net, phase), source) for kind, phase in PHASES.items()}
    sources = {
        kind: {layer.name: layer.data_param.source for layer in filtered.layer if layer.HasField("data_param")}
        for kind, (filtered, _) in of.items()
    }
    if len(sources["train"]) != len(sources["validation"]):
        found = " and ".join(f"{len(layers)} in {kind}" for kind, layers in sources.items())
        raise SpecError(f"found data layers: {found}; expected the same number in both phases", Where(solver.net))
    trained = {os.path.realpath(database) for database in sources["train"].values()}
    filtered, places = of["validation"]
    for i, layer in enumerate(filtered.layer):
        if layer.HasField("data_param") and os.path.realpath(layer.data_param.source) in trained:
            message = (
                f'phase TEST reads "{layer.data_param.source}", which the net is trained on: its pairs are no '
                "validation pairs; give phase TEST a data layer with another database"
            )
            raise SpecError(message, places.at(i, "data_param", "source", layer=layer.name, type=layer.type))
    return Entry(
        solver=path,
        net=solver.net,
        name=net.name or Path(path).parent.name,
        prefix=solver.snapshot_prefix,
        length=solver.max_iter,
        tests=solver.test_iter[0] if solver.test_iter else 1,
        bottoms=tuple(losses[0].bottom),
        loss=losses[0].top[0],
        sources=sources,
    )


@dataclass(frozen=True)
class Choices:
    """What ``compare`` does besides its default.

    train      False: evaluate the snapshots of earlier trainings
    resume     resume each training from its newest snapshot
    test       databases of test pairs, one for each data layer of a net; () for none
    gpu        netspec's ``--gpu``
    precision  of the trainings, netspec's ``--precision``
    snapshot   which one is evaluated: "best", that of the lowest validation loss, or "last"
    """

    train: bool = True
    resume: bool = False
    test: tuple[str, ...] = ()
    gpu: str = ""
    precision: str = "fp32"
    snapshot: str = "best"


def compare(
    solvers: Sequence[str], out: Path, choices: Choices, say: Say, step: Step = lambda *_: None
) -> tuple[str, list[Path]]:
    """Train the nets of the solvers and evaluate a snapshot of each; return the tables and the report's files.

    Solvers of one net are its trainings with several seeds; the tables have their means.
    ``say`` is called with messages, ``step`` with the progress of each training. Raises SpecError or InputError for
    faults in the files.
    """
    entries = list[Entry]()
    for path in solvers:
        entry = read_entry(path)
        entry = replace(entry, number=1 + sum(other.net == entry.net for other in entries))
        if entry.prefix and entry.prefix in [other.prefix for other in entries]:
            fault = f'found a second training with snapshot_prefix "{entry.prefix}"; give each training its own'
            raise SpecError(fault, Where(entry.solver))
        if entry.stem in [other.stem for other in entries]:
            raise SpecError(f'found a second net named "{entry.name}"; give each net its own name', Where(entry.net))
        entries.append(entry)
        layers = entry.sources["validation"]
        if choices.test and len(choices.test) != len(layers):
            found = f"{len(choices.test)} for a net with {len(layers)} data layers"
            raise SpecError(f"databases of test pairs: {found}; give one for each layer", Where(entry.net))
    out.mkdir(parents=True, exist_ok=True)
    runs = []
    for entry in entries:
        if choices.train:
            say(f"Training {entry.name} ({entry.solver})")
            words = ["train", "--solver", entry.solver, "--scores", str(out / f"{entry.stem}.scores.json")]
            words += ["--precision", choices.precision, *(["--resume"] if choices.resume else [])]
            _netspec([*words, *_on(choices.gpu)], out / f"{entry.stem}.log", say, step, entry.length)
        runs.append(_judged(entry, out, choices, say))
    file = out / "runs.json"
    write_whole(file, json.dumps(runs, indent=1))
    judged = read_runs(file)
    tables = [text_table(judged)]
    if choices.test:
        tables.append(text_table(read_runs(file, "test"), "test"))
    return "\n\n".join(tables), write_report(judged, out)


def _judged(entry: Entry, out: Path, choices: Choices, say: Say) -> dict[str, Any]:
    """Extract the descriptors of a net and return its entry of the run file."""
    gpu = choices.gpu.replace("all", "0").partition(",")[0]
    saved, losses = _snapshots(entry, out)
    for iteration, path in saved.items():
        if iteration not in losses and choices.snapshot == "best":
            scores = out / f"{entry.stem}.{iteration}.scores.json"
            words = ["test", "--model", entry.net, "--weights", str(path), "--iterations", str(entry.tests)]
            _netspec([*words, "--scores", str(scores), *_on(gpu)], scores.with_suffix(".log"), say)
            losses[iteration] = _loss(entry, read_scores(scores).tests[0], scores)
    chosen = max(saved) if choices.snapshot == "last" else best_snapshot(list(saved), losses)
    run: dict[str, Any] = {
        "name": entry.name,
        "iteration": chosen,
        "losses": sorted(losses.items()),
        "descriptors": entry.bottoms[:2],
        "label": entry.bottoms[2],
    }
    databases = {kind: tuple(entry.sources[kind].values()) for kind in PHASES}
    if choices.test:
        databases["test"] = choices.test
    for kind, sources in databases.items():
        say(f"Distances of the {kind} pairs: {entry.name}, iteration {chosen}")
        features = out / f"{entry.stem}.{kind}.npz"
        words = ["extract", "--model", entry.net, "--weights", str(saved[chosen]), "--phase", "TEST"]
        words += ["--blob", *entry.bottoms, "--out", str(features)]
        for layer, database in zip(entry.sources["validation"], sources, strict=True):
            words += ["--source", f"{layer}={database}"]
        _netspec([*words, *_on(gpu)], features.with_suffix(".log"), say)
        run[kind] = str(features)
    return run


def best_snapshot(saved: Sequence[int], losses: dict[int, float]) -> int:
    """Return the saved iteration of the smallest loss, the first of equal ones. NaN counts as the largest loss."""
    return min(saved, key=lambda k: (math.inf if math.isnan(losses[k]) else losses[k], k))


def _snapshots(entry: Entry, out: Path) -> tuple[dict[int, Path], dict[int, float]]:
    """Return the snapshots by iteration, and the validation losses that are known.

    If the output folder has the scores of a training, only its snapshots are returned, not those of other trainings
    with the same prefix. Otherwise all existing snapshots are returned.
    """
    file = out / f"{entry.stem}.scores.json"
    if file.is_file():
        scores = read_scores(file)
        saved = {s.iteration: Path(s.path) for s in scores.snapshots if Path(s.path).is_file()}
        if not saved:
            raise SpecError(f"none of the snapshots of its training was found (see {file})", Where(entry.solver))
        tested = [(score.iteration, score) for score in scores.tests if score.net == 0]
        return saved, {k: _loss(entry, score, file) for k, score in tested if k is not None}
    prefix = Path(entry.prefix)
    pattern = re.compile(re.escape(prefix.name) + r"_iter_(\d+)\.caffemodel(\.h5)?$")
    found = {int(m[1]): path for path in prefix.parent.glob("*") if (m := pattern.match(path.name))}
    if not found:
        raise SpecError("no snapshot of this net; train it first (without --no-train)", Where(entry.prefix))
    return dict(sorted(found.items())), {}


def _loss(entry: Entry, score: Score, file: Path) -> float:
    if entry.loss not in score.outputs:
        names = ", ".join(score.outputs)
        raise SpecError(f'no output "{entry.loss}", the ContrastiveLoss; the test net has: {names}', Where(str(file)))
    return score.outputs[entry.loss][0]


def _on(gpu: str) -> list[str]:
    return ["--gpu", gpu] if gpu else []


def _netspec(words: list[str], log: Path, say: Say, step: Step = lambda *_: None, length: int = 0) -> None:
    """Run a command of netspec; keep its log in a file, and show its progress.

    Raises SpecError with the command's last line if it fails.
    """
    packages = str(Path(__file__).parents[1])  # netspec is in the same folder as this package
    path = os.pathsep.join(filter(None, (packages, os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", "netspec", *words]
    environment = {**os.environ, "PYTHONPATH": path}
    with (
        log.open("w", encoding="utf-8") as file,
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process,
    ):
        assert process.stderr is not None
        try:
            last = _relay(process.stderr, file, say, step, length)
        except KeyboardInterrupt:  # the command got SIGINT too: a training writes a snapshot and ends
            _relay(process.stderr, file, say, step, length)
            raise
    if process.returncode:
        raise SpecError(last if process.returncode == 1 else f"netspec {words[0]} failed: {last or process.returncode}")


def _relay(stream: IO[str], file: IO[str], say: Say, step: Step, length: int) -> str:
    """Copy the lines of a log to a file and show those about progress; return the last one."""
    line = ""
    for line in stream:
        file.write(line)
        if found := LOSS.search(line):
            step(int(found[1]), length, found[2])
        if TESTING.search(line) or line.partition("] ")[2].startswith(PROGRESS):
            say(line.rstrip("\n"))
    return line.rstrip("\n")
