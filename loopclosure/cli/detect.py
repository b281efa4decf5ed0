"""``loopclosure detect``: loops within a drive."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.cli.data_set import recording_of, warn_of_unreadable
from loopclosure.closing.close import constraint
from loopclosure.closing.measure import Loop, cells, depth_scale_said, errors_said, measure
from loopclosure.decision.constants import PRECISION, RECENT
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS
from loopclosure.detector import run
from loopclosure.detector.decision import DetectorSettings, LoopResult
from loopclosure.detector.describers import load_describe
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import RELATIVE, write_g2o, write_loops_csv
from loopclosure.detector.saved import Describe
from loopclosure.detector.verification import GeometricCheck
from loopclosure.methods.drive import Request, last_session, whole_drive
from loopclosure.places import intrinsics
from loopclosure.places.frames import live_frames
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.source import FRAMES, TOPICS
from loopclosure.places.trajectory import pieces
from netspec.files.whole_file import write_whole
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar, warn
from netspec.terminal.parser import Commands

# Settings that --resume reads from the saved detector.
SETTINGS = ("metric", "exclude_recent", "exclude_seconds", "top_k", "threshold", "consistency", "consistency_window")
RECENT_SECONDS = 10.0  # for --video: frames of the current visit to a place are not loops
OF = DetectorSettings()
ONLINE = ("top_k", "consistency", "consistency_window")


def add_commands(commands: Commands) -> None:
    """Add ``detect``."""
    _add_detect(commands)


def _add_detect(commands: Commands) -> None:
    parser = commands.add_parser("detect", help="find the loops in a folder of images or a video")
    parser.set_defaults(function=_detect)
    parser.add_argument(
        "source",
        nargs="?",
        metavar="SOURCE",
        help="a folder or list of images, a sequence (TUM, EuRoC, KITTI), a video or a ROS bag; "
        f"{', '.join((*FRAMES, *TOPICS))} may follow, as in drive.bag,stride=2,topic=/cam0",
    )
    parser.add_argument(
        "--video",
        metavar="CAMERA|URL|FILE",
        help="find loops while images arrive, from camera 0, rtsp://HOST/PATH or a file",
    )
    parser.add_output(
        "--out",
        folder=True,
        required=True,
        metavar="FOLDER",
        help="folder for loops.csv, and for loops.g2o with poses or odometry",
    )
    exclusive = parser.add_mutually_exclusive_group()
    exclusive.add_argument(
        "--describe",
        default="default",
        metavar="NAME|MODULE:FUNCTION|FILE.py:FUNCTION",
        help="an included net (default or small), or a function from a BGR image (H, W, 3) to its descriptor",
    )
    exclusive.add_argument("--features", metavar="F.npz", help="descriptors that netspec extract --images wrote")
    parser.add_argument(
        "--with", action="append", default=[], metavar="KEY=VALUE", help="keyword argument of the --describe function"
    )
    exclusive = parser.add_mutually_exclusive_group()
    exclusive.add_argument(
        "--least-precision",
        type=float,
        metavar="P",
        help=f"share of the loops that are correct, by the estimate of what chance finds (default: {PRECISION:g})",
    )
    exclusive.add_argument(
        "--threshold",
        type=float,
        metavar="S",
        help="decide frame by frame: lowest score of a loop (euclidean: the negative distance)",
    )
    exclusive.add_argument(
        "--resume", metavar="F.npz", help="continue, frame by frame, with a detector that --save wrote"
    )
    parser.add_argument("--metric", choices=METRICS, help=f"metric of the descriptors (default: {OF.metric})")
    parser.add_argument(
        "--exclude-recent",
        type=int,
        metavar="FRAMES",
        help="number of recent frames that are never candidates "
        f"(default: {RECENT}, or those of --exclude-seconds, and the length of a visit to the place)",
    )
    parser.add_argument(
        "--exclude-seconds", type=float, metavar="S", help="frames of the last S seconds are never candidates"
    )
    parser.add_argument("--top-k", type=int, metavar="K", help=f"number of candidates to examine (default: {OF.top_k})")
    parser.add_argument(
        "--consistency",
        type=int,
        metavar="K",
        help="number of previous frames whose candidates must lead to that of this frame",
    )
    parser.add_argument(
        "--consistency-window",
        type=int,
        metavar="FRAMES",
        help=f"largest step between candidates of successive frames (default: {OF.consistency_window})",
    )
    parser.add_argument("--verify", action="store_true", help="verify candidates with SIFT matches and RANSAC")
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
    parser.add_output("--save", metavar="F.npz", help="write the detector to this file, for --resume")


def _detect(a: argparse.Namespace) -> None:
    options = _checked_options(a)
    recording = None if a.video else recording_of(a.source, Path(a.out) / "frames", a.camera, a.odometry)
    features = read_features(a.features) if a.features else None
    describe = load_describe(a.describe, options) if features is None else None
    detector = _detector(a, describe, {} if features is None else {"views": features.views})
    # The names of the frames before --resume are not known.
    names, ended = [""] * len(detector), None
    out = Path(a.out)
    out.mkdir(parents=True, exist_ok=True)
    if recording is None:
        results, ended = _watch(a, detector)
        names += [f"frame {number}" for number in range(len(results))]
        reasons = [run.verdicts_said(results)]
        if a.threshold is None and not a.resume:
            seconds = a.exclude_seconds or 0.0
            found = last_session(detector, request=Request(recent=a.exclude_recent, seconds=seconds), progress=bar)
            results, reasons = found.results, [*found.reasons, run.verdicts_said(found.results)]
            detector.decided([result for result in results if result])
    elif a.threshold is None and not a.resume:
        precision = PRECISION if a.least_precision is None else a.least_precision
        path = recording.odometry  # after a jump, its poses are in another frame
        whole = path is not None and not pieces(path, recording.stamps).any()
        request = Request(precision, a.exclude_recent, odometry=path if whole else None)
        found = whole_drive(detector, recording, features, request, bar)
        results = found.results
        reasons = [*found.reasons, run.verdicts_said(results)]
    else:
        results = run.run_detector(detector, recording, features, bar)
        by = "their scores alone" if detector.check is None else "their scores and their points"
        reasons = [f"decided frame by frame, by {by}", run.verdicts_said(results)]
    if recording is not None:
        recording = warn_of_unreadable(recording)
        names += recording.names
    loops, measured = [], None
    if recording is not None and recording.camera is not None:
        loops = _measured(detector, recording, recording.camera)
        if said := depth_scale_said(recording, recording.camera):
            warn(said)
        measured = RELATIVE, {loop.query: cells(loop.relative) for loop in loops if loop.relative is not None}
    write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, names, measured=measured)
    write_whole(out / "chosen.txt", "\n".join(reasons) + "\n")
    # Drawing takes a second to import.
    from loopclosure.report.drive import write_drive

    read = 0 if recording is None else len(recording.unreadable)
    write_drive(out / "report.html", results, reasons, recording, a.command_line)
    if recording is not None and len(recording.unreadable) > read:
        warn(f"{len(recording.unreadable) - read} images cannot be read; the report shows no pairs with them")
    count = sum(result.match is not None for result in results)
    print(f"{count} loops in {len(results)} frames: {out / 'loops.csv'}; report: {out / 'report.html'}")
    print("\n".join(reasons))
    if engine := getattr(describe, "engine", ""):
        print(f"descriptors: {a.describe}, computed by {engine}")
    poses, odometry = detector.poses, detector.odometry
    driven = np.isfinite(odometry).any()
    if driven or np.isfinite(poses).any():
        of_loop = {(loop.query, loop.match): constraint(loop.relative) for loop in loops if loop.relative is not None}
        path = odometry if driven else poses
        drives = pieces(path, detector.stamps, detector.sessions)
        left_out = write_g2o(out / "loops.g2o", path, detector.loops, lambda *ends: of_loop.get(ends), drives)
        note = f"; loops without a measured relative pose, left out: {left_out}" if left_out else ""
        print(f"pose graph of the {'odometry' if driven else 'known poses'}{note}: {out / 'loops.g2o'}")
    if np.isfinite(poses).any():
        print(run.judged_by_poses(detector))
        if said := errors_said(loops, poses):
            print(said)
    if a.save:
        detector.save(a.save)
    if ended is not None:
        raise ended


def _watch(a: argparse.Namespace, detector: LoopDetector) -> tuple[list[LoopResult], KeyboardInterrupt | None]:
    """Process the images of a camera, a stream or a file until it ends, or until Ctrl-C."""
    results: list[LoopResult] = []
    try:
        for stamp, image in live_frames(a.video):
            loops = detector.add(image, stamp)
            run.put(results, detector.newest, loops)
            for loop in loops:
                place = f"shows the place of frame {loop.match}"
                print(f"frame {loop.query}, {loop.stamp:.1f} s: {place}", flush=True)
    except KeyboardInterrupt as end:
        return results, end
    return results, None


def _measured(detector: LoopDetector, recording: ImageSequence, camera: Intrinsics) -> list[Loop]:
    """Return the loops within this drive, numbered as by the detector, with their relative poses."""
    first = len(detector) - len(recording)
    found = [(loop.query - first, loop.match - first) for loop in detector.loops if loop.match is not None]
    own = [Loop(query, match) for query, match in found if match >= 0]
    measured = measure(recording, own, camera, recording.odometry, bar)
    return [Loop(loop.query + first, loop.match + first, loop.relative) for loop in measured]


def _checked_options(a: argparse.Namespace) -> dict[str, str]:
    """Return the keywords of --with. Raises WrongUsage for options that do not go together."""
    if bool(a.source) == bool(a.video):
        raise WrongUsage("expected the frames, or --video")
    if a.video and (a.features or a.least_precision is not None):
        raise WrongUsage(f"--{'features' if a.features else 'least-precision'} needs a complete recording, not --video")
    if a.video and a.camera:
        raise WrongUsage("--camera measures loops in images that are read again, which those of --video are not")
    if a.resume and (_changes(a) or a.verify):
        raise WrongUsage("--resume uses the settings of the saved detector; leave out all others")
    given = [f"--{name.replace('_', '-')}" for name in ONLINE if getattr(a, name) is not None]
    given += ["--verify"] if a.verify else []
    if given and a.threshold is None and not a.video:
        raise WrongUsage(f"{given[0]} needs --threshold")
    if a.odometry and a.video:
        raise WrongUsage("--odometry is for a recording, not for --video")
    if a.features and getattr(a, "with"):
        raise WrongUsage("--with is for --describe, not for --features")
    options = {}
    for text in getattr(a, "with"):
        key, equals, value = text.partition("=")
        if not equals:
            raise WrongUsage(f"--with {text}: expected KEY=VALUE")
        options[key] = value
    return options


def _changes(a: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the detector that are given on the command line."""
    return {name: getattr(a, name) for name in SETTINGS if getattr(a, name) is not None}


def _detector(a: argparse.Namespace, describe: Describe | None, views: dict[str, int]) -> LoopDetector:
    if a.resume:
        detector = LoopDetector.load(a.resume, describe)
        if detector.fingerprint is None:
            warn(f"{a.resume} does not name the net that described its frames; use the same net")
        return detector
    check = None
    changes = {**views, **_changes(a)}
    if a.video:
        changes.setdefault("exclude_seconds", RECENT_SECONDS)
    if a.verify or ((a.video or a.save) and a.threshold is None):
        check = GeometricCheck()
    return LoopDetector(describe, check=check, **changes)
