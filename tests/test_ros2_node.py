"""examples/ros2_node.py with a stand-in for ROS: what it subscribes, what it says, and that it goes on after faults."""

import runpy
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import rclpy_stand_in as ros
from paths import ROOT

SIZE = 160, 120
FOCAL = 131.25


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    ros.installed(monkeypatch)
    monkeypatch.setattr(
        ros.Node, "given", {"describe": "loopclosure.descriptors.thumbnails:Thumbnailer", "recent": 1.0, "gap": 2.0}
    )
    made = runpy.run_path(str(ROOT / "examples" / "ros2_node.py"))["LoopClosure"]()
    yield made
    made.end()


def wall(shift: int) -> np.ndarray:
    """A textured wall, seen from further right by ``shift`` pixels."""
    rng = np.random.default_rng(0)
    whole = sum(np.kron(rng.integers(0, 80, (480 // side, 640 // side)), np.ones((side, side))) for side in (8, 20, 40))
    return np.asarray(whole, np.uint8)[100:220, 100 + shift : 260 + shift]


def messages(stamp: float, shift: int, encoding: str = "mono8") -> list[Any]:
    made = ros.Time(seconds=stamp).to_msg()
    image = ros.Image(height=SIZE[1], width=SIZE[0], encoding=encoding, step=SIZE[0], data=wall(shift).tobytes())
    camera = ros.CameraInfo(height=SIZE[1], width=SIZE[0], distortion_model="plumb_bob", d=[0.0] * 5)
    camera.k = [FOCAL, 0, 80, 0, FOCAL, 60, 0, 0, 1]
    odometry = ros.Odometry(child_frame_id="base")
    for each, frame in ((image, "camera"), (camera, "camera"), (odometry, "odom")):
        each.header.stamp, each.header.frame_id = made, frame
    odometry.pose.pose.position.x, odometry.pose.pose.orientation.w = 0.2 * stamp, 1.0
    return [image, camera, odometry]


def looked(node: Any, sent: list[Any], until: Callable[[], object]) -> None:
    """Send messages and wait until the node has looked at them."""
    for message in reversed(sent):  # the image is the last one
        (callback,) = (called for kind, called in node.subscriptions.values() if isinstance(message, kind))
        callback(message)
    end = time.monotonic() + 60
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)


def keyframes(node: Any) -> int:
    return 0 if node.closer is None else len(node.closer.path()[0])


def test_it_subscribes_to_three_topics_and_says_nothing_before_it_knows_anything(node: Any) -> None:
    kinds = {topic: kind for topic, (kind, _) in node.subscriptions.items()}
    assert kinds == {"image": ros.Image, "camera_info": ros.CameraInfo, "odom": ros.Odometry}
    assert set(node.publishers) == {"loops", "path"}
    node.timers[0]()
    assert node.tf.sent == []


def test_it_waits_for_a_calibration_and_the_mount(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    first = messages(0.0, 0)
    first[1].k = [0.0] * 9
    looked(node, first, lambda: node.warnings)
    assert node.warnings[0].startswith("camera_info has no calibration")
    looked(node, messages(1.0, 0), lambda: len(node.warnings) > 1)
    assert node.warnings[1].startswith('"base" passed to lookupTransform does not exist; the image')
    mount = ros.TransformStamped()
    mount.transform.rotation.w, mount.transform.translation.z = 1.0, 0.5
    monkeypatch.setitem(ros.Buffer.known, ("base", "camera"), mount)
    looked(node, messages(2.0, 0), lambda: keyframes(node) == 1)
    np.testing.assert_allclose(node.closer.mount, [0, 0, 0.5, 0, 0, 0, 1])
    assert len(node.warnings) == 2


def test_it_closes_a_loop_and_goes_on_after_faults(node: Any) -> None:
    node.mount = [0, 0, 0, -0.5, 0.5, -0.5, 0.5]
    for second, shift in enumerate((0, 160, 320)):
        looked(node, messages(second, shift), lambda count=second + 1: keyframes(node) == count)
    for sent, said in (
        (messages(3.0, 320, "32FC1"), 'images in "32FC1"; known: mono8'),
        (messages(1.5, 320), "an image came late, 0.500 s before"),
        (messages(3.5, 320)[:1] + messages(9.0, 0)[2:], "the image at 3.500000 has no odometry within 2 s"),
    ):
        before = len(node.warnings)
        looked(node, sent, lambda before=before: len(node.warnings) > before)
        assert node.warnings[-1].startswith(said)
    looked(node, messages(10.0, 1), lambda: node.publishers["loops"].sent)  # where it was at first
    (loop,) = node.publishers["loops"].sent
    assert loop.header.frame_id == "map"
    assert loop.pose.covariance[0] > 0
    looked(node, messages(0.5, 160), lambda: keyframes(node) == 5)  # a bag that starts again
    assert node.warnings[-1].startswith("the time goes back by 9.5 s, to 0.500000: another drive begins")
    node.closer.stop()
    node.closer.solve()
    node.timers[0]()
    (transform,), (path,) = node.tf.sent, node.publishers["path"].sent
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert len(path.poses) == 5
    assert path.poses[3].header.stamp.sec == 10
    node.timers[0]()
    assert len(node.publishers["path"].sent) == 1  # it has not changed
