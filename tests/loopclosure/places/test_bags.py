"""Images, poses and calibration from ROS 1 and ROS 2 bags, written here with the library that reads them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.places.extraction import extract
from loopclosure.places.sequences import read_sequence
from places_layouts import COUNT, MOUNT, SIZE, path, picture, quaternions

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_S = 1_700_000_000


class Sample:
    """A bag of the common path: images, odometry of the body, a static transform to the camera, a CameraInfo."""

    def __init__(self, file: Path, ros: int, encoding: str = "rgb8", second_camera: bool = False) -> None:
        self.file, self._ros = file, ros
        self._store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        tree = "tf2_msgs/msg/TFMessage"
        if tree not in self._store.types:
            self._store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tree))
        self._types = self._store.types
        with Writer1(file) if ros == 1 else Writer2(file, version=9) as writer:
            self._writer = writer
            topics = {
                "/cam/image": "sensor_msgs/msg/CompressedImage" if encoding == "png" else "sensor_msgs/msg/Image",
                "/odom": "nav_msgs/msg/Odometry",
                "/tf_static": "tf2_msgs/msg/TFMessage",
                "/cam/camera_info": "sensor_msgs/msg/CameraInfo",
            }
            if second_camera:
                topics["/other/image"] = topics["/cam/image"]
            self._connections = {
                topic: writer.add_connection(topic, kind, typestore=self._store) for topic, kind in topics.items()
            }
            self._kinds = topics
            self._write("/tf_static", 0, self._tree())
            self._write("/cam/camera_info", 0, self._camera_info())
            body = path() @ np.linalg.inv(MOUNT)
            for i in range(COUNT):
                self._write("/cam/image", i, self._image(i, encoding))
                if second_camera:
                    self._write("/other/image", i, self._image(i, encoding))
                self._write("/odom", i, self._odometry(i, body[i]))

    def make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _write(self, topic: str, second: int, message: Any) -> None:
        kind = self._kinds[topic]
        serialize = self._store.serialize_ros1 if self._ros == 1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], (START_S + second) * 10**9, serialize(message, kind))

    def _header(self, second: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=START_S + second, nanosec=0)
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
        x, y, z, w = quaternions(pose[None])[0]
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _odometry(self, i: int, pose: np.ndarray) -> Any:
        point = self.make("geometry_msgs/msg/Point", x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
        at = self.make("geometry_msgs/msg/Pose", position=point, orientation=self._turn(pose))
        none = np.zeros(36)
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self._header(i, "odom"),
            child_frame_id="base",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=none),
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


@pytest.mark.parametrize(
    ("name", "ros", "encoding"), [("a.bag", 1, "rgb8"), ("b", 2, "bgr8"), ("c.bag", 1, "png"), ("d", 2, "png")]
)
def test_a_bag_becomes_a_sequence(name: str, ros: int, encoding: str, tmp_path: Path) -> None:
    bag = Sample(tmp_path / name, ros, encoding).file
    folder, said = extract(bag, tmp_path / "frames")
    assert said == f"{bag}: 48 frames of /cam/image, poses of /odom, moved from base to camera: {folder}"
    sequence = read_sequence(folder)
    assert len(sequence) == COUNT
    image = cv2.imread(str(sequence.images[7]))
    np.testing.assert_array_equal(image, picture(7))
    assert sequence.stamps is not None
    assert sequence.stamps[7] == START_S + 7
    assert sequence.poses is not None
    np.testing.assert_allclose(sequence.poses[:, :3], path()[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(sequence.poses[:, 3:] * quaternions(path()), axis=1)), 1, atol=1e-5)
    assert sequence.camera is not None
    assert (sequence.camera.fy, sequence.camera.distortion[:2]) == (28.25, (0.1, -0.2))


def test_a_topic_must_be_chosen_where_there_are_several(tmp_path: Path) -> None:
    bag = Sample(tmp_path / "two.bag", 1, second_camera=True).file
    with pytest.raises(
        InputError, match="several topics with images: /cam/image, /other/image; choose one with --topic"
    ):
        extract(bag, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()
    with pytest.raises(InputError, match='has no topic "/odom" with images; there are: /cam/image, /other/image'):
        extract(bag, tmp_path / "frames", "/odom")
    assert "48 frames of /other/image" in extract(bag, tmp_path / "frames", "/other/image")[1]


def test_what_is_no_bag_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "no.bag").write_bytes(b"nothing")
    (tmp_path / "no").mkdir()
    (tmp_path / "no" / "metadata.yaml").write_text("a: [")
    for name in ("no.bag", "no"):
        with pytest.raises(InputError, match="cannot be read as a ROS bag") as caught:
            extract(tmp_path / name, tmp_path / "frames")
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"gone\.bag: no such file"):
        extract(tmp_path / "gone.bag", tmp_path / "frames")


@pytest.mark.slow
def test_the_commands_take_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = Sample(tmp_path / "drive.bag", 1).file
    line = f"evaluate --bag {bag} --method thumbnails --out {tmp_path / 'report'}"
    assert main(line.split()) == 0
    line = f"detect {bag} --threshold -0.001 --exclude-recent 10 --out {tmp_path / 'found'}"
    assert main(line.split()) == 0
    assert "24 of 24 loops are the same place by their poses" in capsys.readouterr().out
