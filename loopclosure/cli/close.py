"""``loopclosure close``."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure.closing.close import summary
from loopclosure.commands import close
from loopclosure.places import intrinsics
from loopclosure.places.source import POSES, TOPICS
from netspec.terminal.commands import WrongUsage
from netspec.terminal.parser import Commands, seed


def add_commands(commands: Commands) -> None:
    """Add ``close``."""
    parser = commands.add_parser("close", _close, help="correct a path using the loops that detect found")
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="the frames: a TUM, EuRoC or KITTI sequence, a folder or list of images, a video or bag; "
        f"{', '.join((*POSES, *TOPICS))} may follow, as in drive.mp4,poses=slam.txt",
    )
    parser.add_argument("--loops", required=True, metavar="CSV", help="the loops.csv that detect wrote")
    exclusive = parser.add_mutually_exclusive_group()
    exclusive.add_argument(
        "--odometry",
        type=Path,
        metavar="FILE",
        help="the path to correct: poses in the format of TUM, KITTI or EuRoC (default: the odometry of a bag)",
    )
    exclusive.add_argument(
        "--drift", type=float, metavar="PERCENT", help="simulate drifting odometry from the true poses"
    )
    parser.add_argument("--odometry-form", metavar="WORDS", help="how the --odometry file is written, as for pose-form")
    parser.add_argument("--seed", type=seed, metavar="N", help="seed of --drift (default: 1)")
    parser.add_argument("--camera", metavar="NUMBERS", help=f"{intrinsics.FORM}, if the source has no calibration")
    parser.add_output(
        "--out", folder=True, required=True, metavar="FOLDER", help="folder for closed.g2o, closed.txt and paths.png"
    )


def _close(a: argparse.Namespace) -> None:
    out = Path(a.out)
    if a.odometry_form and not a.odometry:
        raise WrongUsage("--odometry-form needs --odometry")
    if a.seed is not None and a.drift is None:
        raise WrongUsage("--seed needs --drift")
    closed = close(
        a.source,
        a.loops,
        out,
        odometry=a.odometry,
        odometry_form=a.odometry_form,
        drift=a.drift,
        seed=1 if a.seed is None else a.seed,
        camera=a.camera,
    )
    print("\n".join(summary(closed)))
    print(f"{out / 'closed.g2o'}, {out / 'closed.txt'}, {out / 'paths.png'}")
