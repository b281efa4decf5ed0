"""Reads sequences of images in common layouts: TUM RGB-D, EuRoC, KITTI odometry, folders, lists and videos.

All of them become an :class:`~loopclosure.places.image_sequence.ImageSequence`, which all commands use.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.frames import is_video, video_length
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import kitti_projection, read_intrinsics, yaml_numbers
from loopclosure.places.pose_files import PoseForm, matrix_fault, number, read_poses, seconds_of
from loopclosure.places.trajectory import MAX_DIFFERENCE_S, associate, moved
from netspec.errors import SpecError
from netspec.files.image_list import list_images
from netspec.files.kinds import nearest_existing, unreadable
from netspec.files.paths import relative
from netspec.files.table import TIME, UNITS, read_table

GROUNDTRUTH, ODOMETRY = "groundtruth.txt", "odometry.txt"
QUERIES = ("query", "queries", "Query", "Queries")
REFERENCES = ("ref", "refs", "reference", "references", "database", "Ref", "Reference", "Database")
KITTI_CAMERAS = ("image_0", "image_2", "image_1", "image_3")
EUROC_POSES = ("state_groundtruth_estimate0", "mocap0", "vicon0")


@dataclass(frozen=True)
class PoseChoice:
    """A file of poses, and its form, that replaces the poses of a sequence."""

    path: Path
    form: PoseForm = field(default_factory=PoseForm)


def read_sequence(
    source: str | Path,
    layout: str = "",
    max_difference: float = MAX_DIFFERENCE_S,
    poses: PoseChoice | None = None,
    times: Path | None = None,
) -> ImageSequence:
    """Read a sequence with a layout "tum", "euroc", "kitti", "images" or "video"; "": found from the files.

    A frame gets the pose nearest in time, within ``max_difference`` seconds, or none. If the sequence's own poses or
    calibration cannot be read, it has none, and says why. Raises InputError for images or lists that are missing or
    damaged, and for ``poses`` that cannot be read. ``times``: a file with the time of each frame in seconds.
    """
    source = Path(source)
    sequence = _READERS[layout or layout_of(source)](source, max_difference, poses is None)
    if times is not None:
        sequence = replace(sequence, stamps=_times(times, len(sequence)))
    if poses is None:
        return sequence
    found, doubts = _chosen(sequence, poses, max_difference)
    return replace(sequence, poses=found, doubts=(*sequence.doubts, *doubts))


def with_odometry(sequence: ImageSequence, odometry: PoseChoice) -> ImageSequence:
    """Return a sequence with the path of the robot in a file. Raises InputError if it cannot be read."""
    found, doubts = _chosen(sequence, odometry, measured=True)
    return replace(sequence, odometry=found, doubts=(*sequence.doubts, *doubts))


def _chosen(
    sequence: ImageSequence, choice: PoseChoice, max_difference: float = MAX_DIFFERENCE_S, measured: bool = False
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the poses (N, 7) of the camera in a file that the user named, wherever it lies, and doubts about them."""
    read = read_poses(choice.path, choice.form)
    found = read.of_images(len(sequence), sequence.stamps, choice.path, max_difference, measured)
    if read.form == layout_of(sequence.source):
        found = moved(found, _camera_in_body(sequence.source))
    return found, tuple(f"{choice.path}: {doubt}" for doubt in read.doubts)


def _camera_in_body(source: Path) -> np.ndarray:
    """Return the pose (4, 4) of the camera of an EuRoC or KITTI sequence in the frame of its poses.

    Raises InputError if its calibration cannot be read.
    """
    mount, calibration = np.eye(4), source / "calib.txt"
    sensor = _cam0(source) / "sensor.yaml"
    if sensor.is_file():
        mount = np.array(yaml_numbers(_calibration(sensor), "data", 16, sensor)).reshape(4, 4)
        if fault := matrix_fault(mount[:3, :3]):
            raise InputError(f"the camera's pose in the body, T_BS: {fault}", sensor)
    elif calibration.is_file():
        matrix = kitti_projection(_calibration(calibration), _projection(source), calibration)
        mount[:3, 3] = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return mount


def _cam0(source: Path) -> Path:
    return (source / "mav0" if (source / "mav0").is_dir() else source) / "cam0"


def _projection(source: Path) -> str:
    """Return the name of the projection of the camera of a KITTI sequence that is used, P0 to P3."""
    return f"P{next(name for name in KITTI_CAMERAS if (source / name).is_dir())[-1]}"


def layout_of(source: Path, otherwise: str = "images") -> str:
    """Return the layout of a source by its name and its folders; ``otherwise`` if they do not determine it."""
    if is_video(source):
        return "video"
    if (source / "mav0").is_dir() or (source / "cam0" / "data.csv").is_file():
        return "euroc"
    if any((source / name).is_dir() for name in KITTI_CAMERAS):
        return "kitti"
    return otherwise


