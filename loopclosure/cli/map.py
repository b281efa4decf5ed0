"""``loopclosure map``."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from loopclosure.cli.data_set import recording_of, warn_of_unreadable
from loopclosure.detector import run
from loopclosure.detector.detector import Describe
from loopclosure.detector.export import write_loops_csv
from loopclosure.detector.map import Map, checked_name
from loopclosure.detector.visitor import Visitor
from loopclosure.index.index import INDEXES
from loopclosure.methods.drive import last_session
from netspec.terminal.commands import Commands
from netspec.terminal.output import bar

INDEX = "exact, faiss, or Milvus: FILE.db or http://HOST:PORT (default: exact)"


def add_to(commands: Commands) -> None:
    """Add the commands."""
    summary = "keep a map of several drives on disk: build it, add to it, query it"
    commands = Commands(commands.group("map", summary), quiet=True)
    p = commands.add("build", _build, "make a map of one or several drives")
    _add_common(p, "+")
    p.add_argument("--describe", default="default", metavar="NAME", help="the net: default or small (default: default)")
    p = commands.add("add", _add, "add drives to a map, and find the loops between all of its drives")
    _add_common(p, "+")
    p = commands.add("query", _query, "find the frames of a drive in a map, and add nothing to it")
    _add_common(p, None)
    p.add_argument("--out", required=True, metavar="FOLDER", help="where loops.csv goes")


def _add_common(p: argparse.ArgumentParser, count: str | None) -> None:
    p.add_argument("map", metavar="MAP", help="the map's folder")
    p.add_argument("source", nargs=count, metavar="SOURCE", help="frames, as those of detect")
    p.add_argument("--index", default="exact", metavar="NAME", help=INDEX)


def _build(a: argparse.Namespace) -> None:
    describe = run.load_describe(checked_name(a.describe))
    _add_all(Map.create(a.map, a.describe), describe, a)


def _add(a: argparse.Namespace) -> None:
    into = Map(a.map)
    _add_all(into, run.load_describe(into.describer), a)


def _add_all(into: Map, describe: Describe, a: argparse.Namespace) -> None:
    for text in a.source:
        before, number = len(into), len(into.sessions)
        recording = recording_of(text, Path(a.map) / "frames" / f"{number:06d}")
        results = into.add(recording, describe, a.index, bar, lambda *found: last_session(*found, progress=bar).results)
        warn_of_unreadable(recording)
        loops = [result.accepted for result in results if result.accepted is not None]
        between = sum(frame < before for frame in loops)
        said = f"{len(results)} frames, {len(loops)} loops, {between} to earlier sessions"
        print(f"session {number:06d}: {said}: {into.folder / f'{number:06d}' / 'loops.csv'}")
    print(f"{len(into)} frames in {len(into.sessions)} sessions: {into.folder}")


def _query(a: argparse.Namespace) -> None:
    known, out = Map(a.map), Path(a.out)
    recording = recording_of(a.source, out / "frames")
    detector, before = known.detector(run.load_describe(known.describer), a.index), len(known)
    if a.index in INDEXES:  # in memory: frames that are added are not in the map
        found = last_session(detector, run.run_detector(detector, recording, progress=bar), progress=bar, own=False)
        results = [replace(result, query_id=result.query_id - before) for result in found.results]
    else:
        results = run.run_detector(Visitor(detector), recording, progress=bar)
    recording = warn_of_unreadable(recording)
    loops = [result for result in results if result]
    write_loops_csv(out / "loops.csv", loops, recording.stamps, recording.names, detector.stamps, known.names)
    print(run.verdicts_said(results))
    print(f"{len(loops)} of {len(results)} frames are in the map: {out / 'loops.csv'}")
