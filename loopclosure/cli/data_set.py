"""Arguments for data sets and sequences, and loading them."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from loopclosure.errors import InputError
from loopclosure.places import datasets
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import from_text
from loopclosure.places.masks import CAMERAS
from loopclosure.places.pose_files import pose_form
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.sequences import GROUNDTRUTH, PoseChoice, layout_of, with_odometry
from loopclosure.places.source import (
    DETECTED,
    EVALUATED,
    LAYOUT_LINES,
    LAYOUTS,
    POSE_FORM_HELP,
    POSES_HELP,
    TOPICS,
    Kinds,
    Source,
    is_recording,
    open_sequence,
    read_source,
    resolved,
)
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import WrongUsage, refuse
from netspec.terminal.output import bar, warn
from netspec.terminal.parser import above_zero

HELP = f"""A SOURCE is [KIND:]PATH[,KEY=VALUE]..., for example tum:desk,stop=50%,stride=2.

Ground truth from poses (KIND may be omitted; it is then detected from the files):
{LAYOUT_LINES}
  images:     a folder or list of images, with poses=FILE, or with truth=MASK, which marks frames of the same place
Other ground truth:
  fabmap:     FAB-MAP's New College or City Centre; truth=, coordinates=, camera={"|".join(CAMERAS)} (default: both)
  traverses:  two drives, PATH and references=PATH; equal frame numbers show the same place, unless truth=FILE is given
  nordland:   query/, ref/, ground_truth*.json, as in VPR benchmarks
  pairs:      places that were photographed twice (pairs.csv)

KEYs: start, stop (a frame number N or a percentage P%), stride, limit: which frames to use;
truth=FILE (.mat .npy .txt or image); poses=FILE ({POSES_HELP}),
pose-form ({POSE_FORM_HELP});
references=PATH: another sequence to search; topic, pose-topic: the topics to read from a bag with several."""
RULE = ("max_distance", "max_angle", "exclude_seconds")
EXCLUDED = f"fabmap {datasets.FABMAP_EXCLUSION.frames}, images {datasets.FOLDER_EXCLUSION.frames}"


def add_data_set(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for a data set: its source (see HELP) and the rule for the same place."""
    parser.add_argument("source", metavar="SOURCE", help="the data set (see below)")
    parser.add_argument(
        "--tolerance",
        type=int,
        metavar="FRAMES",
        help="traverses: largest difference between frame numbers of the same place (default: 0)",
    )
    parser.add_argument(
        "--max-distance",
        type=above_zero,
        metavar="M",
        help=f"maximum distance between two poses of the same place (default: {MAX_DISTANCE_M:g})",
    )
    parser.add_argument(
        "--max-angle", type=above_zero, metavar="DEG", help=f"maximum angle between them (default: {MAX_ANGLE_DEG:g})"
    )
    parser.add_argument(
        "--exclude-frames",
        type=int,
        metavar="N",
        help=f"exclude pairs of frames i, j with |i - j| <= N (default: {EXCLUDED})",
    )
    parser.add_argument(
        "--exclude-seconds",
        type=float,
        metavar="S",
        help="exclude pairs of frames within S seconds "
        f"(default if frames have times: {datasets.TUM_EXCLUSION.seconds:g})",
    )


def typed(text: str, kinds: Kinds) -> Source:
    """Parse a source on the command line. Raises WrongUsage."""
    try:
        return read_source(text, kinds)
    except InputError as fault:
        raise WrongUsage(str(fault)) from None


def sequence(
    source: Source, frames: Path, posed: bool = False, odometry: Path | None = None, form: str | None = None
) -> ImageSequence:
    """Read a sequence, with a warning for all that looks wrong; see :func:`~loopclosure.places.source.open_sequence`.

    The frames of a bag or video are extracted to the folder ``frames``. ``posed``: the command needs poses.
    ``odometry`` is a file that replaces the odometry of the sequence, in this ``form``.
    """
    read, said = open_sequence(source, frames, posed=posed, videos=True, progress=bar)
    if said:
        print(said)
    if odometry is not None:
        read = with_odometry(read, PoseChoice(odometry, pose_form(form or "")))
    for doubt in read.doubts if posed else read.remarks():
        warn(doubt)
    return read


