"""The command line: parses arguments, shows progress, catches InputError; computes nothing."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from loopclosure import evaluate
from loopclosure.descriptors.feature_file import read_features
from loopclosure.descriptors.similarity import METRICS, top_k, write_similarity, write_top_k
from loopclosure.detector import export as loop_export
from loopclosure.detector import run as detect
from loopclosure.detector.detector import DetectorSettings, LoopDetector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.methods.base import METHODS, MethodContext
from loopclosure.methods.features import WhitenBy
from loopclosure.places import datasets
from loopclosure.places.frames import Selection, image_paths
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.truth import Exclusion

Item = TypeVar("Item")
# Which options belong to which data set: given with another one they would be ignored, so they are refused.
BELONGS = {
    "truth": ("images", "fabmap"),
    "references": ("images",),
    "camera": ("fabmap",),
    "coordinates": ("fabmap",),
    "tolerance": ("traverses",),
    "soft_tolerance": ("traverses",),
    "max_distance": ("tum",),
    "max_angle": ("tum",),
    "soft_distance": ("tum",),
    "soft_angle": ("tum",),
    "exclude_frames": ("tum", "fabmap", "images"),
    "exclude_seconds": ("tum",),
}
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 when done, 1 for a fault of the user's files, 2 for wrong usage."""
    given = list(sys.argv[1:] if argv is None else argv)
    arguments = _parser().parse_args(given)
    arguments.command_line = shlex.join(["loopclosure", *given])
    try:
        return arguments.run(arguments) or 0
    except InputError as fault:
        print(fault, file=sys.stderr)
        return 1
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def evaluate_loops(argv: Sequence[str] | None = None) -> int:
    """Run ``loopclosure evaluate``: the door ``tools/evaluate_loops.py``."""
    return main(["evaluate", *(sys.argv[1:] if argv is None else argv)])


