"""Images, poses, odometry and calibration from ROS 1 and ROS 2 bags, through the library ``rosbags`` (an extra)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.bag_files import bag_paths, check_spans
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.messages import camera_of, image_of, pixels_of, pose_of, seconds
from loopclosure.places.pixels import bits_of
from loopclosure.places.pose_files import NORM_TOLERANCE
from loopclosure.places.stamps import mended
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


@dataclass(frozen=True)
class Topics:
    """The topics to read from a bag; an empty name means that it is found from the types and names of its topics."""

    images: str = ""
    poses: str = ""
    odometry: str = ""


BY_NAME = Topics()


@dataclass(frozen=True)
class BagPath:
    """Poses of a topic: ``stamps`` (N,) in s, ascending, ``poses`` (N, 7), and a sentence about them."""

    stamps: np.ndarray
    poses: np.ndarray
    about: str


class Bag:
    """An open bag, with its topics of images, of true poses and of odometry.

    topics      their names; "" if it has no poses or no odometry, or if several topics are possible
    doubts      sentences about topics that were not chosen, and about stamps that were replaced
    pose_fault  why the bag has no poses, if it has several topics with poses
    """

    def __init__(self, reader: Any, path: Path, topics: Topics) -> None:
        self._reader, self.path = reader, path
        self.doubts: list[str] = []
        images = {c.topic: c for c in reader.connections if c.msgtype in IMAGES}
        likely = [name for name in images if "depth" not in name] or list(images)
        if not topics.images and len(likely) != 1:
            if likely:
                several = ", ".join(likely)
                raise InputError(f"has several topics with images: {several}; choose one with topic=", path)
            known = ", ".join(f"{c.topic} ({c.msgtype})" for c in reader.connections)
            raise InputError(f"has no topic with images; there are: {known or 'none'}", path)
        posed = {c.topic: c.msgtype for c in reader.connections if c.msgtype in POSES}
        measured = [name for name, kind in posed.items() if is_odometry(name, kind) and name != topics.poses]
        true = [name for name in posed if name not in measured and name != topics.odometry]
        self.pose_fault = ""
        self.topics = Topics(
            self._existing(topics.images, list(images), "images") or likely[0],
            self._existing(topics.poses, list(posed), "poses") or self._only(true, "poses", "pose-topic="),
            self._existing(topics.odometry, list(posed), "poses")
            or self._only(measured, "odometry", "odometry-topic="),
        )
        self.frame = ""  # the frame_id of the images; known after reading them
        self.count = sum(c.msgcount for c in reader.connections if c.topic == self.topics.images)
        self._offset = 0.0  # of the clock of the stamps to that of the receipt

    def images(self) -> Iterator[tuple[float, float, np.ndarray]]:
        """Yield the stamp and the time of receipt in seconds, and the image (H, W, 3) uint8 BGR.

        A stamp may be 0 or go back; see :meth:`mended`.
        """
        with _reading(self.path):
            try:
                least = self._bits()
                for received, message in self._messages(self.topics.images):
                    self.frame = message.header.frame_id
                    yield seconds(message.header.stamp), received, image_of(message, least)
            except InputError as fault:
                raise InputError(f"{self.topics.images} has {fault.message}", self.path) from None

    def _bits(self) -> int:
        """Return how many bits the brightest of the images uses."""
        most = 8
        for _, message in self._messages(self.topics.images):
            pixels = pixels_of(message)
            if pixels.dtype == np.uint8:
                break
            most = max(most, bits_of(pixels))
        return most

    def image_stamps(self) -> np.ndarray:
        """Return the stamps (N,) of the images in seconds, without decoding them."""
        with _reading(self.path):
            times = [(seconds(m.header.stamp), received) for received, m in self._messages(self.topics.images)]
        return self.mended(np.array(times).reshape(-1, 2), self.topics.images)

    def mended(self, times: np.ndarray, topic: str) -> np.ndarray:
        """Return stamps (N,) from the stamps and times of receipt (N, 2) of a topic; those at fault are replaced."""
        stamps, replaced, self._offset = mended(times[:, 0], times[:, 1], self._offset)
        if count := int(np.count_nonzero(replaced)):
            self.doubts.append(
                f"stamps of {topic} that are 0 or go back, replaced by the time of receipt: {count} of {len(stamps)}"
            )
        return stamps

    def poses(self) -> BagPath | None:
        """Return the true poses of the camera, None if there are none."""
        return self._path(self.topics.poses)

    def odometry(self) -> BagPath | None:
        """Return the odometry of the camera, None if there is none."""
        return self._path(self.topics.odometry)

    def _path(self, topic: str) -> BagPath | None:
        """Return the poses of a topic; a static transform from their frame to that of the images is applied."""
        if not topic:
            return None
        times, rows, child = [], [], ""
        with _reading(self.path):
            for received, message in self._messages(topic):
                child = getattr(message, "child_frame_id", "")
                times.append((seconds(message.header.stamp), received))
                rows.append(pose_of(message))
            mount = self._mount(child) if child and self.frame else None
        poses, stamps = np.array(rows).reshape(-1, 7), self.mended(np.array(times).reshape(-1, 2), topic)
        lengths = np.linalg.norm(poses[:, 3:], axis=1)
        usable = np.isfinite(poses).all(axis=1) & (np.abs(lengths - 1) <= NORM_TOLERANCE)
        if left_out := int(np.count_nonzero(~usable)):
            self.doubts.append(f"poses of {topic} that are NaN or no rotation, left out: {left_out} of {len(poses)}")
        order = np.flatnonzero(usable)[np.argsort(stamps[usable], kind="stable")]
        poses, stamps = poses[order], stamps[order]
        poses[:, 3:] /= lengths[order, None]
        what = "odometry" if topic == self.topics.odometry else "poses"
        if mount is None:
            return BagPath(
                stamps, poses, f"{what} of {topic} {'is' if what == 'odometry' else 'are'} taken as the camera's"
            )
        return BagPath(stamps, moved(poses, mount), f"{what} of {topic}, moved from {child} to {self.frame}")

    def camera(self) -> Intrinsics | None:
        """Return the camera from the CameraInfo topic next to the images, None if there is none."""
        with _reading(self.path):
            return self._camera()

    def _camera(self) -> Intrinsics | None:
        topic = self.topics.images
        namespace = topic.rsplit("/", 2 if topic.endswith("/compressed") else 1)[0]
        for connection in self._reader.connections:
            if connection.msgtype == CAMERA_INFO and connection.topic == f"{namespace}/camera_info":
                for _, message in self._messages(connection.topic):
                    return camera_of(message)
        return None

    def _messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield the time of receipt in seconds and the message."""
        connections = [c for c in self._reader.connections if c.topic == topic]
        for connection, received, raw in self._reader.messages(connections=connections):
            yield 1e-9 * received, self._reader.deserialize(raw, connection.msgtype)

    def _existing(self, wanted: str, known: list[str], what: str) -> str:
        if wanted and wanted not in known:
            raise InputError(f'has no topic "{wanted}" with {what}; there are: {", ".join(known) or "none"}', self.path)
        return wanted

    def _only(self, known: list[str], what: str, option: str) -> str:
        """Return the only topic of a kind; with several, none is used."""
        if len(known) < 2:
            return known[0] if known else ""
        several = f"has several topics with {what}: {', '.join(known)}; choose one with {option}"
        if several.startswith(NO_POSES):
            self.pose_fault = several
        else:
            self.doubts.append(f"{several}; none is used")
        return ""

    def _mount(self, body: str) -> np.ndarray | None:
        """Return the pose (4, 4) of the camera in the frame ``body`` from static transforms; None if not known."""
        near: dict[str, list[tuple[str, np.ndarray]]] = {}
        for connection in self._reader.connections:
            if connection.msgtype != TREE or not connection.topic.endswith("tf_static"):
                continue
            for _, message in self._messages(connection.topic):
                for link in message.transforms:
                    place, turn = link.transform.translation, link.transform.rotation
                    step = np.eye(4)
                    step[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
                    step[:3, 3] = place.x, place.y, place.z
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
    with ExitStack() as stack:
        links = Path(stack.enter_context(TemporaryDirectory()))
        with _reading(path):
            paths = bag_paths(path, links)
            reader = stack.enter_context(AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
            if len(paths) > 1:
                check_spans([(each.start_time, each.end_time) for each in reader.readers], path)
            bag = Bag(reader, path, topics)
        yield bag


def bag_frames(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (stamp in seconds, image (H, W, 3) uint8 BGR) for each image of a bag."""
    with open_bag(path) as bag:
        stamps = bag.image_stamps().tolist()
        for stamp, (_, _, image) in zip(stamps, bag.images(), strict=True):
            yield stamp, image


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Convert any exception in the block to InputError: for a damaged bag the library raises many kinds."""
    try:
        yield
    except SpecError:
        raise
    except Exception as fault:
        reason = " ".join(str(fault).split()) or type(fault).__name__
        raise InputError(f"cannot be read as a ROS bag ({reason})", path) from None
