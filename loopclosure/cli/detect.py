"""``loopclosure detect``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.cli.data_set import typed
from loopclosure.cli.run import show_progress, warn
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS
from loopclosure.detector import run
from loopclosure.detector.detector import Describe, DetectorSettings, LoopDetector
from loopclosure.detector.export import write_g2o, write_loops_csv
from loopclosure.detector.verification import GeometricCheck
from loopclosure.methods.auto import PRECISION
from loopclosure.methods.drive import whole_drive
from loopclosure.methods.features import WhitenBy
from loopclosure.places.bags import is_bag
from loopclosure.places.extraction import extract
from loopclosure.places.source import FRAMES, TOPICS
from netspec.files.whole_file import whole_file
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
# Settings of the search frame by frame.
ONLINE = ("top_k", "consistency", "consistency_window")


def add_to(commands: Commands) -> None:
    """Add the command."""
    p = commands.add("detect", _detect, "find the loops in a folder of images or a video")
    p.add_argument(
        "source",
        metavar="SOURCE",
        help="a folder or list of images, a sequence (TUM, EuRoC, KITTI), a video or a ROS bag; with "
        f"{', '.join((*FRAMES, *TOPICS))} behind it, as in drive.bag,stride=2,topic=/cam0",
    )
    p.add_argument("--out", required=True, metavar="FOLDER", help="where loops.csv, and loops.g2o with poses, go")
    how = p.add_mutually_exclusive_group()
    how.add_argument(
        "--describe",
        default="default",
        metavar="NAME|MODULE:FUNCTION|FILE.py:FUNCTION",
        help="image (H, W, 3) BGR -> descriptor: default and small are nets that come with it (default: %(default)s)",
    )
    how.add_argument("--features", metavar="F.npz", help="descriptors computed beforehand (netspec extract --images)")
    p.add_argument(
        "--with", action="append", default=[], dest="options", metavar="KEY=VALUE", help="a keyword for --describe"
    )
    p.add_argument("--whiten", metavar="OTHER.npz", help="whiten the descriptors by these, of images of other places")
    which = p.add_mutually_exclusive_group()
    which.add_argument(
        "--precision",
        type=float,
        metavar="P",
        help=f"share of the loops that should be right, for which all else is chosen (default: {PRECISION:g})",
    )
    which.add_argument(
        "--threshold", type=float, help="decide frame by frame, by this least score (euclidean: minus the distance)"
    )
    which.add_argument("--resume", metavar="F.npz", help="decide frame by frame, with a detector that --save wrote")
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
    source = typed(a.source, {"": (*FRAMES, *TOPICS)})
    path, (topic, pose_topic) = source.path, (source.get(name, str) or "" for name in TOPICS)
    if is_bag(path):
        path, said = extract(path, Path(a.out) / "frames", topic, pose_topic, show_progress)
        print(said)
    elif topic or pose_topic:
        raise WrongUsage(f"{source}: topics belong to bags")
    recording = run.open_recording(path, source.selection())
    for doubt in recording.doubts:
        warn(doubt)
    features = read_features(a.features) if a.features else None
    describe = run.load_describe(a.describe, options) if features is None else None
    views = run.views_of(describe, features)
    if a.whiten is not None:
        whitening = WhitenBy(a.whiten).learn()
        describe = None if describe is None else run.whitened(describe, whitening, views)
        features = None if features is None else features.whitened(whitening)
    detector = _detector(a, describe, views)
    # Frames of the run that is resumed have numbers but no names here.
    names = [""] * len(detector) + recording.names
    out = Path(a.out)
    if a.threshold is None and not a.resume:
        precision = PRECISION if a.precision is None else a.precision
        results, found = whole_drive(detector, recording, features, precision, show_progress)
        said = [*found.reasons, found.counts()]
    else:
        results = run.run_detector(detector, recording, features, show_progress)
        said = [run.verdicts_said(results)]
    write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, names)
    with whole_file(out / "chosen.txt") as unfinished:
        unfinished.write_text("\n".join(said) + "\n", encoding="utf-8")
    loops = sum(result.accepted is not None for result in results)
    print("\n".join(said))
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
    if a.resume and (_changes(a) or a.verify):
        raise WrongUsage("--resume continues with the settings of the saved detector; leave out others")
    if a.min_inliers is not None and not a.verify:
        raise WrongUsage("--min-inliers means nothing without --verify")
    given = [f"--{name.replace('_', '-')}" for name in ONLINE if getattr(a, name) is not None]
    given += ["--verify"] if a.verify else []
    if given and a.threshold is None:
        raise WrongUsage(f"{given[0]} means nothing without --threshold")
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