def show_progress(items: Iterable[Item], stage: str, total: int | None = None) -> Iterable[Item]:
    """Show a bar on a terminal."""
    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit="")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="loopclosure", description="Judge and detect loop closures.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    p = commands.add_parser("evaluate", help="run methods on one data set and write a report")
    p.set_defaults(run=_evaluate)
    _add_data_set(p)
    p.add_argument(
        "--method",
        action="append",
        required=True,
        metavar="[LABEL=]METHOD",
        help=f"may be repeated; METHOD is one of {', '.join(METHODS)}, with :settings, or NAME+METHOD: "
        "features:PATH.npz[:cosine][:whiten=OTHER.npz], seqslam+features:PATH.npz, fabmap:model=words.npz",
    )
    p.add_argument(
        "--train",
        action="append",
        default=[],
        metavar="PATH",
        help="images for vocabularies, other than those tested: a folder, list or TUM sequence; may be repeated",
    )
    _add_selection(p, "--train-", "of each --train: ")
    p.add_argument("--out", required=True, metavar="FOLDER", help="where the report and its parts go")
    p.add_argument("--title", default="", help="heading of the report")
    p.add_argument("--seed", type=int, default=0, help="of what the methods draw by lot (default: 0)")

    p = commands.add_parser("detect", help="find the loops in a folder of images or a video")
    p.set_defaults(run=_detect)
    p.add_argument("source", help="a folder or list of images, a TUM RGB-D sequence, or a video file")
    _add_selection(p, "--", "")
    p.add_argument("--out", required=True, metavar="FOLDER", help="where loops.csv, and loops.g2o with poses, go")
    how = p.add_mutually_exclusive_group()
    how.add_argument(
        "--describe",
        default="loopclosure.descriptors.thumbnails:Thumbnailer",
        metavar="MODULE:FUNCTION",
        help="image (H, W, 3) BGR -> descriptor (default: %(default)s)",
    )
    how.add_argument("--features", metavar="F.npz", help="descriptors computed beforehand (netspec extract --images)")
    p.add_argument(
        "--with", action="append", default=[], dest="options", metavar="KEY=VALUE", help="a keyword for --describe"
    )
    p.add_argument("--whiten", metavar="OTHER.npz", help="whiten the descriptors by these, of images of other places")
    which = p.add_mutually_exclusive_group(required=True)
    which.add_argument("--threshold", type=float, help="a loop needs this score (euclidean: minus the distance)")
    which.add_argument(
        "--calibrate", metavar="SEQUENCE", help="choose the threshold on this TUM sequence, or folder with a mask"
    )
    which.add_argument("--resume", metavar="F.npz", help="go on with a detector that --save wrote")
    p.add_argument("--calibrate-truth", metavar="MASK", help="of --calibrate, if it is no TUM sequence")
    p.add_argument("--calibrate-features", metavar="F.npz", help="of --calibrate, if --features is given")
    p.add_argument("--precision", type=float, default=0.99, help="that --calibrate wants (default: %(default)s)")
    of = DetectorSettings()
    p.add_argument("--metric", choices=METRICS, help=f"of the descriptors (default: {of.metric})")
    p.add_argument("--exclude-recent", type=int, metavar="FRAMES", help=f"no candidates (default: {of.exclude_recent})")
    p.add_argument("--exclude-seconds", type=float, metavar="S", help="nor frames less than S seconds old")
    p.add_argument("--top-k", type=int, metavar="K", help=f"candidates looked at (default: {of.top_k})")
    p.add_argument("--consistency", type=int, metavar="K", help="frames before that must have led to the candidate")
    p.add_argument(
        "--consistency-window", type=int, metavar="FRAMES", help=f"how near (default: {of.consistency_window})"
    )
    p.add_argument("--verify", action="store_true", help="verify candidates by SIFT matches and RANSAC")
    p.add_argument("--min-inliers", type=int, help=f"of --verify (default: {GeometricCheck().min_inliers})")
    p.add_argument("--save", metavar="F.npz", help="write the detector, to go on with --resume")

    p = commands.add_parser("similarity", help="compare all descriptors of a file, by blocks")
    p.set_defaults(run=_similarity)
    p.add_argument("features", help="the .npz of the queries")
    p.add_argument("--references", metavar="F.npz", help="their references; without, one sequence against itself")
    p.add_argument("--metric", choices=METRICS, default=METRICS[0])
    p.add_argument("--top-k", type=int, help="write the best K of each query as CSV, rather than the matrix as .npy")
    p.add_argument("--exclude-frames", type=int, default=0, help="of --top-k in one sequence")
    p.add_argument("--exclude-seconds", type=float, default=0.0, help="of --top-k in one sequence with stamps")
    p.add_argument("--out", required=True, metavar="FILE")
    return parser


def _add_data_set(p: argparse.ArgumentParser) -> None:
    data = p.add_mutually_exclusive_group(required=True)
    data.add_argument("--tum", metavar="FOLDER", help="a TUM RGB-D sequence; truth from its poses")
    data.add_argument("--fabmap", metavar="FOLDER", help="FAB-MAP's New College or City Centre")
    data.add_argument("--images", metavar="FOLDER", help="images with a mask (--truth)")
    data.add_argument("--traverses", nargs=2, metavar=("QUERIES", "REFERENCES"), help="equal numbers = equal places")
    data.add_argument("--pairs", metavar="FOLDER", help="places photographed twice (pairs.csv)")
    _add_selection(p, "--", "")
    p.add_argument("--truth", metavar="MASK", help=".mat .npy .txt or image: which frames show the same place")
    p.add_argument("--references", metavar="FOLDER", help="of --images, if they are another folder")
    p.add_argument("--camera", choices=datasets.CAMERAS, help="of --fabmap (default: both)")
    p.add_argument("--coordinates", metavar="FILE", help="of --fabmap, if not in the folder")
    p.add_argument("--tolerance", type=int, metavar="FRAMES", help="of --traverses (default: 0)")
    p.add_argument("--soft-tolerance", type=int, metavar="FRAMES", help="no mistake up to here, though not to be found")
    p.add_argument("--max-distance", type=float, metavar="M", help=f"of --tum (default: {MAX_DISTANCE_M:g})")
    p.add_argument("--max-angle", type=float, metavar="DEG", help=f"of --tum (default: {MAX_ANGLE_DEG:g})")
    p.add_argument("--soft-distance", type=float, metavar="M", help="no mistake up to here, though not to be found")
    p.add_argument("--soft-angle", type=float, metavar="DEG", help="likewise")
    p.add_argument(
        "--exclude-frames",
        type=int,
        metavar="N",
        help=f"frames i and j with |i - j| <= N are no pair (default: --fabmap {datasets.FABMAP_EXCLUSION.frames}, "
        f"--images {datasets.FOLDER_EXCLUSION.frames})",
    )
    p.add_argument(
        "--exclude-seconds",
        type=float,
        metavar="S",
        help=f"nor those less than S seconds apart (default: --tum {datasets.TUM_EXCLUSION.seconds:g})",
    )


