"""Images, poses, odometry and calibration from ROS 1 and ROS 2 bags, through the library ``rosbags`` (an extra)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.messages import camera_of, image_of, is_rectified, pixels_of, pose_of, seconds
from loopclosure.places.pixels import bits_of
from loopclosure.places.pose_files import NORM_TOLERANCE
from loopclosure.places.trajectory import moved
from netspec.errors import SpecError

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (
    ODOMETRY,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
# Parts of the names of topics. Other topics of Odometry are odometry, and other topics of poses are poses.
TRUE = re.compile(
    r"truth|(^|[/_])(gt|rtk)([/_]|$)|mocap|motion_capture|vicon|optitrack|qualisys|vrpn|amcl", re.IGNORECASE
)
MEASURED = re.compile(r"odom|(^|[/_])(vo|vio|lio|icp|ekf)([/_]|$)|wheel|estimat|vins|okvis|rovio|slam", re.IGNORECASE)
NO_POSES = "has several topics with poses"
CAMERA_INFO, TREE = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
SUFFIXES, METADATA = (".bag", ".mcap", ".db3"), "metadata.yaml"
A_DATE = 1e6  # seconds; a smaller stamp is a time since the start


@dataclass(frozen=True)
class Topics:
    """The topics to read from a bag; an empty name means that it is found from the types and names of its topics."""

    images: str = ""
    poses: str = ""
    odometry: str = ""


BY_NAME = Topics()


@dataclass(frozen=True)
class BagPath:
    """Poses of a topic: ``times`` (N, 2), stamps and times of receipt in s; ``poses`` (N, 7); a sentence about them."""

    times: np.ndarray
    poses: np.ndarray
    about: str


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: by its suffix, or a folder with metadata.yaml or with nothing but bags."""
    if not path.is_dir():
        return path.suffix.lower() in SUFFIXES
    files = [file for file in path.iterdir() if not file.name.startswith(".")]
    return (path / METADATA).is_file() or (bool(files) and all(file.suffix.lower() in SUFFIXES for file in files))


def right(stamps: np.ndarray) -> bool:
    """Return whether the stamps (N,) of a topic are times: none is 0 among dates, none goes back, not all are equal."""
    if len(stamps) < 2:
        return len(stamps) == 0 or bool(stamps[0] > 0)
    zero = stamps.min() <= 0 and stamps.max() > A_DATE
    return bool((np.diff(stamps) >= 0).all() and stamps.max() > stamps.min() and not zero)