def data_set(a: argparse.Namespace) -> datasets.DataSet:
    """Load the data set that the arguments describe."""
    given = typed(a.source, EVALUATED)
    try:
        source = resolved(given)
    except InputError as fault:
        raise fault if fault.where else WrongUsage(str(fault)) from None
    kind, chosen, truth = source.kind, source.selection(), source.get("truth", str)
    references = source.get("references", Path)
    posed = not kind or kind in LAYOUTS
    if not posed:
        refuse(a, RULE, f"is for sequences with poses, not for {given.kind or kind}")
    if given.kind != "traverses":
        refuse(a, ("tolerance",), "is for traverses")
    if kind in ("traverses", "pairs"):
        refuse(a, ("exclude_frames",), f"is for one sequence, not for {given.kind}")
    excluded = a.exclude_frames is not None or a.exclude_seconds is not None
    exclusion = Exclusion(a.exclude_frames or 0, a.exclude_seconds or 0.0) if excluded else None
    if references is not None and excluded:
        raise WrongUsage("--exclude-frames cannot be used with references, which were recorded at another time")
    if posed:
        _check_truth(source, kind)
        if truth:
            raise WrongUsage("give either truth or poses, not both")
        if references and "poses" in source.settings:
            raise WrongUsage("poses=FILE is for one sequence; with references, each sequence must have its own poses")
        out, topics = Path(a.out), {name: text for name, text in source.settings.items() if name in TOPICS}
        others = Source(source.kind, references, topics) if references else None
        return datasets.load_sequence(
            sequence(source, out / "frames", posed=True),
            chosen,
            exclusion,
            max_distance_m=a.max_distance or MAX_DISTANCE_M,
            max_angle_deg=a.max_angle or MAX_ANGLE_DEG,
            references=sequence(others, out / "references", posed=True) if others else None,
        )
    if references is not None:
        return datasets.load_traverses(source.path, references, a.tolerance or 0, chosen, truth)
    if kind == "fabmap":
        camera, files = source.get("camera", str) or "both", datasets.FabmapFiles(truth, source.get("coordinates", str))
        return datasets.load_fabmap(source.path, files, camera, chosen, exclusion or datasets.FABMAP_EXCLUSION)
    if kind == "images":
        assert truth is not None
        return datasets.load_folder(source.path, truth, chosen, exclusion or datasets.FOLDER_EXCLUSION)
    return datasets.load_place_pairs(source.path, chosen)


def _check_truth(source: Source, kind: str) -> None:
    """Raise InputError for a plain folder of images, which has no ground truth."""
    path = source.path
    plain = not kind and not is_recording(path) and "poses" not in source.settings and not layout_of(path, "")
    if plain and path.is_dir() and not (path / "rgb.txt").exists():
        if (path / GROUNDTRUTH).is_file():
            raise InputError(f"has {GROUNDTRUTH}, but no rgb.txt; expected the time and the file of each image", path)
        expected = "add ,poses=FILE, or write images:FOLDER,truth=MASK; the command detect needs no ground truth"
        raise InputError(f"has no ground truth of which frames show the same place; {expected}", path)


def warn_of_unreadable(recording: ImageSequence) -> ImageSequence:
    """Warn about images that could not be read; return the recording without them."""
    if unreadable := recording.left_out():
        warn(unreadable)
    return recording.readable()


def recording_of(text: str, frames: Path, camera: str | None = None, odometry: Path | None = None) -> ImageSequence:
    """Open a source for the detector; the frames of a bag are extracted to the folder ``frames``.

    ``camera`` is the value of ``--camera``, which replaces the calibration of the source, and ``odometry`` that of
    ``--odometry``, which replaces its odometry.
    """
    known = from_text(camera) if camera else None
    source = typed(text, DETECTED)
    read, said = open_sequence(source, frames, progress=bar)
    if said:
        print(said)
    if odometry is not None:
        read = with_odometry(read, PoseChoice(odometry))
    recording = read.taken(source.selection())
    for remark in recording.remarks():
        warn(remark)
    return recording if known is None else replace(recording, camera=known)
