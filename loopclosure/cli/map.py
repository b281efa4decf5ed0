"""``loopclosure map``: a map of several drives, and where the frames of a drive are in it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from loopclosure.closing.close import summary
from loopclosure.closing.locate import LOCATED, Located, Locator, located_said, place_errors_said
from loopclosure.closing.sessions import close_map, write_closed_map
from loopclosure.detector import run
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.describers import load_describe
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import write_loops_csv
from loopclosure.detector.map import EXTRACTED, Map, checked_name
from loopclosure.detector.visitor import Visitor
from loopclosure.index.index import INDEXES
from loopclosure.methods.drive import last_session
from loopclosure.opening import readable, recording_of
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import FORM
from netspec.files.paths import inside
from netspec.terminal.output import bar
from netspec.terminal.parser import Commands


def add_commands(commands: Commands) -> None:
    """Add ``map`` and its commands."""
    known_map = commands.add_group("map", help="keep a map of several drives on disk: build it, add to it, query it")
    _add_build(known_map)
    _add_drives(known_map.add_parser("add", _add, help="add drives to a map and find the loops between all its drives"))
    _add_query(known_map)
    _add_close(known_map)


def _add_map(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", metavar="MAP", help="the map's folder")


def _add_index(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--index",
        default="exact",
        metavar="NAME",
        help="exact, faiss, or Milvus: FILE.db or http://HOST:PORT (default: %(default)s)",
    )


def _add_camera(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--camera", metavar="NUMBERS", help=f"{FORM}, if a source has no calibration")


def _add_drives(parser: argparse.ArgumentParser) -> None:
    _add_map(parser)
    parser.add_argument("source", nargs="+", metavar="SOURCE", help="frames, as for detect")
    _add_index(parser)
    _add_camera(parser)


def _add_build(commands: Commands) -> None:
    parser = commands.add_parser("build", _build, help="build a map of one or several drives")
    _add_drives(parser)
    parser.add_argument(
        "--describe", default="default", metavar="NAME", help="the net, default or small (default: %(default)s)"
    )


def _build(a: argparse.Namespace) -> None:
    load_describe(checked_name(a.describe))
    recordings = _recordings(a, 0)  # before the map is made, in case a name is mistyped
    _add_all(Map.create(a.map, a.describe), recordings, a.index)


def _add(a: argparse.Namespace) -> None:
    into = Map(a.map)
    _add_all(into, _recordings(a, len(into.sessions)), a.index)


def _recordings(a: argparse.Namespace, first: int) -> list[ImageSequence]:
    """Open all sources of a command, which become session ``first`` of the map and those after it."""
    folders = [inside(a.map, EXTRACTED, f"{number:06d}") for number in range(first, first + len(a.source))]
    return [recording_of(text, folder, a.camera) for text, folder in zip(a.source, folders, strict=True)]


def _add_all(into: Map, recordings: list[ImageSequence], index: str) -> None:
    for recording in recordings:
        before = len(into)
        results = into.add(recording, None, index, bar, _decided)
        readable(recording)
        loops = [result.match for result in results if result.match is not None]
        between = sum(frame < before for frame in loops)
        summary = f"{len(results)} frames, {len(loops)} loops, {between} to earlier sessions"
        folder = into.sessions[-1].folder
        print(f"session {folder.name}: {summary}: {folder / 'loops.csv'}")
    sessions = len(into.sessions)
    print(f"{len(into)} frames in {sessions} session{'s' * (sessions != 1)}: {into.folder}")


def _decided(detector: LoopDetector, own: bool = True) -> list[LoopResult]:
    found = last_session(detector, own=own, progress=bar)
    print("\n".join(found.reasons))
    return found.results


def _add_query(commands: Commands) -> None:
    parser = commands.add_parser("query", _query, help="find the frames of a drive in a map, without adding them")
    _add_map(parser)
    parser.add_argument("source", metavar="SOURCE", help="frames, as for detect")
    _add_index(parser)
    _add_camera(parser)
    parser.add_output("--out", folder=True, required=True, metavar="FOLDER", help="folder for loops.csv")


def _query(a: argparse.Namespace) -> None:
    known, out = Map(a.map), Path(a.out)
    recording = recording_of(a.source, out / "frames", a.camera)
    detector, before = known.detector(index=a.index), len(known)
    if a.index in INDEXES:  # in memory: the frames are added to the detector, not to the map
        run.remember_all(detector, recording, progress=bar)
        results = _decided(detector, own=False)
        results = [replace(result, query=result.query - before) for result in results]
    else:
        results = run.run_detector(Visitor(detector), recording, progress=bar)
    recording = readable(recording)
    loops = [result for result in results if result]
    found, said = _located(known, recording, loops)
    measured = LOCATED, {frame: each.cells() for frame, each in found.items()}
    write_loops_csv(
        out / "loops.csv", loops, recording.stamps, recording.names, (detector.stamps, known.names), measured
    )
    print(run.verdicts_said(results))
    print(f"{len(loops)} of {len(results)} frames are in the map: {out / 'loops.csv'}")
    print("\n".join(said), end="\n" if said else "")


def _located(known: Map, recording: ImageSequence, loops: Sequence[LoopResult]) -> tuple[dict[int, Located], list[str]]:
    """Return where the camera was for each loop, and sentences about it."""
    if not loops:
        return {}, []
    if recording.camera is None:
        return {}, ["not located: the source of the query has no calibration of its camera"]
    locator = Locator(known, recording.camera)
    found = locator.locate_all(recording, loops, bar)
    said = located_said(found, loops, locator)
    if recording.poses is not None and (errors := place_errors_said(found, recording.poses)):
        said.append(errors)
    return found, said


def _add_close(commands: Commands) -> None:
    parser = commands.add_parser(
        "close", _close, help="join the sessions of a map by their loops, and correct their paths"
    )
    _add_map(parser)
    parser.add_output("--out", folder=True, required=True, metavar="FOLDER", help="folder for the paths and closed.g2o")


def _close(a: argparse.Namespace) -> None:
    out = Path(a.out)
    found = close_map(Map(a.map), bar)
    write_closed_map(out, found)
    print("\n".join([*found.said(), *summary(found.closed)]))
    print(f"{out / 'closed.g2o'}, {out / 'loops.csv'}, and the path of each session: {out / '000000.txt'}")