class Bag:
    """An open bag, with its topics of images, of true poses and of odometry.

    topics      their names; "" if it has no poses or no odometry, or if several topics are possible
    doubts      sentences about topics that were not chosen, and about poses that were left out
    pose_fault  why the bag has no poses, if it has several topics with poses
    """

    def __init__(self, reader: Any, path: Path, topics: Topics) -> None:
        self._reader, self.path = reader, path
        self.doubts: list[str] = []
        self.pose_fault = ""
        images = list({c.topic: None for c in reader.connections if c.msgtype in IMAGES})
        likely = [name for name in images if "depth" not in name] or images
        posed = {c.topic: c.msgtype for c in reader.connections if c.msgtype in POSES}
        measured = [name for name, kind in posed.items() if is_odometry(name, kind) and name != topics.poses]
        true = [name for name in posed if name not in measured and name != topics.odometry]
        for wanted, known, what in ((topics.images, images, "images"), (topics.poses, posed, "poses")):
            self._check(wanted, list(known), what)
        self._check(topics.odometry, list(posed), "poses")
        if not topics.images and len(likely) != 1:
            several = f"has several topics with images: {', '.join(likely)}; choose one with topic="
            there = ", ".join(f"{c.topic} ({c.msgtype})" for c in reader.connections) or "none"
            raise InputError(several if likely else f"has no topic with images; there are: {there}", path)
        if len(true) > 1 and not topics.poses:
            self.pose_fault = f"{NO_POSES}: {', '.join(true)}; choose one with pose-topic="
        if len(measured) > 1 and not topics.odometry:
            several = f"has several topics with odometry: {', '.join(measured)}; choose one with odometry-topic="
            self.doubts.append(f"{several}; none is used")
        self.topics = Topics(
            topics.images or likely[0],
            topics.poses or (true[0] if len(true) == 1 else ""),
            topics.odometry or (measured[0] if len(measured) == 1 else ""),
        )
        self.frame = ""  # the frame_id of the images; known after reading them
        self.count = sum(c.msgcount for c in reader.connections if c.topic == self.topics.images)

    def _check(self, wanted: str, known: list[str], what: str) -> None:
        if wanted and wanted not in known:
            raise InputError(f'has no topic "{wanted}" with {what}; there are: {", ".join(known) or "none"}', self.path)

    def images(self) -> Iterator[tuple[float, float, np.ndarray]]:
        """Yield the stamp and the time of receipt in seconds, and the image (H, W, 3) uint8 BGR."""
        with _reading(self.path):
            try:
                least = 8  # bits that the brightest of the images uses
                for _, message in self._messages(self.topics.images):
                    pixels = pixels_of(message)
                    if pixels.dtype == np.uint8:
                        break
                    least = max(least, bits_of(pixels))
                for received, message in self._messages(self.topics.images):
                    self.frame = message.header.frame_id
                    yield seconds(message.header.stamp), received, image_of(message, least)
            except InputError as fault:
                raise InputError(f"{self.topics.images} has {fault.message}", self.path) from None

    def poses(self) -> BagPath | None:
        """Return the true poses of the camera, None if there are none."""
        return self._path(self.topics.poses, "poses")

    def odometry(self) -> BagPath | None:
        """Return the odometry of the camera, None if there is none."""
        return self._path(self.topics.odometry, "odometry")

    def _path(self, topic: str, what: str) -> BagPath | None:
        """Return the poses of a topic; a static transform from their frame to that of the images is applied."""
        times, rows, child = [], [], ""
        with _reading(self.path):
            for received, message in self._messages(topic):
                child = getattr(message, "child_frame_id", "")
                times.append((seconds(message.header.stamp), received))
                rows.append(pose_of(message))
            mount = self._mount(child) if child and self.frame else None
        if not rows:
            return None
        poses = np.array(rows)
        lengths = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        usable = np.isfinite(poses).all(axis=1) & (np.abs(lengths[:, 0] - 1) <= NORM_TOLERANCE)
        if left_out := int(np.count_nonzero(~usable)):
            self.doubts.append(f"poses of {topic} that are NaN or no rotation, left out: {left_out} of {len(poses)}")
        poses = np.hstack([poses[:, :3], poses[:, 3:] / lengths])[usable]
        about = f"moved from {child} to {self.frame}" if mount is not None else "taken as the camera's"
        poses = poses if mount is None else moved(poses, mount)
        return BagPath(np.array(times)[usable], poses, f"{what} of {topic}, {about}")

    def camera(self) -> Intrinsics | None:
        """Return the camera from the CameraInfo topic next to the images, None if there is none."""
        topic = self.topics.images
        namespace = topic.rsplit("/", 2 if topic.endswith("/compressed") else 1)[0]
        with _reading(self.path):
            for _, message in self._messages(f"{namespace}/camera_info"):
                return camera_of(message, is_rectified(topic))
        return None

    def _messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield the time of receipt in seconds and the message."""
        connections = [c for c in self._reader.connections if c.topic == topic]
        for connection, received, raw in self._reader.messages(connections=connections) if connections else ():
            yield 1e-9 * received, self._reader.deserialize(raw, connection.msgtype)

    def _mount(self, body: str) -> np.ndarray | None:
        """Return the pose (4, 4) of the camera in the frame ``body`` from static transforms; None if not known."""
        near: dict[str, list[tuple[str, np.ndarray]]] = {}
        static = [c.topic for c in self._reader.connections if c.msgtype == TREE and c.topic.endswith("tf_static")]
        for _, message in (each for topic in static for each in self._messages(topic)):
            for link in message.transforms:
                pose, step = pose_of(link), np.eye(4)
                step[:3, :3], step[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
                parent, child = link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/")
                near.setdefault(parent, []).append((child, step))
                near.setdefault(child, []).append((parent, np.linalg.inv(step)))
        reached = {body.lstrip("/"): np.eye(4)}
        waiting = list(reached)
        while waiting:
            frame = waiting.pop()
            for other, step in near.get(frame, []):
                if other not in reached:
                    reached[other] = reached[frame] @ step
                    waiting.append(other)
        return reached.get(self.frame.lstrip("/"))


def is_odometry(topic: str, kind: str) -> bool:
    """Return whether the poses of a topic are measured by the robot; else they are true."""
    if TRUE.search(topic):
        return False
    return kind == ODOMETRY or bool(MEASURED.search(topic))


@contextmanager
def open_bag(path: Path, topics: Topics = BY_NAME) -> Iterator[Bag]:
    """Open a bag for a ``with`` statement. Raises InputError if it cannot be read, or has no such topic."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            "is a ROS bag, which the library rosbags reads: pip install 'netspec-caffe[bag]'", path
        ) from None
    if not path.exists():
        raise InputError("no such bag", path)
    whole = path.is_file() or (path / METADATA).is_file()
    paths = [path] if whole else sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    with _reading(path):
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    try:
        with _reading(path):
            bag = Bag(reader, path, topics)
        yield bag
    finally:
        reader.close()


def bag_frames(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (stamp in seconds, image (H, W, 3) uint8 BGR) for each image of a bag."""
    with open_bag(path) as bag:
        with _reading(path):
            stamps = [seconds(message.header.stamp) for _, message in bag._messages(bag.topics.images)]
        by_stamp = right(np.array(stamps))
        for stamp, received, image in bag.images():
            yield stamp if by_stamp else received, image


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert any exception in the block to InputError: for a damaged bag the library raises many kinds."""
    try:
        yield
    except SpecError:
        raise
    except Exception as fault:
        reason = " ".join(str(fault).split()) or type(fault).__name__
        advice = "; ros2 bag reindex, or rosbag reindex, repairs a bag whose recording was interrupted"
        raise InputError(f"cannot be read as a ROS bag ({reason}){advice}", path) from None
