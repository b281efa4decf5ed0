"""``loopclosure close``."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from loopclosure.cli.data_set import sequence, typed
from loopclosure.closing.close import close, drifted, summary, write_closed
from loopclosure.closing.measure import depth_scale_said, measure, read_loops
from loopclosure.errors import InputError
from loopclosure.places import intrinsics
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.source import CLOSED, POSES, TOPICS
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar, warn
from netspec.terminal.parser import Commands, seed


def add_commands(commands: Commands) -> None:
    """Add ``close``."""
    _add_close(commands)


def _add_close(commands: Commands) -> None:
    parser = commands.add_parser("close", help="correct a path using the loops that detect found")
    parser.set_defaults(function=_close)
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
    given = intrinsics.from_text(a.camera) if a.camera else None
    source = typed(a.source, CLOSED)
    frames = sequence(source, out / "frames", odometry=a.odometry, form=a.odometry_form)
    camera = given or frames.camera
    if camera is None:
        raise InputError(f"has no camera calibration; give --camera {intrinsics.FORM}", frames.source)
    odometry = _odometry(a, frames)[source.selection().numbers(len(frames))]
    frames = frames.taken(source.selection())
    loops = measure(frames, read_loops(Path(a.loops), frames), camera, odometry, bar)
    if a.drift is None and (said := depth_scale_said(frames, camera)):
        warn(said)
    closed = close(odometry, loops, frames.poses, stamps=frames.stamps)
    write_closed(out, closed, frames.stamps, frames.names)
    # Imported here, since it takes seconds and only this command needs it.
    from loopclosure.report.plots import draw_paths

    draw_paths(out / "paths.png", closed)
    print("\n".join(summary(closed)))
    print(f"{out / 'closed.g2o'}, {out / 'closed.txt'}, {out / 'paths.png'}")


def _odometry(a: argparse.Namespace, frames: ImageSequence) -> np.ndarray:
    """Return the path (F, 7) to correct, NaN for frames without a pose. Raises InputError if there is none."""
    if a.drift is None:
        if frames.odometry is None:
            raise InputError("has no odometry; give --odometry FILE, or --drift PERCENT to simulate it", frames.source)
        return frames.odometry
    if frames.poses is None:
        raise InputError(
            "has no true poses to simulate drift from; give --odometry, or add ,poses=FILE to the source", frames.source
        )
    known = np.all(np.isfinite(frames.poses), axis=1)
    path = frames.poses.copy()
    path[known] = drifted(path[known], a.drift, 1 if a.seed is None else a.seed)
    return path
