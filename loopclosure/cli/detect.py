"""``loopclosure detect``: loops within a recording."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from loopclosure.cli.data_set import add_frames
from loopclosure.commands import Detected, detect
from loopclosure.decision.constants import PRECISION
from loopclosure.detector.describers import load_describe
from loopclosure.places import intrinsics
from loopclosure.places.source import FRAMES, TOPICS
from netspec.terminal.parser import Commands

NOTHING = "next: look at the most similar pairs in the report; --least-precision 0.9 also accepts less sure ones"


def add_commands(commands: Commands) -> None:
    """Add ``detect``."""
    parser = commands.add_parser("detect", _detect, help="find the loops in a folder of images, a video or a bag")
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a folder or list of images, a sequence (TUM, EuRoC, KITTI), a video or a ROS bag; "
        f"{', '.join((*FRAMES, *TOPICS))} may follow, as in drive.bag,stride=2,topic=/cam0",
    )
    parser.add_output(
        "--out",
        folder=True,
        required=True,
        metavar="FOLDER",
        help="folder for report.html, loops.csv, and loops.g2o with poses or odometry",
    )
    add_frames(
        parser,
        "NAME|MODULE:FUNCTION|FILE.py:FUNCTION|F.npz",
        ", or descriptors that netspec extract --images wrote (default: %(default)s)",
    )
    parser.add_argument(
        "--least-precision",
        type=float,
        default=PRECISION,
        metavar="P",
        help="share of the loops that are correct, by the estimate of what chance finds (default: %(default)s)",
    )
    parser.add_argument(
        "--odometry",
        type=Path,
        metavar="FILE",
        help="poses by the odometry: frames far apart by it are no loop, and its steps give the lengths of loops",
    )
    parser.add_argument(
        "--camera",
        metavar="NUMBERS",
        help=f"{intrinsics.FORM}: measures the relative pose of each loop, if the source has no calibration",
    )


def _detect(a: argparse.Namespace) -> None:
    options = dict(getattr(a, "with"))
    found = detect(
        a.source,
        a.out,
        describe=load_describe(a.describe, options) if options else a.describe,
        metric=a.metric,
        exclude_recent=a.exclude_recent,
        exclude_seconds=a.exclude_seconds or 0.0,
        odometry=a.odometry,
        camera=a.camera,
        least_precision=a.least_precision,
        command=a.command_line,
    )
    out = Path(a.out)
    print(f"{len(found.loops)} loops in {len(found.results)} frames: {out / 'loops.csv'}")
    print(f"report: {out / 'report.html'}")
    print(_next(a, found, out) if found.loops else NOTHING)


def _next(a: argparse.Namespace, found: Detected, out: Path) -> str:
    """Return what to do with loops: the command that corrects the path, with FILE for what is not known yet."""
    words = ["loopclosure", "close", a.source, "--loops", str(out / "loops.csv"), "--out", str(out / "closed")]
    if a.odometry or found.recording.odometry is None:
        words += ["--odometry", str(a.odometry or "FILE")]
    if a.camera or found.recording.camera is None:
        words += ["--camera", a.camera or "FX,FY,CX,CY"]
    return f"next: look at the pairs in the report; {shlex.join(words)} corrects the path"
