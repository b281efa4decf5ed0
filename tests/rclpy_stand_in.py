"""A stand-in for rclpy and what a node uses beside it, after their documentation: docs.ros.org, Jazzy.

``installed(monkeypatch)`` puts it in the place of the packages. Messages have the fields of their definitions, with
zeros. The callbacks of a node are in ``subscriptions`` and ``timers``; what it publishes and logs is in lists.
"""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest


class Message:
    """A message; a field that is a message of its own is made anew."""

    fields: ClassVar[dict[str, Any]] = {}

    def __init__(self, **given: Any) -> None:
        for name, make in self.fields.items():
            setattr(self, name, make())
        for name, value in given.items():
            assert name in self.fields, f"{type(self).__name__} has no field {name}"
            setattr(self, name, value)


def message(name: str, **fields: Any) -> Any:
    return type(name, (Message,), {"fields": fields})


Stamp = message("Time", sec=int, nanosec=int)
Header = message("Header", stamp=Stamp, frame_id=str)
Point = message("Point", x=float, y=float, z=float)
Quaternion = message("Quaternion", x=float, y=float, z=float, w=float)
Pose = message("Pose", position=Point, orientation=Quaternion)
PoseStamped = message("PoseStamped", header=Header, pose=Pose)
WithCovariance = message("PoseWithCovariance", pose=Pose, covariance=lambda: [0.0] * 36)
PoseWithCovarianceStamped = message("PoseWithCovarianceStamped", header=Header, pose=WithCovariance)
Transform = message("Transform", translation=Point, rotation=Quaternion)
TransformStamped = message("TransformStamped", header=Header, child_frame_id=str, transform=Transform)
Odometry = message("Odometry", header=Header, child_frame_id=str, pose=WithCovariance)
Path = message("Path", header=Header, poses=list)
Image = message("Image", header=Header, height=int, width=int, encoding=str, is_bigendian=int, step=int, data=bytes)
CameraInfo = message(
    "CameraInfo", header=Header, height=int, width=int, distortion_model=str, d=list, k=lambda: [0.0] * 9
)


class Time:
    def __init__(self, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = round(seconds * 1e9) + nanoseconds

    def to_msg(self) -> Any:
        return Stamp(sec=self.nanoseconds // 10**9, nanosec=self.nanoseconds % 10**9)


class Publisher:
    def __init__(self, kind: type, topic: str) -> None:
        self.kind, self.topic, self.sent = kind, topic, []

    def publish(self, sent: Any) -> None:
        assert isinstance(sent, self.kind)
        self.sent.append(sent)


class Node:
    given: ClassVar[dict[str, Any]] = {}  # parameters by name

    def __init__(self, name: str) -> None:
        self.name, self.publishers, self.subscriptions, self.timers, self.warnings = name, {}, {}, [], []

    def declare_parameter(self, name: str, value: Any) -> Any:
        found = self.given.get(name, value)
        assert type(found) is type(value), name
        return SimpleNamespace(value=found)

    def create_publisher(self, kind: type, topic: str, qos_profile: Any) -> Publisher:
        assert qos_profile is not None
        self.publishers[topic] = Publisher(kind, topic)
        return self.publishers[topic]

    def create_subscription(self, msg_type: type, topic: str, callback: Any, qos_profile: Any) -> None:
        assert qos_profile is not None
        self.subscriptions[topic] = (msg_type, callback)

    def create_timer(self, timer_period_sec: float, callback: Any) -> None:
        assert timer_period_sec > 0
        self.timers.append(callback)

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.warnings.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: Time(seconds=5.0))

    def destroy_node(self) -> None:
        pass


class TransformBroadcaster:
    def __init__(self, node: Node) -> None:
        self.sent: list[Any] = []

    def sendTransform(self, transform: Any) -> None:
        assert isinstance(transform, TransformStamped)
        self.sent.append(transform)


class TransformException(Exception):
    pass


class Buffer:
    known: ClassVar[dict[tuple[str, str], Message]] = {}

    def lookup_transform(self, target_frame: str, source_frame: str, time: Time) -> Message:
        if (target_frame, source_frame) not in self.known:
            raise TransformException(f'"{target_frame}" passed to lookupTransform does not exist')
        return self.known[target_frame, source_frame]


def module(monkeypatch: pytest.MonkeyPatch, name: str, **parts: Any) -> ModuleType:
    made = ModuleType(name)
    made.__dict__.update(parts)
    monkeypatch.setitem(sys.modules, name, made)
    return made


def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the stand-in in the place of the packages."""
    stop = type("ExternalShutdownException", (Exception,), {})
    profile = lambda **settings: settings  # noqa: E731
    durability = SimpleNamespace(TRANSIENT_LOCAL="transient local")
    parts: dict[str, Any] = {
        "node": {"Node": Node},
        "executors": {"ExternalShutdownException": stop},
        "qos": {"QoSProfile": profile, "DurabilityPolicy": durability, "qos_profile_sensor_data": {"depth": 5}},
        "time": {"Time": Time},
    }
    modules = {name: module(monkeypatch, f"rclpy.{name}", **given) for name, given in parts.items()}
    module(monkeypatch, "rclpy", init=lambda: None, spin=lambda node: None, try_shutdown=lambda: None, **modules)
    module(
        monkeypatch,
        "tf2_ros",
        TransformBroadcaster=TransformBroadcaster,
        Buffer=Buffer,
        TransformListener=lambda buffer, node: (buffer, node),
        TransformException=TransformException,
    )
    kinds = {
        "geometry_msgs": (PoseStamped, PoseWithCovarianceStamped, TransformStamped),
        "nav_msgs": (Odometry, Path),
        "sensor_msgs": (CameraInfo, Image),
    }
    for package, made in kinds.items():
        messages = module(monkeypatch, f"{package}.msg", **{kind.__name__: kind for kind in made})
        module(monkeypatch, package, msg=messages)
