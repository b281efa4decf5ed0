"""The options that say which data set, and which of its frames, a command is about."""

from __future__ import annotations

import argparse
from pathlib import Path

from loopclosure.cli.run import WrongUsage
from loopclosure.places import datasets
from loopclosure.places.cameras import CAMERAS
from loopclosure.places.frames import Selection
from loopclosure.places.overlap import ViewOverlap
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.truth import Exclusion

KINDS = ("tum", "fabmap", "images", "traverses", "pairs")
# Which options belong to which data set: given with another one they would be ignored, so they are refused.
BELONGS = {
    "truth": ("images", "fabmap"),
    "references": ("images", "tum"),
    "camera": ("fabmap",),
    "coordinates": ("fabmap",),
    "tolerance": ("traverses",),
    "soft_tolerance": ("traverses",),
    "max_distance": ("tum",),
    "max_angle": ("tum",),
    "soft_distance": ("tum",),
    "soft_angle": ("tum",),
    "fov": ("tum",),
    "overlap": ("tum",),
    "exclude_frames": ("tum", "fabmap", "images"),
    "exclude_seconds": ("tum",),
}


def add_data_set(p: argparse.ArgumentParser) -> None:
    """Add the options of :func:`data_set`."""
    data = p.add_mutually_exclusive_group(required=True)
    data.add_argument("--tum", metavar="FOLDER", help="a TUM RGB-D sequence; truth from its poses")
    data.add_argument("--fabmap", metavar="FOLDER", help="FAB-MAP's New College or City Centre")
    data.add_argument("--images", metavar="FOLDER", help="images with a mask (--truth)")
    data.add_argument("--traverses", nargs=2, metavar=("QUERIES", "REFERENCES"), help="equal numbers = equal places")
    data.add_argument("--pairs", metavar="FOLDER", help="places photographed twice (pairs.csv)")
    add_selection(p, "--", "")
    p.add_argument("--truth", metavar="MASK", help=".mat .npy .txt or image: which frames show the same place")
    p.add_argument("--references", metavar="FOLDER", help="of --images or --tum, if they are another folder")
    p.add_argument("--camera", choices=CAMERAS, help="of --fabmap (default: both)")
    p.add_argument("--coordinates", metavar="FILE", help="of --fabmap, if not in the folder")
    p.add_argument("--tolerance", type=int, metavar="FRAMES", help="of --traverses (default: 0)")
    p.add_argument("--soft-tolerance", type=int, metavar="FRAMES", help="a match up to here is ignored, not wrong")
    p.add_argument("--max-distance", type=float, metavar="M", help=f"of --tum (default: {MAX_DISTANCE_M:g})")
    p.add_argument("--max-angle", type=float, metavar="DEG", help=f"of --tum (default: {MAX_ANGLE_DEG:g})")
    p.add_argument("--soft-distance", type=float, metavar="M", help="a match up to here is ignored, not wrong")
    p.add_argument("--soft-angle", type=float, metavar="DEG", help="the same, for the angle")
    p.add_argument(
        "--fov", type=float, metavar="DEG", help=f"horizontal field of view (default: {ViewOverlap().fov_deg:g})"
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
        help=f"frames less than S seconds apart are no pair (default: --tum {datasets.TUM_EXCLUSION.seconds:g})",
    )


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
    if kind in ("tum", "images") and a.references is not None and excluded:
        raise WrongUsage("--exclude-frames means nothing with --references: nothing is near in time")
    if kind == "tum":
        return datasets.load_tum(
            a.tum,
            chosen,
            exclusion or datasets.TUM_EXCLUSION,
            max_distance_m=MAX_DISTANCE_M if a.max_distance is None else a.max_distance,
            max_angle_deg=MAX_ANGLE_DEG if a.max_angle is None else a.max_angle,
            soft_distance_m=a.soft_distance,
            soft_angle_deg=a.soft_angle,
            references=a.references,
            view_overlap=ViewOverlap(
                ViewOverlap().fov_deg if a.fov is None else a.fov,
                ViewOverlap().least if a.overlap is None else a.overlap,
            ),
        )
    if kind == "fabmap":
        camera = a.camera or "both"
        exclusion = exclusion or datasets.FABMAP_EXCLUSION
        joined = Path(a.out) / "joined"
        return datasets.load_fabmap(a.fabmap, a.truth, a.coordinates, camera, chosen, exclusion, joined)
    if kind == "images":
        if a.truth is None:
            raise WrongUsage("--images needs --truth, the mask that says which frames show the same place")
        return datasets.load_folder(a.images, a.truth, a.references, chosen, exclusion or datasets.FOLDER_EXCLUSION)
    if kind == "traverses":
        queries, references = a.traverses
        return datasets.load_traverses(queries, references, a.tolerance or 0, a.soft_tolerance, chosen)
    return datasets.load_place_pairs(a.pairs, chosen)
