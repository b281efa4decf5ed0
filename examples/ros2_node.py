"""A ROS 2 node: images, calibration and odometry in; loops, the corrected path and the transform map -> odom out.

    python3 ros2_node.py --ros-args -r image:=/camera/image_raw -r camera_info:=/camera/camera_info -r odom:=/odom

in   image  sensor_msgs/Image;  camera_info  sensor_msgs/CameraInfo;  odom  nav_msgs/Odometry
out  loops  geometry_msgs/PoseWithCovarianceStamped: the position of the robot by a loop, on the corrected path
     path   nav_msgs/Path: all keyframes, corrected;  tf: the frame of the odometry in the map
parameters  describe: the net (default);  map: the frame;  step, turn: meters or radians between keyframes;  recent: no
            loops with the last so many seconds;  gap: the longest in the odometry, in seconds;  kept: keyframes in
            memory, the others are in a temporary file;  mount: x y z qx qy qz qw of the camera (default: from tf)
"""

import queue
import threading
from contextlib import suppress

import rclpy
import tf2_ros
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from loopclosure import GeometricCheck, LoopCloser, LoopDetector, Synchronizer, messages

DEFAULTS = {"describe": "default", "map": "map", "step": 0.1, "turn": 0.1, "recent": 10.0, "gap": 0.5, "kept": 1000}
CHECK = GeometricCheck(max_features=1000, most_side=1_000_000)  # images are not reduced: poses are measured from points
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # who subscribes later gets the last message


def fill(place, turn, pose):  # a position and a quaternion of a message
    place.x, place.y, place.z = map(float, pose[:3])
    turn.x, turn.y, turn.z, turn.w = map(float, pose[3:])


class LoopClosure(Node):
    def __init__(self):
        super().__init__("loopclosure")
        self.set = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
        self.mount = list(self.declare_parameter("mount", [0.0] * 7).value)  # no rotation: not given
        limits = {"exclude_seconds": self.set["recent"], "in_memory": self.set["kept"]}
        self.detector, self.closer, self.shown = LoopDetector(self.set["describe"], check=CHECK, **limits), None, 0
        self.warn, self.newest = self.get_logger().warning, queue.Queue(1)
        self.loops = self.create_publisher(PoseWithCovarianceStamped, "loops", 10)
        self.path = self.create_publisher(Path, "path", KEPT)
        self.tf, self.buffer = tf2_ros.TransformBroadcaster(self), tf2_ros.Buffer()
        self.listener = tf2_ros.TransformListener(self.buffer, self)
        self.joined = Synchronizer(self.set["gap"], self.warn)
        self.camera, self.odom_frames = CameraInfo(), ("", "")  # the frames of the odometry and of the robot
        self.create_subscription(CameraInfo, "camera_info", self.on_camera_info, qos_profile_sensor_data)
        self.create_subscription(Odometry, "odom", self.on_odometry, qos_profile_sensor_data)
        self.create_subscription(Image, "image", self.on_image, qos_profile_sensor_data)
        self.create_timer(0.1, self.tell)
        self.worker = threading.Thread(target=self.work, daemon=True)
        self.worker.start()

    def on_camera_info(self, message):
        self.camera = message

    def on_odometry(self, message):
        self.odom_frames = message.header.frame_id, message.child_frame_id
        self.joined.odometry(messages.seconds(message.header.stamp), messages.pose_of(message))
        self.join()

    def on_image(self, message):
        self.joined.image(messages.seconds(message.header.stamp), message)
        self.join()

    def join(self):  # the newest image whose pose is known waits until the worker is ready
        found = self.joined.newest()
        if found is not None:
            with suppress(queue.Empty):
                self.newest.get_nowait()
            self.newest.put(found)

    def work(self):
        while (found := self.newest.get()) is not None:
            try:
                self.look(*found)
            except Exception as fault:  # a robot drives on
                self.warn(f"{getattr(fault, 'message', fault)}; the image is left out")

    def look(self, stamp, image, pose):
        self.closer = self.closer or self.begin(image)
        for loop in self.closer.add(messages.image_of(image), stamp, pose):
            self.tell_loop(loop)

    def begin(self, image):
        rectified = messages.is_rectified(self.resolve_topic_name("image"))
        camera, mount = messages.camera_of(self.camera, rectified), self.mount
        if camera is None:
            raise ValueError("camera_info has no calibration yet of a pinhole or fisheye camera")
        if not any(mount[3:]):
            mount = messages.pose_of(self.buffer.lookup_transform(self.odom_frames[1], image.header.frame_id, Time()))
        return LoopCloser(self.detector, camera, mount, self.set["step"], self.set["turn"], self.warn).start()

    def stamped(self, kind, stamp):
        message = kind()
        message.header.stamp, message.header.frame_id = stamp, self.set["map"]
        return message

    def tell_loop(self, loop):
        message = self.stamped(PoseWithCovarianceStamped, Time(seconds=self.closer.stamp(loop.query)).to_msg())
        pose, covariance = self.closer.by_loop(loop)
        fill(message.pose.pose.position, message.pose.pose.orientation, pose)
        message.pose.covariance = covariance.ravel().tolist()
        self.loops.publish(message)

    def tell(self):  # ten times a second: the transform, and the path if it was corrected again
        if self.closer is None:
            return
        message = self.stamped(TransformStamped, self.get_clock().now().to_msg())
        message.child_frame_id = self.odom_frames[0]
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
