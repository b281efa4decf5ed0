"""Images, poses and calibration from ROS 1 and ROS 2 bags, through the library ``rosbags`` (an extra)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.errors import InputError
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.messages import camera_of, image_of, pose_of, seconds
from loopclosure.places.pose_files import moved
from netspec.errors import SpecError

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
CAMERA_INFO, TREE = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: a file .bag, .mcap or .db3, or a folder with metadata.yaml."""
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


class Bag:
    """An open bag, with its topic of images, and its topic of poses if it has one."""

    def __init__(self, reader: Any, path: Path, topic: str, pose_topic: str) -> None:
        self._reader, self.path = reader, path
        images = {c.topic: c for c in reader.connections if c.msgtype in IMAGES}
        color = [name for name in images if "depth" not in name]
        self.topic = self._chosen(topic, list(images), color or list(images), "images", "topic=", needed=True)
        poses = [c.topic for c in reader.connections if c.msgtype in POSES]
        self.pose_topic = self._chosen(pose_topic, poses, poses, "poses", "pose-topic=", needed=False)
        self.frame = ""  # the frame_id of the images; known after reading them
        self.count = images[self.topic].msgcount

    def images(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield (stamp in seconds, image (H, W, 3) uint8 BGR)."""
        with _reading(self.path):
            for message in self._messages(self.topic):
                self.frame = message.header.frame_id
                yield seconds(message.header.stamp), self._image(message)

    def poses(self) -> tuple[np.ndarray, np.ndarray, str]:
        """Return stamps (N,), poses (N, 7) of the camera, and a sentence about how the poses were converted.

        If the bag has a static transform from the frame of the poses to that of the images, it is applied.
        """
        with _reading(self.path):
            return self._poses()

    def _poses(self) -> tuple[np.ndarray, np.ndarray, str]:
        stamps, rows, child = [], [], ""
        for message in self._messages(self.pose_topic):
            child = getattr(message, "child_frame_id", "")
            stamps.append(seconds(message.header.stamp))
            rows.append(pose_of(message))
        poses = np.array(rows).reshape(-1, 7)
        mount = self._mount(child) if child and self.frame else None
        if mount is None:
            return np.array(stamps), poses, f"poses of {self.pose_topic} are taken as the camera's"
        return np.array(stamps), moved(poses, mount), f"poses of {self.pose_topic}, moved from {child} to {self.frame}"

    def camera(self) -> Intrinsics | None:
        """Return the camera from the CameraInfo topic next to the images, None if there is none."""
        with _reading(self.path):
            return self._camera()

    def _camera(self) -> Intrinsics | None:
        namespace = self.topic.rsplit("/", 2 if self.topic.endswith("/compressed") else 1)[0]
        for connection in self._reader.connections:
            if connection.msgtype == CAMERA_INFO and connection.topic == f"{namespace}/camera_info":
                for message in self._messages(connection.topic):
                    return camera_of(message)
        return None

    def _messages(self, topic: str) -> Iterator[Any]:
        connections = [c for c in self._reader.connections if c.topic == topic]
        for connection, _, raw in self._reader.messages(connections=connections):
            yield self._reader.deserialize(raw, connection.msgtype)

    def _chosen(self, wanted: str, known: list[str], likely: list[str], what: str, option: str, needed: bool) -> str:
        if wanted and wanted not in known:
            raise InputError(f'has no topic "{wanted}" with {what}; there are: {", ".join(known) or "none"}', self.path)
        if wanted or len(likely) == 1:
            return wanted or likely[0]
        if likely:
            several = ", ".join(likely)
            raise InputError(f"has several topics with {what}: {several}; choose one with {option}", self.path)
        if needed:
            topics = ", ".join(f"{c.topic} ({c.msgtype})" for c in self._reader.connections)
            raise InputError(f"has no topic with {what}; there are: {topics or 'none'}", self.path)
        return ""

    def _image(self, message: Any) -> np.ndarray:
        try:
            return image_of(message)
        except InputError as fault:
            raise InputError(f"{self.topic} has {fault.message}", self.path) from None

    def _mount(self, body: str) -> np.ndarray | None:
        """Return the pose (4, 4) of the camera in the frame ``body`` from static transforms; None if not known."""
        near: dict[str, list[tuple[str, np.ndarray]]] = {}
        for connection in self._reader.connections:
            if connection.msgtype != TREE or not connection.topic.endswith("tf_static"):
                continue
            for message in self._messages(connection.topic):
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


@contextmanager
def open_bag(path: Path, topic: str = "", pose_topic: str = "") -> Iterator[Bag]:
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
    if path.suffix == ".db3" and (path.parent / "metadata.yaml").is_file():
        path = path.parent
    with ExitStack() as stack:
        with _reading(path):
            reader = stack.enter_context(AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
            bag = Bag(reader, path, topic, pose_topic)
        yield bag


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