def _add_selection(p: argparse.ArgumentParser, prefix: str, of: str) -> None:
    p.add_argument(f"{prefix}start", default="0", metavar="N|P%", help=f"{of}the first frame, from 0 or as a share")
    p.add_argument(f"{prefix}stop", metavar="N|P%", help=f"{of}the frame to stop before")
    p.add_argument(f"{prefix}stride", type=int, default=1, metavar="N", help=f"{of}each N-th frame")
    p.add_argument(f"{prefix}limit", type=int, metavar="N", help=f"{of}at most N frames")


def _data_set(a: argparse.Namespace) -> datasets.DataSet:
    kind = next(name for name in ("tum", "fabmap", "images", "traverses", "pairs") if getattr(a, name))
    for option, kinds in BELONGS.items():
        if getattr(a, option) is not None and kind not in kinds:
            names = " or ".join(f"--{name}" for name in kinds)
            raise InputError(f"--{option.replace('_', '-')} means nothing to --{kind}; it belongs to {names}")
    selection = Selection(a.start, a.stop, a.stride, a.limit)
    excluded = a.exclude_frames is not None or a.exclude_seconds is not None
    exclusion = Exclusion(a.exclude_frames or 0, a.exclude_seconds or 0.0) if excluded else None
    if kind == "tum":
        return datasets.load_tum(
            a.tum,
            selection,
            exclusion or datasets.TUM_EXCLUSION,
            max_distance_m=MAX_DISTANCE_M if a.max_distance is None else a.max_distance,
            max_angle_deg=MAX_ANGLE_DEG if a.max_angle is None else a.max_angle,
            soft_distance_m=a.soft_distance,
            soft_angle_deg=a.soft_angle,
        )
    if kind == "fabmap":
        camera = a.camera or "both"
        exclusion = exclusion or datasets.FABMAP_EXCLUSION
        joined = Path(a.out) / "joined"
        return datasets.load_fabmap(a.fabmap, a.truth, a.coordinates, camera, selection, exclusion, joined)
    if kind == "images":
        if a.truth is None:
            raise InputError("--images needs --truth, the mask that says which frames show the same place")
        if a.references is not None and excluded:
            raise InputError("--exclude-frames means nothing with --references: nothing is near in time")
        return datasets.load_folder(a.images, a.truth, a.references, selection, exclusion or datasets.FOLDER_EXCLUSION)
    if kind == "traverses":
        queries, references = a.traverses
        return datasets.load_traverses(queries, references, a.tolerance or 0, a.soft_tolerance, selection)
    return datasets.load_place_pairs(a.pairs, selection)


def _evaluate(a: argparse.Namespace) -> None:
    # Drawing takes seconds to import, which the other commands need not wait for.
    from loopclosure.report.files import measures_text
    from loopclosure.report.page import write_report

    data = _data_set(a)
    context = MethodContext(data.exclude_frames, a.seed)
    methods = [evaluate.named_method(text, context) for text in a.method]
    chosen = Selection(a.train_start, a.train_stop, a.train_stride, a.train_limit)
    train: list[Path] = []
    for source in a.train:
        images = image_paths(source)
        train += [images[i] for i in chosen.numbers(len(images))]
    described = f"{len(train)} images of {', '.join(Path(t).name for t in a.train)}" if train else "no training images"
    evaluation = evaluate.evaluate(data, methods, train, described, show_progress)
    page = write_report(evaluation, a.out, a.title, a.command_line)
    print(measures_text(evaluation))
    print(f"report: {page}")


