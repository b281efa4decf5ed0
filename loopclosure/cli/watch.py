"""``loopclosure watch``: loops while images arrive."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure.cli.data_set import add_frames
from loopclosure.detector import run
from loopclosure.detector.decision import LoopResult
from loopclosure.detector.describers import load_describe
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import write_loops_csv
from loopclosure.methods.drive import Request, last_session
from loopclosure.places.frames import live_frames
from netspec.files.whole_file import write_whole
from netspec.terminal.commands import refuse
from netspec.terminal.output import bar, warn
from netspec.terminal.parser import Commands

# Settings that --resume reads from the saved detector.
SETTINGS = ("metric", "exclude_recent", "exclude_seconds", "threshold")
RECENT_SECONDS = 10.0  # frames of the current visit to a place are not loops


def add_commands(commands: Commands) -> None:
    """Add ``watch``."""
    parser = commands.add_parser("watch", _watch, help="find loops while images arrive from a camera or a stream")
    parser.add_argument(
        "--video", required=True, metavar="CAMERA|URL|FILE", help="camera 0, rtsp://HOST/PATH, a video file or a bag"
    )
    parser.add_output(
        "--out", folder=True, required=True, metavar="FOLDER", help="folder for report.html and loops.csv"
    )
    add_frames(parser, "NAME|MODULE:FUNCTION|FILE.py:FUNCTION", " (default: %(default)s)")
    parser.add_argument(
        "--threshold", type=float, metavar="S", help="lowest score of a loop (euclidean: the negative distance)"
    )
    parser.add_argument(
        "--resume", metavar="F.npz", help="begin another drive, with a detector that --save wrote and its settings"
    )
    parser.add_output("--save", metavar="F.npz", help="write the detector to this file, for --resume")


def _watch(a: argparse.Namespace) -> None:
    if a.resume:
        refuse(a, SETTINGS, "is a setting of the saved detector that --resume names")
    detector = _detector(a)
    names = [""] * len(detector)  # those of the frames before --resume are not known
    before, settings = list(detector.loops), detector.settings
    detector.begin_session()  # the time of a stream begins at 0
    results, ended = _watched(a.video, detector)
    reasons = [run.verdicts_said(results)]
    if settings.threshold is None:  # all frames are known now
        request = Request(recent=settings.exclude_recent, seconds=settings.exclude_seconds)
        found = last_session(detector, request=request, progress=bar)
        results, reasons = found.results, [*found.reasons, run.verdicts_said(found.results)]
        detector.decided([*before, *filter(None, results)])
    out = Path(a.out)
    names += [f"frame {number}" for number in range(len(results))]
    write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, names)
    write_whole(out / "chosen.txt", "\n".join(reasons) + "\n")
    # Drawing takes a second to import.
    from loopclosure.report.drive import write_drive

    write_drive(out / "report.html", results, reasons, None, a.command_line)
    print(f"{sum(map(bool, results))} loops in {len(results)} frames: {out / 'loops.csv'}")
    print(f"report: {out / 'report.html'}")
    if a.save:
        detector.save(a.save)
    if ended is not None:
        raise ended


def _detector(a: argparse.Namespace) -> LoopDetector:
    describe = load_describe(a.describe, dict(getattr(a, "with")))
    if not a.resume:
        changes = {name: getattr(a, name) for name in SETTINGS if getattr(a, name) is not None}
        return LoopDetector(describe, **{"exclude_seconds": RECENT_SECONDS, **changes})
    detector = LoopDetector.load(a.resume, describe)
    if detector.fingerprint is None:
        warn(f"{a.resume} does not name the net that described its frames; use the same net")
    return detector


def _watched(video: str, detector: LoopDetector) -> tuple[list[LoopResult], KeyboardInterrupt | None]:
    """Process the images of a camera, a stream or a file until it ends, or until Ctrl-C."""
    results: list[LoopResult] = []
    try:
        for stamp, image in live_frames(video):
            loops = detector.add(image, stamp)
            run.put(results, detector.newest, loops)
            for loop in loops:
                place = f"shows the place of frame {loop.match}"
                print(f"frame {loop.query}, {loop.stamp:.1f} s: {place}", flush=True)
    except KeyboardInterrupt as end:
        return results, end
    return results, None
