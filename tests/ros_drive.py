"""Plays a sequence to examples/ros_node.py, like a robot, and saves its answers: SEQUENCE ODOMETRY.npy OUT.npz.

Started by tests/test_ros_node.py with ROS's packages behind the others.
"""

import sys
import threading
import time

import numpy as np
import rospy  # pyright: ignore[reportMissingImports]
from geometry_msgs.msg import PoseWithCovarianceStamped  # pyright: ignore[reportMissingImports]
from nav_msgs.msg import Odometry, Path  # pyright: ignore[reportMissingImports]
from sensor_msgs.msg import Image  # pyright: ignore[reportMissingImports]

from loopclosure.places.frames import read_bgr
from loopclosure.places.sequences import read_sequence

SECONDS = 60  # in which the node must have looked at all images


def numbers(pose):
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def image_message(path, stamp):
    image = read_bgr(path)[..., ::-1]
    made = Image(height=image.shape[0], width=image.shape[1], encoding="rgb8", step=3 * image.shape[1])
    made.data, made.header.stamp = image.tobytes(), stamp
    return made


def main(folder, odometry, out):
    rospy.init_node("drive")
    sequence, poses = read_sequence(folder), np.load(odometry)
    loops, paths, came = [], [], threading.Event()
    subscribers = [
        rospy.Subscriber("loops", PoseWithCovarianceStamped, loops.append),
        rospy.Subscriber("path", Path, lambda message: (paths.append(message), came.set())),
    ]
    odom = rospy.Publisher("odom", Odometry, queue_size=100)
    images = rospy.Publisher("image", Image, queue_size=100)
    while not (odom.get_num_connections() and images.get_num_connections()):
        time.sleep(0.1)
    for i, path in enumerate(sequence.paths):
        stamp = rospy.Time.from_sec(1000 + i / 2)
        message = Odometry()
        message.header.stamp = stamp
        for part, names, values in (
            (message.pose.pose.position, "xyz", poses[i, :3]),
            (message.pose.pose.orientation, "xyzw", poses[i, 3:]),
        ):
            for name, value in zip(names, values, strict=True):
                setattr(part, name, float(value))
        odom.publish(message)
        time.sleep(0.05)
        images.publish(image_message(path, stamp))
        time.sleep(0.45)
    end = time.monotonic() + SECONDS
    while not paths and time.monotonic() < end:
        came.wait(1)
    time.sleep(3)
    last = paths[-1].poses if paths else []
    np.savez(
        out,
        loops=np.array([numbers(loop.pose.pose) for loop in loops]).reshape(-1, 7),
        variances=np.array([np.diag(np.reshape(loop.pose.covariance, (6, 6))) for loop in loops]).reshape(-1, 6),
        path=np.array([numbers(pose.pose) for pose in last]).reshape(-1, 7),
        stamps=np.array([pose.header.stamp.to_sec() for pose in last]),
    )
    assert subscribers


if __name__ == "__main__":
    main(*sys.argv[1:])