def benchmark_parts(folder: Path) -> tuple[Path, Path, Path]:
    """Return the queries, the references and the truth in a folder of a VPR benchmark.

    VPR-Bench (Zaffar et al., IJCV 2021): ``query/``, ``ref/``, and ground_truth*.json or .npy. If there are several
    such files, the one that ends in ``_new`` is used. Raises InputError if one of the three is missing.
    """
    parts = []
    for names, what in ((QUERIES, "queries"), (REFERENCES, "references")):
        found = [folder / name for name in names if (folder / name).is_dir()]
        if not found:
            raise InputError(f"has no folder {' or '.join(names[:3])} with the {what}", folder)
        parts.append(found[0])
    truths = sorted(folder.glob("ground_truth*.json")) or sorted(folder.glob("ground_truth*.npy"))
    newest = [path for path in truths if path.stem.endswith("_new")] or truths
    if len(newest) != 1:
        names = ", ".join(path.name for path in truths) or "none"
        raise InputError(f"expected one ground_truth*.json or .npy, found {names}; traverses: names the parts", folder)
    return parts[0], parts[1], newest[0]


def _tum(folder: Path, max_difference: float, own_poses: bool) -> ImageSequence:
    expected = "expected a TUM RGB-D sequence with rgb.txt and groundtruth.txt"
    if not folder.is_dir():
        raise InputError(f"no such folder; {expected}{nearest_existing(folder)}", folder)
    listing = folder / "rgb.txt"
    if not listing.is_file():
        raise InputError(f"no such file; {expected}{nearest_existing(listing)}", listing)
    listed = list_images(folder)
    if listed.stamps is None:
        raise InputError('has lines without a time stamp; expected "timestamp filename" in each line', listing)
    stamps = seconds_of(listed.stamps)
    sequence = ImageSequence(listed.paths, listed.names, stamps, folder)
    return _with_tum_files(sequence, stamps, max_difference, own_poses)


def _with_tum_files(
    sequence: ImageSequence, stamps: np.ndarray, max_difference: float, own_poses: bool
) -> ImageSequence:
    """Add the poses, depth and calibration of a TUM sequence, if it has them."""
    folder = sequence.source
    if own_poses:
        sequence = _with_poses(sequence, folder / GROUNDTRUTH, "tum", max_difference)
    if (folder / ODOMETRY).is_file():
        try:
            sequence = with_odometry(sequence, PoseChoice(folder / ODOMETRY, PoseForm("tum")))
        except InputError as fault:
            sequence = replace(sequence, doubts=(*sequence.doubts, f"{fault}; the odometry is not used"))
    if (folder / "depth.txt").is_file():
        try:
            sequence = replace(sequence, depths=_nearest_depths(folder / "depth.txt", stamps, max_difference))
        except SpecError as fault:
            sequence = replace(sequence, doubts=(*sequence.doubts, f"{fault}; depth is not used"))
    if (folder / "calibration.txt").is_file():
        sequence = _with_camera(sequence, folder / "calibration.txt")
    return sequence


def _with_poses(sequence: ImageSequence, path: Path, form: str, max_difference: float) -> ImageSequence:
    """Add the poses in a file of a sequence. If it cannot be read, there are none, and ``pose_fault`` says why."""
    try:
        found, doubts = _chosen(sequence, PoseChoice(path, PoseForm(form)), max_difference)
    except InputError as fault:
        return replace(sequence, pose_fault=fault)
    return replace(sequence, poses=found, doubts=(*sequence.doubts, *doubts))


def _with_camera(sequence: ImageSequence, path: Path, projection: str = "") -> ImageSequence:
    """Add the camera of a calibration file; a sentence about the file if it cannot be used."""
    try:
        return replace(sequence, camera=read_intrinsics(path, projection))
    except InputError as fault:
        return replace(sequence, doubts=(*sequence.doubts, f"{fault}; the calibration is not used"))


def _nearest_depths(listing: Path, stamps: np.ndarray, max_difference: float) -> tuple[Path | None, ...]:
    """Return for each image the depth image nearest in time; None if none is within ``max_difference``."""
    depths = list_images(listing)
    if depths.stamps is None:
        raise InputError('has lines without a time stamp; expected "timestamp filename" in each line', listing)
    times = seconds_of(depths.stamps)
    order = np.argsort(times, kind="stable")
    nearest = associate(stamps, times[order], max_difference)
    return tuple(None if number < 0 else depths.paths[order[number]] for number in nearest)


def _images(source: Path, max_difference: float, own_poses: bool) -> ImageSequence:
    listed = list_images(source)
    stamps = None if listed.stamps is None else seconds_of(listed.stamps)
    sequence = ImageSequence(listed.paths, (), stamps, source, doubts=listed.doubts)
    sequence = replace(sequence, names=tuple(relative(path, sequence.folder) for path in listed.paths))
    if stamps is None or not source.is_dir():
        return sequence
    own_poses = own_poses and (source / GROUNDTRUTH).is_file()
    return _with_tum_files(sequence, stamps, max_difference, own_poses)


