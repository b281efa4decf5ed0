"""A ROS 2 node: images, calibration and odometry in; loops, the corrected path and the transform map -> odom out.

    python3 ros2_node.py --ros-args -r image:=/camera/image_raw -r camera_info:=/camera/camera_info -r odom:=/odom

in   image  sensor_msgs/Image;  camera_info  sensor_msgs/CameraInfo;  odom  nav_msgs/Odometry: joined by their stamps
out  loops  geometry_msgs/PoseWithCovarianceStamped: the position of the robot by a loop, on the corrected path
     path   nav_msgs/Path: all keyframes, corrected;  tf: the frame of the odometry in map_frame
parameters  describe (default), map_frame (map), step (m) and turn (rad) between keyframes, recent (s): no loops with
            the last so many seconds, slop (s): the largest difference of stamps, in_memory (1000): the others are in a
            temporary file; mount: the camera in the robot, seven numbers, x y z qx qy qz qw (default: from tf)
"""

import queue
import threading
from contextlib import suppress

import message_filters
import numpy as np
import rclpy
import tf2_ros
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from loopclosure import LoopDetector
from loopclosure.closing.measure import CHECK
from loopclosure.closing.online import Keyframes, LoopCloser
from loopclosure.closing.relative import ROTATION_ONLY
from loopclosure.detector.export import LOOP_SIGMAS
from loopclosure.detector.run import load_describe
from loopclosure.errors import InputError
from loopclosure.places.messages import camera_of, image_of, pose_of, seconds

UNKNOWN = 1e6  # the variance of a position that a loop does not measure
DEFAULTS = {"describe": "default", "map_frame": "map", "step": 0.1, "turn": 0.1, "recent": 10.0}
DEFAULTS |= {"slop": 0.05, "in_memory": 1000}
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # who subscribes later gets the last message


def fill(place, turn, pose):  # a position and a quaternion of a message
    place.x, place.y, place.z = map(float, pose[:3])
    turn.x, turn.y, turn.z, turn.w = map(float, pose[3:])


class LoopClosure(Node):
    def __init__(self):
        super().__init__("loopclosure")
        self.set = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
        self.mount = list(self.declare_parameter("mount", [0.0] * 7).value)  # no rotation: not given
        self.describe, self.closer, self.shown = load_describe(self.set["describe"]), None, 0
        self.warn, self.odom_frame, self.newest = self.get_logger().warning, "", queue.Queue(1)
        self.loops = self.create_publisher(PoseWithCovarianceStamped, "loops", 10)
        self.path = self.create_publisher(Path, "path", KEPT)
        self.tf, self.buffer = tf2_ros.TransformBroadcaster(self), tf2_ros.Buffer()
        self.listener = tf2_ros.TransformListener(self.buffer, self)
        topics = ((Image, "image"), (CameraInfo, "camera_info"), (Odometry, "odom"))
        inputs = [message_filters.Subscriber(self, *each, qos_profile=qos_profile_sensor_data) for each in topics]
        self.joined = message_filters.ApproximateTimeSynchronizer(inputs, 30, self.set["slop"])
        self.joined.registerCallback(self.on_messages)
        self.create_timer(0.1, self.tell)
        self.worker = threading.Thread(target=self.work, daemon=True)
        self.worker.start()

    def on_messages(self, *messages):  # the newest ones; the worker looks at them when it is ready
        with suppress(queue.Empty):
            self.newest.get_nowait()
        self.newest.put(messages)

    def work(self):
        while (messages := self.newest.get()) is not None:
            try:
                self.look(*messages)
            except InputError as fault:
                self.warn(f"{fault.message}; the image is left out")

    def look(self, image, camera_info, odometry):
        if self.closer is None and not self.begin(image, camera_info, odometry):
            return
        loop = self.closer.add(image_of(image), seconds(image.header.stamp), pose_of(odometry))
        if loop is not None:
            self.tell_loop(loop, image.header.stamp)

    def begin(self, image, camera_info, odometry):
        camera, mount = camera_of(camera_info), self.mount
        if camera is None:
            self.warn("camera_info has no calibration of a pinhole camera; the images are left out until it has")
            return False
        if not any(mount[3:]):
            frames = odometry.child_frame_id, image.header.frame_id
            try:
                mount = pose_of(self.buffer.lookup_transform(*frames, Time()))
            except tf2_ros.TransformException as fault:
                self.warn(f"tf has no camera in the robot ({fault}); the images are left out until it has")
                return False
        kept, recent = self.set["in_memory"], self.set["recent"]
        detector = LoopDetector(self.describe, check=CHECK, exclude_seconds=recent, in_memory=kept)
        self.odom_frame = odometry.header.frame_id
        self.closer = LoopCloser(detector, camera, mount, Keyframes(self.set["step"], self.set["turn"]), self.warn)
        self.closer.start()
        return True

    def stamped(self, kind, stamp):
        message = kind()
        message.header.stamp, message.header.frame_id = stamp, self.set["map_frame"]
        return message

    def tell_loop(self, loop, stamp):
        message = self.stamped(PoseWithCovarianceStamped, stamp)
        fill(message.pose.pose.position, message.pose.pose.orientation, self.closer.by_loop(loop))
        place = UNKNOWN if loop.relative.kind == ROTATION_ONLY else LOOP_SIGMAS.translation_m**2
        message.pose.covariance = np.diag([place] * 3 + [LOOP_SIGMAS.rotation_rad**2] * 3).ravel().tolist()
        self.loops.publish(message)

    def tell(self):  # ten times a second: the transform, and the path if it was corrected again
        if self.closer is None:
            return
        message = self.stamped(TransformStamped, self.get_clock().now().to_msg())
        message.child_frame_id = self.odom_frame
        fill(message.transform.translation, message.transform.rotation, self.closer.correction)
        self.tf.sendTransform(message)
        if self.closer.solutions > self.shown:
            self.shown, path = self.closer.solutions, self.stamped(Path, message.header.stamp)
            for stamp, pose in zip(*self.closer.path(), strict=True):
                path.poses.append(self.stamped(PoseStamped, Time(seconds=stamp).to_msg()))
                fill(path.poses[-1].pose.position, path.poses[-1].pose.orientation, pose)
            self.path.publish(path)

    def end(self):
        self.newest.put(None)
        self.worker.join()
        if self.closer is not None:
            self.closer.stop()


def main():
    rclpy.init()
    node = LoopClosure()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.end()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
