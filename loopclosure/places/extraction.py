"""Bags and videos as folders in TUM's layout, which every other part reads."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.bags import is_bag, open_bag
from loopclosure.places.frames import VIDEO_SUFFIXES, video_frames, video_length, write_picture
from loopclosure.places.intrinsics import write_calibration
from loopclosure.places.pose_files import DIRECTIONS, FORMS, ORDERS
from loopclosure.places.trajectory import Frame, Trajectory, write_rgb_list, write_trajectory
from loopclosure.progress import Progress, silent
from netspec.files.opencv import cv2
from netspec.files.whole_file import whole_folder

MADE_FROM = "source.txt"
# What the commands call the sequences with poses.
LAYOUTS = {
    "tum": "a TUM RGB-D sequence",
    "euroc": "an EuRoC sequence (mav0/)",
    "kitti": "a KITTI odometry sequence (sequences/00)",
    "bag": "a ROS 1 or ROS 2 bag",
    "video": "a video (with poses)",
}
RECORDED = ("bag", "video")  # their frames are extracted first
POSES_HELP = "the camera's poses, in the form of TUM, KITTI or EuRoC, instead of the sequence's own"
POSE_FORM_HELP = (
    f"how poses are written, if it is not seen: {', '.join((*FORMS, *ORDERS, *DIRECTIONS))}; commas between"
)


def is_recording(source: Path) -> bool:
    """Return whether a source is a bag or a video, whose frames are not files."""
    return is_bag(source) or source.suffix.lower() in VIDEO_SUFFIXES


def extract(
    source: Path, folder: Path, topic: str = "", pose_topic: str = "", progress: Progress = silent
) -> tuple[Path, str]:
    """Write the frames of a bag or video into a new ``folder`` in TUM's layout; return it, and a sentence about it.

    rgb/ has the images as PNG, rgb.txt their times; groundtruth.txt and calibration.txt are written where a bag has
    poses and a CameraInfo. A folder that was made from the same file, with the same topics, is kept as it is.
    Raises InputError if there is another folder of that name, or the source cannot be read.
    """
    if not source.exists():
        raise InputError("no such file", source)
    state = source.stat()
    made_from = f"{source.resolve()} {state.st_size} {state.st_mtime_ns} {topic} {pose_topic}".rstrip() + "\n"
    if folder.exists():
        if (folder / MADE_FROM).is_file() and (folder / MADE_FROM).read_text(encoding="utf-8") == made_from:
            return folder, f"{source}: its frames are in {folder} already"
        raise InputError(f"is there already, and not made from {source}; remove it, or give another --out", folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(folder) as unfinished:
        (unfinished / "rgb").mkdir()
        write = _bag if is_bag(source) else _video
        frames, about = write(source, unfinished, topic, pose_topic, progress)
        write_rgb_list(unfinished / "rgb.txt", frames)
        (unfinished / MADE_FROM).write_text(made_from, encoding="utf-8")
    return folder, f"{source}: {len(frames)} frames{about}: {folder}"


def _bag(source: Path, folder: Path, topic: str, pose_topic: str, progress: Progress) -> tuple[list[Frame], str]:
    with open_bag(source, topic, pose_topic) as bag:
        frames = _write_images(folder, progress(bag.images(), source.name, bag.count))
        if not frames:
            raise InputError(f"has no image in {bag.topic}", source)
        about = f" of {bag.topic}"
        camera = bag.camera()
        if camera is not None:
            write_calibration(folder / "calibration.txt", camera)
        if bag.pose_topic:
            stamps, poses, said = bag.poses()
            if len(poses):
                order = np.argsort(stamps, kind="stable")
                trajectory = Trajectory(stamps[order], poses[order, :3], poses[order, 3:])
                write_trajectory(folder / "groundtruth.txt", trajectory)
                about += f", {said}"
    return frames, about


def _video(source: Path, folder: Path, topic: str, pose_topic: str, progress: Progress) -> tuple[list[Frame], str]:
    if topic or pose_topic:
        raise InputError("is a video, which has no topics", source)
    return _write_images(folder, progress(video_frames(source), source.name, video_length(source))), ""


def _write_images(folder: Path, images: Iterable[tuple[float, np.ndarray]]) -> list[Frame]:
    frames = []
    for number, (stamp, image) in enumerate(images):
        frame = Frame(stamp, f"rgb/{number:06d}.png")
        write_picture(folder / frame.path, image, cv2.IMWRITE_PNG_COMPRESSION, 1)
        frames.append(frame)
    return frames
