"""The options that say which data set, and which of its frames, a command is about."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure.cli.run import show_progress, warn
from loopclosure.places import datasets
from loopclosure.places.cameras import CAMERAS
from loopclosure.places.extraction import LAYOUTS, POSE_FORM_HELP, POSES_HELP, RECORDED, extract, is_recording
from loopclosure.places.frames import Selection
from loopclosure.places.overlap import FOV_DEG, ViewOverlap
from loopclosure.places.pose_files import pose_form
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.sequences import ImageSequence, PoseChoice, benchmark_parts, read_sequence
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import WrongUsage
from netspec.terminal.options import above_zero

KINDS = (*LAYOUTS, "fabmap", "images", "traverses", "nordland", "pairs")
POSED = (*LAYOUTS, "images")
# Which options belong to which data set: given with another one they would be ignored, so they are refused.
BELONGS = {
    "truth": ("images", "fabmap", "traverses"),
    "poses": POSED,
    "pose_form": POSED,
    "topic": ("bag",),
    "pose_topic": ("bag",),
    "references": ("images", "tum", "euroc", "kitti"),
    "camera": ("fabmap",),
    "coordinates": ("fabmap",),
    "tolerance": ("traverses",),
    "soft_tolerance": ("traverses",),
    "max_distance": POSED,
    "max_angle": POSED,
    "soft_distance": POSED,
    "soft_angle": POSED,
    "fov": POSED,
    "overlap": POSED,
    "exclude_frames": (*POSED, "fabmap"),
    "exclude_seconds": POSED,
}


def add_data_set(p: argparse.ArgumentParser) -> None:
    """Add the options of :func:`data_set`."""
    data = p.add_mutually_exclusive_group(required=True)
    for layout, what in LAYOUTS.items():
        data.add_argument(f"--{layout}", metavar="PATH", help=f"{what}; truth from its poses")
    data.add_argument("--fabmap", metavar="FOLDER", help="FAB-MAP's New College or City Centre")
    data.add_argument("--images", metavar="FOLDER", help="images with a mask (--truth) or poses (--poses)")
    data.add_argument("--traverses", nargs=2, metavar=("QUERIES", "REFERENCES"), help="equal numbers = equal places")
    data.add_argument("--nordland", metavar="FOLDER", help="query/, ref/, ground_truth*.npy, as VPR benchmarks ship it")
    data.add_argument("--pairs", metavar="FOLDER", help="places photographed twice (pairs.csv)")
    add_selection(p, "--", "")
    p.add_argument("--truth", metavar="MASK", help=".mat .npy .txt or image: which frames show the same place")
    add_poses(p)
    add_topics(p)
    p.add_argument("--references", metavar="FOLDER", help="of --images, --tum, --euroc or --kitti, if another folder")
    p.add_argument("--camera", choices=CAMERAS, help="of --fabmap (default: both)")
    p.add_argument("--coordinates", metavar="FILE", help="of --fabmap, if not in the folder")
    p.add_argument("--tolerance", type=int, metavar="FRAMES", help="of --traverses (default: 0)")
    p.add_argument("--soft-tolerance", type=int, metavar="FRAMES", help="a match up to here is ignored, not wrong")
    p.add_argument("--max-distance", type=above_zero, metavar="M", help=f"of poses (default: {MAX_DISTANCE_M:g})")
    p.add_argument("--max-angle", type=above_zero, metavar="DEG", help=f"of poses (default: {MAX_ANGLE_DEG:g})")
    p.add_argument("--soft-distance", type=above_zero, metavar="M", help="a match up to here is ignored, not wrong")
    p.add_argument("--soft-angle", type=above_zero, metavar="DEG", help="the same, for the angle")
    p.add_argument(
        "--fov", type=float, metavar="DEG", help=f"horizontal field of view (default: the camera's, or {FOV_DEG:g})"
    )
    p.add_argument(
        "--overlap",
        type=float,
        metavar="SHARE",
        help="the soft zone: a match is no mistake if so much of each view is visible in the other "
        f"(default: {ViewOverlap().least:g})",
    )
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
        help=f"frames less than S seconds apart are no pair (default: with times {datasets.TUM_EXCLUSION.seconds:g})",
    )


def add_poses(p: argparse.ArgumentParser) -> None:
    """Add the options of :func:`pose_choice`."""
    p.add_argument("--poses", metavar="FILE", help=POSES_HELP)
    p.add_argument("--pose-form", metavar="WORDS", help=POSE_FORM_HELP)


def add_topics(p: argparse.ArgumentParser) -> None:
    """Add the options of bags."""
    p.add_argument("--topic", help="of the images of a bag that has several")
    p.add_argument("--pose-topic", metavar="TOPIC", help="of the poses of a bag that has several")


def pose_choice(a: argparse.Namespace) -> PoseChoice | None:
    """Return the file of poses that is given, if there is one."""
    if a.pose_form and not a.poses:
        raise WrongUsage("--pose-form means nothing without --poses")
    return PoseChoice(Path(a.poses), pose_form(a.pose_form or "")) if a.poses else None


def sequence(a: argparse.Namespace, source: str, layout: str) -> ImageSequence:
    """Read the sequence with poses that the options describe; frames of bags and videos go to --out/frames."""
    poses = pose_choice(a)
    path = Path(source)
    if layout in RECORDED or (not layout and is_recording(path)):
        path, said = extract(path, Path(a.out) / "frames", a.topic or "", a.pose_topic or "", show_progress)
        print(said)
        layout = "images"
    read = read_sequence(path, layout, poses=poses)
    for doubt in read.doubts:
        warn(doubt)
    return read


def add_selection(p: argparse.ArgumentParser, prefix: str, of: str) -> None:
    """Add the options of :func:`selection`, named ``prefix`` start and so on; ``of`` begins their help."""
    p.add_argument(f"{prefix}start", default="0", metavar="N|P%", help=f"{of}the first frame, from 0 or as a share")
    p.add_argument(f"{prefix}stop", metavar="N|P%", help=f"{of}the frame to stop before")
    p.add_argument(f"{prefix}stride", type=int, default=1, metavar="N", help=f"{of}every N-th frame")
    p.add_argument(f"{prefix}limit", type=int, metavar="N", help=f"{of}at most N frames")


def selection(a: argparse.Namespace, prefix: str = "") -> Selection:
    """Return the selection of frames that the options with this prefix describe."""
    return Selection(*(getattr(a, f"{prefix}{name}") for name in ("start", "stop", "stride", "limit")))


def data_set(a: argparse.Namespace) -> datasets.DataSet:
    """Load the data set that the options describe."""
    kind = next(name for name in KINDS if getattr(a, name))
    for option, kinds in BELONGS.items():
        if getattr(a, option) is not None and kind not in kinds:
            names = " or ".join(f"--{name}" for name in kinds)
            raise WrongUsage(f"--{option.replace('_', '-')} means nothing to --{kind}; it belongs to {names}")
    chosen = selection(a)
    excluded = a.exclude_frames is not None or a.exclude_seconds is not None
    exclusion = Exclusion(a.exclude_frames or 0, a.exclude_seconds or 0.0) if excluded else None
    if a.references is not None and excluded:
        raise WrongUsage("--exclude-frames means nothing with --references: nothing is near in time")
    if kind in LAYOUTS or (kind == "images" and a.poses):
        if a.truth:
            raise WrongUsage("--truth and --poses both say which frames show the same place; give one")
        if a.references and a.poses:
            raise WrongUsage("--poses are those of one sequence; with --references each must have its own")
        return datasets.load_sequence(
            sequence(a, getattr(a, kind), kind),
            chosen,
            exclusion,
            max_distance_m=a.max_distance,
            max_angle_deg=a.max_angle,
            soft_distance_m=a.soft_distance,
            soft_angle_deg=a.soft_angle,
            references=sequence(a, a.references, kind) if a.references else None,
            view_overlap=ViewOverlap(a.fov, ViewOverlap().least if a.overlap is None else a.overlap),
        )
    if kind == "fabmap":
        camera = a.camera or "both"
        exclusion = exclusion or datasets.FABMAP_EXCLUSION
        joined = Path(a.out) / "joined"
        return datasets.load_fabmap(a.fabmap, a.truth, a.coordinates, camera, chosen, exclusion, joined)
    if kind == "images":
        if a.truth is None:
            raise WrongUsage("--images needs --truth, the mask that says which frames show the same place, or --poses")
        return datasets.load_folder(a.images, a.truth, a.references, chosen, exclusion or datasets.FOLDER_EXCLUSION)
    if kind == "traverses":
        queries, references = a.traverses
        return datasets.load_traverses(queries, references, a.tolerance or 0, a.soft_tolerance, chosen, a.truth)
    if kind == "nordland":
        queries, references, truth = benchmark_parts(Path(a.nordland))
        return datasets.load_traverses(queries, references, selection=chosen, truth_file=truth)
    return datasets.load_place_pairs(a.pairs, chosen)
