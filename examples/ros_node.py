"""A ROS 1 node: images and odometry in, loops and the corrected path out.

    python examples/ros_node.py image:=/camera/image_raw odom:=/odom _camera:=525,525,319.5,239.5

in   image  sensor_msgs/Image (bgr8, rgb8, mono8);  odom  nav_msgs/Odometry
out  loops  geometry_msgs/PoseWithCovarianceStamped: the position of the robot by a loop, on the corrected path
     path   nav_msgs/Path: all keyframes, corrected, after each loop
parameters  ~camera FX,FY,CX,CY[,...];  ~describe (default);  ~mount x,y,z,qx,qy,qz,qw of the camera in the robot;
            ~step, ~turn: meters or radians between keyframes;  ~recent: no loops with the last so many seconds
"""

import queue
from contextlib import suppress

import numpy as np
import rospy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image

from loopclosure import LoopDetector
from loopclosure.closing.close import close
from loopclosure.closing.measure import CHECK, Loop
from loopclosure.closing.relative import METRIC, ROTATION_ONLY, View, relative_view
from loopclosure.detector.export import LOOP_SIGMAS
from loopclosure.detector.run import load_describe
from loopclosure.places.intrinsics import from_text

FORWARD = "0,0,0,-0.5,0.5,-0.5,0.5"  # a camera that looks forward: its z axis is the robot's x axis
UNKNOWN = 1e6  # variance of dimensions that a loop does not measure


def after(pose, step):  # a pose (7,), tx ty tz qx qy qz qw, and one in its frame -> that in the world
    turn = Rotation.from_quat(pose[3:])
    return np.concatenate([pose[:3] + turn.apply(step[:3]), (turn * Rotation.from_quat(step[3:])).as_quat()])


def inverse(pose):
    back = Rotation.from_quat(pose[3:]).inv()
    return np.concatenate([-back.apply(pose[:3]), back.as_quat()])


def numbers(pose):  # of a geometry_msgs/Pose
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def set_pose(pose, values):
    for part, names, some in ((pose.position, "xyz", values[:3]), (pose.orientation, "xyzw", values[3:])):
        for name, value in zip(names, some, strict=True):
            setattr(part, name, float(value))


def pixels(message):
    channels = {"bgr8": 3, "rgb8": 3, "mono8": 1}[message.encoding]
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return np.ascontiguousarray({"bgr8": image, "rgb8": image[..., ::-1]}.get(message.encoding, image.repeat(3, 2)))


class Node:
    def __init__(self):
        self.camera = from_text(rospy.get_param("~camera"))
        self.mount = np.array([float(x) for x in rospy.get_param("~mount", FORWARD).split(",")])
        self.step, self.turn = rospy.get_param("~step", 0.1), rospy.get_param("~turn", 0.1)
        describe, recent = load_describe(rospy.get_param("~describe", "default")), float(rospy.get_param("~recent", 10))
        self.detector = LoopDetector(describe, check=CHECK, exclude_recent=0, exclude_seconds=recent)
        self.measured, self.stamps, self.views = [], [], []
        self.odometry, self.images = None, queue.Queue(1)
        self.loops = rospy.Publisher("loops", PoseWithCovarianceStamped, queue_size=10)
        self.path = rospy.Publisher("path", Path, queue_size=1, latch=True)
        rospy.Subscriber("odom", Odometry, self.on_odometry, queue_size=100)
        rospy.Subscriber("image", Image, self.on_image, queue_size=1, buff_size=1 << 24)

    def on_odometry(self, message):
        self.odometry = numbers(message.pose.pose)

    def on_image(self, message):  # the newest image and the robot's position; another thread processes them
        if self.odometry is not None:
            with suppress(queue.Empty):
                self.images.get_nowait()
            self.images.put((message, after(self.odometry, self.mount)))

    def run(self):
        rospy.loginfo("ready")
        while not rospy.is_shutdown():
            with suppress(queue.Empty):
                self.look(*self.images.get(timeout=0.2))

    def look(self, message, pose):
        if self.stamps:
            moved = after(inverse(self.detector.poses[-1]), pose)
            if np.linalg.norm(moved[:3]) < self.step and Rotation.from_quat(moved[3:]).magnitude() < self.turn:
                return
        image = pixels(message)
        result = self.detector.add(image, message.header.stamp.to_sec(), pose)
        self.stamps.append(message.header.stamp)
        camera = self.camera.of_size(message.width, message.height)
        self.views.append(View(self.detector.local_features(result.query_id), camera))
        if result:  # true only if the loop was accepted
            match, query = self.views[result.accepted], self.views[-1]
            relative = relative_view(match, query, CHECK.matches(match.local, query.local))
            if relative is not None:
                self.measured.append(Loop(result.query_id, result.accepted, relative))
                self.publish(self.measured[-1])

    def publish(self, loop):
        closed = close(self.detector.poses, self.measured)
        header = rospy.Header(stamp=self.stamps[loop.query], frame_id="map")
        path = Path(header=header)
        for stamp, pose in zip(self.stamps, closed.poses, strict=True):
            path.poses.append(PoseStamped(header=rospy.Header(stamp=stamp, frame_id="map")))
            set_pose(path.poses[-1].pose, after(pose, inverse(self.mount)))
        message = PoseWithCovarianceStamped(header=header)
        camera = after(closed.poses[loop.match], loop.relative.pose)
        if loop.relative.kind != METRIC:  # the length of the step is not known; use the corrected path
            camera[:3] = closed.poses[loop.query, :3]
        set_pose(message.pose.pose, after(camera, inverse(self.mount)))
        place = UNKNOWN if loop.relative.kind == ROTATION_ONLY else LOOP_SIGMAS.translation_m**2
        message.pose.covariance = np.diag([place] * 3 + [LOOP_SIGMAS.rotation_rad**2] * 3).ravel().tolist()
        self.loops.publish(message)
        self.path.publish(path)


if __name__ == "__main__":
    rospy.init_node("loopclosure")
    Node().run()
