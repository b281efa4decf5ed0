"""Small synthetic ROS bags of the common path, written with the library that reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from places_layouts import COUNT, MOUNT, SIZE, path, picture, quaternions

START_S = 1_700_000_000


class Bag:
    """A bag of the common path: images, odometry of the body, a static transform to the camera, a CameraInfo."""

    def __init__(
        self,
        file: Path,
        ros: int,
        encoding: str = "rgb8",
        second_camera: bool = False,
        topic: str = "/cam/image",
        count: int = COUNT,
        stamp: Callable[[int], float] = lambda i: START_S + i,
        amcl: bool = False,
        begin: int = 0,
        storage: str = "SQLITE3",
        odometry: Callable[[int, np.ndarray], np.ndarray] = lambda _, pose: pose,
    ) -> None:
        """Write a bag to a file, or to a folder for ROS 2.

        stamp     the stamp of message i; each is received at START_S + begin + i
        amcl      also write the true poses to /amcl_pose
        odometry  the number of a message and the pose (4, 4) of the body -> the pose that the wheels measure
        """
        self.file, self._ros, self._stamp, self._begin = file, ros, stamp, begin
        self._store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        tree = "tf2_msgs/msg/TFMessage"
        if tree not in self._store.types:
            self._store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tree))
        self._types = self._store.types
        with Writer1(file) if ros == 1 else Writer2(file, version=9, storage_plugin=StoragePlugin[storage]) as writer:
            self._writer = writer
            camera_info = topic.rsplit("/", 1)[0] + "/camera_info"
            topics = {
                topic: "sensor_msgs/msg/CompressedImage" if encoding == "png" else "sensor_msgs/msg/Image",
                "/odom": "nav_msgs/msg/Odometry",
                "/tf_static": "tf2_msgs/msg/TFMessage",
                camera_info: "sensor_msgs/msg/CameraInfo",
            }
            if amcl:
                topics["/amcl_pose"] = "geometry_msgs/msg/PoseWithCovarianceStamped"
            if second_camera:
                topics["/other/image"] = topics[topic]
            self._connections = {
                topic: writer.add_connection(topic, kind, typestore=self._store) for topic, kind in topics.items()
            }
            self._kinds = topics
            self._write("/tf_static", 0, self._tree())
            self._write(camera_info, 0, self._camera_info())
            body = path() @ np.linalg.inv(MOUNT)
            for i in range(count):
                self._write(topic, i, self._image(i, encoding))
                if second_camera:
                    self._write("/other/image", i, self._image(i, encoding))
                self._write("/odom", i, self._odometry(i, odometry(i, body[i])))
                if amcl:
                    self._write("/amcl_pose", i, self._posed(i, path()[i]))

    def make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _write(self, topic: str, second: int, message: Any) -> None:
        kind = self._kinds[topic]
        serialize = self._store.serialize_ros1 if self._ros == 1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], (START_S + self._begin + second) * 10**9, serialize(message, kind))

    def _header(self, second: int, frame: str) -> Any:
        sec, part = divmod(self._stamp(second), 1)
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(sec), nanosec=round(part * 1e9))
        numbered = {"seq": second} if self._ros == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **numbered)

    def _image(self, i: int, encoding: str) -> Any:
        image = picture(i)
        if encoding == "png":
            data = np.frombuffer(cv2.imencode(".png", image)[1].tobytes(), np.uint8)
            header = self._header(i, "camera")
            return self.make("sensor_msgs/msg/CompressedImage", header=header, format="png", data=data)
        if encoding == "rgb8":
            image = image[..., ::-1]
        if encoding == "mono16":  # of a camera of 12 bits, in the dark at every other image
            gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint16) << (1 if i % 2 else 4)
            image = np.frombuffer(gray.tobytes(), np.uint8)
        padded = np.pad(image.reshape(SIZE[1], -1), ((0, 0), (0, 5)))  # a row may be longer than its pixels
        return self.make(
            "sensor_msgs/msg/Image",
            header=self._header(i, "camera"),
            height=SIZE[1],
            width=SIZE[0],
            encoding=encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=padded.ravel(),
        )

    def _turn(self, pose: np.ndarray) -> Any:
        x, y, z, w = quaternions(pose[None])[0] if np.isfinite(pose).all() else np.full(4, np.nan)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _at(self, pose: np.ndarray) -> Any:
        point = self.make("geometry_msgs/msg/Point", x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
        at = self.make("geometry_msgs/msg/Pose", position=point, orientation=self._turn(pose))
        return self.make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36))

    def _posed(self, i: int, pose: np.ndarray) -> Any:
        header = self._header(i, "map")
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=self._at(pose))

    def _odometry(self, i: int, pose: np.ndarray) -> Any:
        none = np.zeros(36)
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self._header(i, "odom"),
            child_frame_id="base",
            pose=self._at(pose),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )

    def _tree(self) -> Any:
        """The camera on a mast on the base: two links, the second written from the camera to the mast."""
        mast = np.eye(4)
        mast[2, 3] = 0.15
        links = [("base", "mast", mast), ("camera", "mast", np.linalg.inv(MOUNT) @ mast)]
        made = []
        for parent, child, pose in links:
            step = self.make("geometry_msgs/msg/Vector3", x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
            transform = self.make("geometry_msgs/msg/Transform", translation=step, rotation=self._turn(pose))
            header = self._header(0, parent)
            made.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
                )
            )
        return self.make("tf2_msgs/msg/TFMessage", transforms=made)

    def _camera_info(self) -> Any:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        k, r, p = np.array([28.5, 0, 15.5, 0, 28.25, 11.5, 0, 0, 1]), np.eye(3).ravel(), np.zeros(12)
        names = ("D", "K", "R", "P") if self._ros == 1 else ("d", "k", "r", "p")
        matrices = dict(zip(names, (np.array([0.1, -0.2, 0.0, 0.0, 0.0]), k, r, p), strict=True))
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(0, "camera"),
            height=SIZE[1],
            width=SIZE[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
        )