def _euroc(folder: Path, max_difference: float, own_poses: bool) -> ImageSequence:
    """Read EuRoC MAV and TUM-VI (Burri et al., IJRR 2016): the left camera; its poses are computed from the body's."""
    listing = _cam0(folder) / "data.csv"
    base = listing.parent.parent
    if not listing.is_file():
        expected = "expected an EuRoC sequence, a folder with mav0/cam0/data.csv"
        raise InputError(f"no such file; {expected}{nearest_existing(listing)}", listing)
    stamps, images = [], []
    for row in read_table(listing, 'a list of images, "timestamp [ns],filename" per line').rows:
        if len(row.cells) < 2 or not re.fullmatch("[0-9]{1,19}", row.cells[0]):
            expected = "a time in nanoseconds and the name of an image, with a comma between them"
            raise InputError(f'expected {expected}, found "{",".join(row.cells):.60}"', listing, row.line, 1)
        stamps.append(int(row.cells[0]) * 1e-9)
        image = listing.parent / "data" / row.cells[1]
        if not os.path.isfile(image):
            raise InputError(f'no such image "{image.name}" in {image.parent}', listing, row.line, 1)
        images.append(image)
    if not images:
        raise InputError("lists no images", listing)
    order = np.argsort(stamps, kind="stable")
    images = tuple(images[i] for i in order)
    sequence = ImageSequence(images, _names(images, folder), np.array(stamps)[order], folder)
    sensor = listing.parent / "sensor.yaml"
    if sensor.is_file():
        sequence = _with_camera(sequence, sensor)
    paths = [base / name / "data.csv" for name in EUROC_POSES]
    path = next((path for path in paths if path.is_file()), None)
    return _with_poses(sequence, path, "euroc", max_difference) if own_poses and path else sequence


def _calibration(path: Path) -> str:
    """Return the text of a calibration, whose comments may be in any encoding. Raises InputError if unreadable."""
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as fault:
        raise InputError(unreadable(path, fault, "the camera's calibration"), path) from fault


def _kitti(folder: Path, max_difference: float, own_poses: bool) -> ImageSequence:
    """Read KITTI odometry (Geiger et al., CVPR 2012): ``sequences/00`` with image_0 to image_3, and ``poses/00.txt``.

    The file has the poses of camera 0. For another camera they are moved by the offset in ``calib.txt``.
    """
    cameras = [name for name in KITTI_CAMERAS if (folder / name).is_dir()]
    if not cameras:
        raise InputError(f"has none of {', '.join(KITTI_CAMERAS)}; expected a folder such as sequences/00", folder)
    images = list_images(folder / cameras[0]).paths
    times = None
    if (folder / "times.txt").is_file():
        times = _times(folder / "times.txt", len(images))
    sequence = ImageSequence(images, _names(images, folder), times, folder)
    if (folder / "calib.txt").is_file():
        sequence = _with_camera(sequence, folder / "calib.txt", _projection(folder))
    paths = (folder / "poses.txt", folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt")
    path = next((path for path in paths if path.is_file()), None)
    return _with_poses(sequence, path, "kitti", max_difference) if own_poses and path else sequence


def _video(source: Path, max_difference: float, own_poses: bool) -> ImageSequence:
    if not source.is_file():
        raise InputError(f"no such video{nearest_existing(source)}", source)
    count = video_length(source)
    if count is None:
        raise InputError("does not say how many frames it has; save its frames as images", source)
    return ImageSequence.of_video(source, count)


_READERS: dict[str, Callable[[Path, float, bool], ImageSequence]] = {
    "tum": _tum,
    "euroc": _euroc,
    "kitti": _kitti,
    "images": _images,
    "video": _video,
}


def _times(path: Path, frames: int) -> np.ndarray:
    """Read the times (N,) of frames: the column of that name, or the only one."""
    table = read_table(path, "the time of each frame")
    column = table.column(TIME)
    if column is None and any(len(row.cells) != 1 for row in table.rows):
        raise InputError("has several columns and none named timestamp; name them in the first line", path, 1, 1)
    column = column or 0
    if len(table.rows) != frames:
        raise InputError(f"has {len(table.rows)} times, but there are {frames} images", path)
    cells = [(row, row.cells[column] if column < len(row.cells) else "") for row in table.rows]
    times = np.array([number(cell, path, row.line, 1) for row, cell in cells])
    unit = table.unit(column) if table.names else ""
    return times * UNITS[unit] if unit else seconds_of(times)


def _names(images: tuple[Path, ...], folder: Path) -> tuple[str, ...]:
    return tuple(image.relative_to(folder).as_posix() for image in images)
