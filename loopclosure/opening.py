"""Opens sources of images for commands, with a warning for all that looks wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from loopclosure.errors import InputError
from loopclosure.places import datasets
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics, from_text
from loopclosure.places.pose_files import pose_form
from loopclosure.places.same_place import MAX_ANGLE_DEG, MAX_DISTANCE_M
from loopclosure.places.sequences import GROUNDTRUTH, PoseChoice, layout_of, with_odometry
from loopclosure.places.source import (
    DETECTED,
    EVALUATED,
    LAYOUTS,
    TOPICS,
    Kinds,
    Source,
    is_recording,
    open_sequence,
    read_source,
    resolved,
)
from loopclosure.places.truth import Exclusion
from netspec.terminal.commands import WrongUsage
from netspec.terminal.output import bar, warn


def typed(text: str | Path, kinds: Kinds) -> Source:
    """Parse a source as it is typed. Raises WrongUsage."""
    try:
        return read_source(str(text), kinds)
    except InputError as fault:
        raise WrongUsage(str(fault)) from None


def known_camera(camera: str | Intrinsics | None) -> Intrinsics | None:
    """Return the camera that replaces the calibration of a source, also from the text of ``--camera``."""
    return from_text(camera) if isinstance(camera, str) else camera


def sequence(
    source: Source,
    frames: Path,
    posed: bool = False,
    videos: bool = True,
    odometry: str | Path | None = None,
    form: str | None = None,
) -> ImageSequence:
    """Read a sequence, with all its frames; see :func:`~loopclosure.places.source.open_sequence`.

    frames    folder to which the frames of a bag are extracted and, if ``videos``, those of a video
    posed     the command needs poses
    odometry  a file that replaces the odometry of the sequence, in this ``form``
    """
    read, said = open_sequence(source, frames, posed=posed, videos=videos, progress=bar)
    if said:
        print(said)
    if odometry is not None:
        read = with_odometry(read, PoseChoice(Path(odometry), pose_form(form or "")))
    for doubt in read.doubts if posed else read.remarks():
        warn(doubt)
    return read


def recording_of(
    source: str | Path,
    frames: Path,
    camera: str | Intrinsics | None = None,
    odometry: str | Path | None = None,
) -> ImageSequence:
    """Open the selected frames of a source for the detector; ``camera`` and ``odometry`` replace its own."""
    chosen, known = typed(source, DETECTED), known_camera(camera)
    recording = sequence(chosen, frames, videos=False, odometry=odometry).taken(chosen.selection())
    return recording if known is None else replace(recording, camera=known)


def readable(recording: ImageSequence) -> ImageSequence:
    """Warn about images that could not be read; return the recording without them."""
    if unreadable := recording.left_out():
        warn(unreadable)
    return recording.readable()


def data_set(
    given: str | Path,
    out: Path,
    tolerance: int | None = None,
    max_distance: float | None = None,
    max_angle: float | None = None,
    exclude_frames: int | None = None,
    exclude_seconds: float | None = None,
) -> datasets.DataSet:
    """Load a data set with its ground truth. Raises WrongUsage for what its kind does not have."""
    asked = typed(given, EVALUATED)
    try:
        source = resolved(asked)
    except InputError as fault:
        raise fault if fault.where else WrongUsage(str(fault)) from None
    kind, chosen, truth = source.kind, source.selection(), source.get("truth", str)
    references = source.get("references", Path)
    posed = not kind or kind in LAYOUTS
    if not posed:
        rule = {"max-distance": max_distance, "max-angle": max_angle, "exclude-seconds": exclude_seconds}
        _refuse(rule, f"is for sequences with poses, not for {asked.kind or kind}")
    if asked.kind != "traverses":
        _refuse({"tolerance": tolerance}, "is for traverses")
    if kind in ("traverses", "pairs"):
        _refuse({"exclude-frames": exclude_frames}, f"is for one sequence, not for {asked.kind}")
    excluded = exclude_frames is not None or exclude_seconds is not None
    exclusion = Exclusion(exclude_frames or 0, exclude_seconds or 0.0) if excluded else None
    if references is not None and excluded:
        raise WrongUsage("--exclude-frames cannot be used with references, which were recorded at another time")
    if posed:
        _check_truth(source, kind)
        if truth:
            raise WrongUsage("give either truth or poses, not both")
        if references and "poses" in source.settings:
            raise WrongUsage("poses=FILE is for one sequence; with references, each sequence must have its own poses")
        topics = {name: text for name, text in source.settings.items() if name in TOPICS}
        others = Source(source.kind, references, topics) if references else None
        return datasets.load_sequence(
            sequence(source, out / "frames", posed=True),
            chosen,
            exclusion,
            max_distance_m=max_distance or MAX_DISTANCE_M,
            max_angle_deg=max_angle or MAX_ANGLE_DEG,
            references=sequence(others, out / "references", posed=True) if others else None,
        )
    if references is not None:
        return datasets.load_traverses(source.path, references, tolerance or 0, chosen, truth)
    if kind == "fabmap":
        return datasets.load_fabmap(
            source.path,
            source.get("camera", str) or "both",
            chosen,
            exclusion or datasets.FABMAP_EXCLUSION,
            truth_file=truth,
            coordinates=source.get("coordinates", str),
        )
    if kind == "images":
        assert truth is not None
        return datasets.load_folder(source.path, truth, chosen, exclusion or datasets.FOLDER_EXCLUSION)
    return datasets.load_place_pairs(source.path, chosen)


def _refuse(given: Mapping[str, object], reason: str) -> None:
    for name, value in given.items():
        if value is not None:
            raise WrongUsage(f"--{name} {reason}")


def _check_truth(source: Source, kind: str) -> None:
    """Raise InputError for a plain folder of images, which has no ground truth."""
    path = source.path
    plain = not kind and not is_recording(path) and "poses" not in source.settings and not layout_of(path, "")
    if plain and path.is_dir() and not (path / "rgb.txt").exists():
        if (path / GROUNDTRUTH).is_file():
            raise InputError(f"has {GROUNDTRUTH}, but no rgb.txt; expected the time and the file of each image", path)
        expected = "add ,poses=FILE, or write images:FOLDER,truth=MASK; the command detect needs no ground truth"
        raise InputError(f"has no ground truth of which frames show the same place; {expected}", path)