def _detect(a: argparse.Namespace) -> None:
    recording = detect.open_recording(a.source, Selection(a.start, a.stop, a.stride, a.limit))
    options = dict(_key_value(text) for text in a.options)
    features = read_features(a.features) if a.features else None
    describe = None if features is not None else detect.load_describe(a.describe, options)
    validation = read_features(a.calibrate_features) if a.calibrate_features else None
    views = detect.views_of(describe, features)
    if a.whiten is not None:
        whitening = WhitenBy(a.whiten).learn()
        describe = None if describe is None else detect.whitened(describe, whitening, views)
        features = None if features is None else features.whitened(whitening)
        validation = None if validation is None else validation.whitened(whitening)
    changes = {name: getattr(a, name) for name in SETTINGS if getattr(a, name) is not None}
    if a.resume:
        if changes or a.verify:
            raise InputError("--resume goes on with the settings of the saved detector; leave out others")
        detector = LoopDetector.load(a.resume, describe)
    else:
        check = GeometricCheck(**({"min_inliers": a.min_inliers} if a.min_inliers else {})) if a.verify else None
        detector = LoopDetector(describe, check=check, views=views, **changes)
    if a.calibrate:
        if a.features and not a.calibrate_features:
            raise InputError("--calibrate with --features needs --calibrate-features, the same net's")
        settings, chosen = detector.settings, Selection(stride=a.stride)
        if a.calibrate_truth:
            exclusion = Exclusion(settings.exclude_recent)
            data = datasets.load_folder(a.calibrate, a.calibrate_truth, None, chosen, exclusion)
        else:
            exclusion = Exclusion(settings.exclude_recent, settings.exclude_seconds)
            data = datasets.load_tum(a.calibrate, chosen, exclusion)
        print(detect.calibrate_on_data_set(detector, data, a.precision, validation, show_progress))
    before = len(detector)
    results = detect.run_detector(detector, recording, features, show_progress)
    loops = [result for result in results if result.accepted is not None]
    out = Path(a.out)
    # Frames of the run that was resumed have numbers but no names here.
    names = [""] * before + recording.names
    loop_export.write_loops_csv(out / "loops.csv", detector.loops, detector.stamps, names)
    print(f"{len(loops)} loops in {len(results)} frames: {out / 'loops.csv'}")
    if np.isfinite(detector.poses).any():
        left_out = loop_export.write_g2o(out / "loops.g2o", detector.poses, detector.loops, detect.from_poses(detector))
        note = f", {left_out} loops without a pose left out" if left_out else ""
        print(f"pose graph, its relative poses from groundtruth.txt{note}: {out / 'loops.g2o'}")
        print(detect.judged_by_poses(detector))
    if a.save:
        detector.save(a.save)


def _key_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"--with {text}: expected KEY=VALUE")
    return key, value


def _similarity(a: argparse.Namespace) -> None:
    queries = read_features(a.features)
    references = None if a.references is None else read_features(a.references)
    rows = None if references is None else references.features
    if queries.views > 1:
        raise InputError("describes several views of an image; this command compares one", a.features)
    if a.top_k is None:
        if a.exclude_frames or a.exclude_seconds:
            raise InputError("an exclusion belongs to --top-k; the matrix holds all pairs")
        shape = write_similarity(a.out, queries.features, rows, a.metric, show_progress)
        print(f"{shape[0]} x {shape[1]} scores, float32: {a.out}")
        return
    exclusion = Exclusion(a.exclude_frames, a.exclude_seconds) if rows is None else None
    if rows is not None and (a.exclude_frames or a.exclude_seconds):
        raise InputError("an exclusion concerns one sequence; with --references nothing is near in time")
    found = top_k(queries.features, rows, a.top_k, a.metric, exclusion, queries.stamps)
    write_top_k(a.out, found)
    print(f"the best {a.top_k} of {len(found.indices)} queries ({exclusion or 'no pair excluded'}): {a.out}")
