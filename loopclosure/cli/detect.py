"""``loopclosure detect``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.cli.data_set import add_selection, add_topics, selection
from loopclosure.cli.run import show_progress, warn
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS
from loopclosure.detector import run
from loopclosure.detector.detector import Describe, DetectorSettings, LoopDetector
from loopclosure.detector.export import write_g2o, write_loops_csv
from loopclosure.detector.verification import GeometricCheck
from loopclosure.methods.features import WhitenBy
from loopclosure.places.bags import is_bag
from loopclosure.places.extraction import extract
from loopclosure.places.frames import Selection
from netspec.terminal.commands import Commands, WrongUsage

# The detector's settings that --resume takes from the saved one.
SETTINGS = (
    "metric",
    "exclude_recent",
    "exclude_seconds",
    "top_k",
    "threshold",
    "consistency",
    "consistency_window",
)
PRECISION = 0.99
# Options that mean nothing without another one.
NEEDS = {
    "calibrate_truth": "calibrate",
    "calibrate_features": "calibrate",
    "precision": "calibrate",
    "min_inliers": "verify",
}


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("detect", _detect, "find the loops in a folder of images or a video")
    p.add_argument("source", help="a folder or list of images, a sequence (TUM, EuRoC, KITTI), a video or a ROS bag")
    add_selection(p, "--", "")
    add_topics(p)
    p.add_argument("--out", required=True, metavar="FOLDER", help="where loops.csv, and loops.g2o with poses, go")
    how = p.add_mutually_exclusive_group()
    how.add_argument(
        "--describe",
        default="loopclosure.descriptors.thumbnails:Thumbnailer",
        metavar="MODULE|FILE.py:FUNCTION",
        help="image (H, W, 3) BGR -> descriptor (default: %(default)s)",
    )
    how.add_argument("--features", metavar="F.npz", help="descriptors computed beforehand (netspec extract --images)")
    p.add_argument(
        "--with", action="append", default=[], dest="options", metavar="KEY=VALUE", help="a keyword for --describe"
    )
    p.add_argument("--whiten", metavar="OTHER.npz", help="whiten the descriptors by these, of images of other places")
    which = p.add_mutually_exclusive_group(required=True)
    which.add_argument("--threshold", type=float, help="least score of a loop (euclidean: minus the distance)")
    which.add_argument(
        "--calibrate", metavar="SEQUENCE", help="choose the threshold on this TUM sequence, or folder with a mask"
    )
    which.add_argument("--resume", metavar="F.npz", help="continue with a detector that --save wrote")
    p.add_argument("--calibrate-truth", metavar="MASK", help="of --calibrate, if it is not a TUM sequence")
    p.add_argument("--calibrate-features", metavar="F.npz", help="of --calibrate, if --features is given")
    p.add_argument("--precision", type=float, help=f"least precision for --calibrate (default: {PRECISION:g})")
    of = DetectorSettings()
    p.add_argument("--metric", choices=METRICS, help=f"of the descriptors (default: {of.metric})")
    p.add_argument(
        "--exclude-recent", type=int, metavar="FRAMES", help=f"not candidates (default: {of.exclude_recent})"
    )
    p.add_argument("--exclude-seconds", type=float, metavar="S", help="nor are frames less than S seconds old")
    p.add_argument("--top-k", type=int, metavar="K", help=f"candidates examined (default: {of.top_k})")
    p.add_argument("--consistency", type=int, metavar="K", help="previous frames that must have led to the candidate")
    p.add_argument(
        "--consistency-window", type=int, metavar="FRAMES", help=f"how near (default: {of.consistency_window})"
    )
    p.add_argument("--verify", action="store_true", help="verify candidates by SIFT matches and RANSAC")
    p.add_argument("--min-inliers", type=int, help=f"of --verify (default: {GeometricCheck().min_inliers})")
    p.add_argument("--save", metavar="F.npz", help="write the detector, to continue with --resume")


def _detect(a: argparse.Namespace) -> None:
    options = _checked_options(a)
    source = Path(a.source)
    if is_bag(source):
        source, said = extract(source, Path(a.out) / "frames", a.topic or "", a.pose_topic or "", show_progress)
        print(said)
    elif a.topic or a.pose_topic:
        raise WrongUsage("--topic and --pose-topic belong to bags")
    recording = run.open_recording(source, selection(a))
    for doubt in recording.doubts:
        warn(doubt)
    features = read_features(a.features) if a.features else None
    validation = read_features(a.calibrate_features) if a.calibrate_features else None
    describe = run.load_describe(a.describe, options) if features is None else None
    views = run.views_of(describe, features)
    if a.whiten is not None:
        whitening = WhitenBy(a.whiten).learn()
        describe = None if describe is None else run.whitened(describe, whitening, views)
        features = None if features is None else features.whitened(whitening)
        validation = None if validation is None else validation.whitened(whitening)
    detector = _detector(a, describe, views)
    if a.calibrate:
        stride = Selection(stride=a.stride)  # that of the source
        data = run.validation_set(a.calibrate, a.calibrate_truth, detector.settings, stride)
        precision = PRECISION if a.precision is None else a.precision
        print(run.calibrate_on_data_set(detector, data, precision, validation, show_progress))
    # Frames of the run that is resumed have numbers but no names here.
    names = [""] * len(detector) + recording.names
    results = run.run_detector(detector, recording, features, show_progress)
    out = Path(a.out)
    write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, names)
    loops = sum(result.accepted is not None for result in results)
    print(f"{loops} loops in {len(results)} frames: {out / 'loops.csv'}")
    if np.isfinite(detector.poses).any():
        left_out = write_g2o(out / "loops.g2o", detector.poses, detector.loops, run.from_poses(detector))
        note = f", {left_out} loops without a pose left out" if left_out else ""
        print(f"pose graph, its relative poses from the known poses{note}: {out / 'loops.g2o'}")
        print(run.judged_by_poses(detector))
    if a.save:
        detector.save(a.save)


def _checked_options(a: argparse.Namespace) -> dict[str, str]:
    """Return the keywords of --with; refuse options that do not go together."""
    for option, other in NEEDS.items():
        if getattr(a, option) is not None and not getattr(a, other):
            raise WrongUsage(f"--{option.replace('_', '-')} means nothing without --{other}")
    if a.resume and (_changes(a) or a.verify):
        raise WrongUsage("--resume continues with the settings of the saved detector; leave out others")
    if a.calibrate and a.features and not a.calibrate_features:
        raise WrongUsage("--calibrate with --features needs --calibrate-features, the same net's")
    if a.features and a.options:
        raise WrongUsage("--with belongs to --describe; --features has descriptors already")
    options = {}
    for text in a.options:
        key, equals, value = text.partition("=")
        if not equals:
            raise WrongUsage(f"--with {text}: expected KEY=VALUE")
        options[key] = value
    return options


def _changes(a: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of the detector that are given."""
    return {name: getattr(a, name) for name in SETTINGS if getattr(a, name) is not None}


def _detector(a: argparse.Namespace, describe: Describe | None, views: int) -> LoopDetector:
    if a.resume:
        return LoopDetector.load(a.resume, describe)
    check = None
    if a.verify:
        check = GeometricCheck() if a.min_inliers is None else GeometricCheck(min_inliers=a.min_inliers)
    return LoopDetector(describe, check=check, views=views, **_changes(a))
