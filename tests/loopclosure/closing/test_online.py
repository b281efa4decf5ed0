"""Loops closed while a robot drives: a bag of a rendered robot whose wheels drift, and slip in one corner."""

import re
import time
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lmdb_build.cli import main as lmdb_build
from loopclosure.cli import main as loopclosure
from loopclosure.closing import online
from loopclosure.closing.close import DEPTH_SIGMAS, ate_rmse_m, drifted, path_of, steps_between, write_closed
from loopclosure.closing.graph import Solution, solve
from loopclosure.closing.measure import CHECK, Loop
from loopclosure.closing.online import STILL, UNKNOWN, LoopCloser, after
from loopclosure.closing.relative import METRIC, ROTATION_ONLY, Relative
from loopclosure.closing.synchronizer import Synchronizer
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.export import LOOP_SIGMAS, relative_pose
from loopclosure.errors import InputError
from loopclosure.places.frames import read_bgr
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.intrinsics import Intrinsics
from loopclosure.places.messages import camera_of, image_of, pose_of, seconds
from loopclosure.places.sequences import read_sequence

CAMERA = Intrinsics(131.25, 131.25, 79.5, 59.5, size=(160, 120))
SLIP_DEG, SLIP_M = 12.0, 0.3


def slipped(odometry: np.ndarray, at: int) -> np.ndarray:
    """Return odometry whose wheels slip at one frame: they turn less than the robot, and roll in place."""
    steps = steps_between(odometry)
    steps[at, :3] += [0, 0, SLIP_M]
    steps[at, 3:] = (Rotation.from_quat(steps[at, 3:]) * Rotation.from_euler("y", SLIP_DEG, degrees=True)).as_quat()
    return path_of(odometry[0], steps)


def write_bag(file: Path, sequence: ImageSequence, odometry: np.ndarray) -> None:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = {name.rsplit("/")[-1]: kind for name, kind in store.types.items()}
    kinds = {"/image": "sensor_msgs/msg/Image", "/camera_info": "sensor_msgs/msg/CameraInfo"}
    kinds |= {"/odom": "nav_msgs/msg/Odometry", "/ground_truth/pose": "geometry_msgs/msg/PoseStamped"}
    zero, none = make["Vector3"](x=0.0, y=0.0, z=0.0), np.zeros(36)
    camera = sequence.camera
    assert camera is not None
    assert sequence.stamps is not None
    assert sequence.poses is not None
    with Writer(file, version=9) as writer:
        opened = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}

        def write(topic: str, stamp: float, message: Any) -> None:
            writer.write(opened[topic], round(stamp * 1e9), store.serialize_cdr(message, kinds[topic]))

        def pose_of_row(row: list[float]) -> Any:
            point = make["Point"](x=row[0], y=row[1], z=row[2])
            return make["Pose"](point, make["Quaternion"](x=row[3], y=row[4], z=row[5], w=row[6]))

        paths = (odometry.tolist(), sequence.poses.tolist())
        for image, stamp, pose, true in zip(sequence.paths, sequence.stamps.tolist(), *paths, strict=True):
            pixels = read_bgr(image)
            height, width = pixels.shape[:2]
            at = make["Time"](sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
            header = make["Header"](stamp=at, frame_id="camera")
            k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1])
            roi = make["RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
            size = {"height": height, "width": width}
            info = {"distortion_model": "plumb_bob", "d": np.zeros(5), "k": k, "r": np.eye(3).ravel()}
            info |= {"p": np.zeros(12), "binning_x": 0, "binning_y": 0, "roi": roi}
            write("/camera_info", stamp, make["CameraInfo"](header=header, **size, **info))
            moving = make["TwistWithCovariance"](twist=make["Twist"](linear=zero, angular=zero), covariance=none)
            known = make["PoseWithCovariance"](pose=pose_of_row(pose), covariance=none)
            write("/odom", stamp, make["Odometry"](header=header, child_frame_id="base", pose=known, twist=moving))
            write("/ground_truth/pose", stamp, make["PoseStamped"](header=header, pose=pose_of_row(true)))
            row = {"encoding": "bgr8", "is_bigendian": 0, "step": 3 * width, "data": pixels.ravel()}
            write("/image", stamp, make["Image"](header=header, **size, **row))


def closer_of(camera: Intrinsics = CAMERA, **given: Any) -> LoopCloser:
    detector = LoopDetector(Thumbnailer(), check=CHECK, exclude_seconds=10)
    return LoopCloser(detector, camera, STILL, **given)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> tuple[ImageSequence, np.ndarray, Path]:
    """A rendered robot that walks around a house twice: its images, the odometry of its wheels, and a bag of both."""
    pytest.importorskip("rosbags")
    folder = tmp_path_factory.mktemp("robot")
    assert lmdb_build(["walk", str(folder / "walk"), "--frames", "64", "--laps", "2", "--size", "160x120"]) == 0
    sequence = read_sequence(folder / "walk" / "walk_1")
    assert sequence.poses is not None
    odometry = slipped(drifted(sequence.poses, 3.0, 1), 20)
    write_bag(folder / "bag", sequence, odometry)
    return sequence, odometry, folder / "bag"


@pytest.mark.slow
def test_two_commands_correct_the_path_of_a_bag(
    robot: tuple[ImageSequence, np.ndarray, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, closed = tmp_path / "found", tmp_path / "closed"
    assert loopclosure(["detect", str(robot[2]), "--describe", "small", "--out", str(found)]) == 0
    assert "median errors of the " in (found / "chosen.txt").read_text()
    line = ["close", str(robot[2]), "--loops", str(found / "loops.csv"), "--out", str(closed)]
    assert loopclosure(line) == 0
    said = capsys.readouterr().out
    print(said)
    error = re.search(r"ATE RMSE \[m\]: (\S+) before, (\S+) after", said)
    assert error is not None
    assert float(error[2]) < 0.2 * float(error[1])
    assert re.search(r"\d+ loops measured in meters, from steps of the odometry", said)
    edges = [line.split() for line in (found / "loops.g2o").read_text().splitlines() if line.startswith("EDGE")]
    assert len(edges) > len(robot[0]) + 10
    ends = np.array([edge[1:3] for edge in edges], int)
    places = relative_pose(*(robot[0].poses[ends[:, k]] for k in (0, 1))) if robot[0].poses is not None else np.zeros(0)
    off = np.linalg.norm(np.array([edge[3:6] for edge in edges], float) - places[:, :3], axis=1)
    assert np.median(off[len(robot[0]) - 1 :]) < 0.3, "a loop's edge is measured, not taken from the odometry"


@pytest.fixture(params=["whole graph", "incremental"])
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways to solve the graph."""
    if request.param == "incremental":
        pytest.importorskip("gtsam")
    else:
        monkeypatch.setattr(online, "installed", lambda: False)


@pytest.mark.slow
@pytest.mark.usefixtures("solver")
def test_a_recorded_robot_gets_a_corrected_path(robot: tuple[ImageSequence, np.ndarray, Path], tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    sequence, odometry, bag = robot
    assert sequence.poses is not None
    said: list[str] = []
    closer, joined, spent = None, Synchronizer(warn=said.append), []
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/camera_info" and closer is None:
                camera = camera_of(message)
                assert camera is not None
                closer = closer_of(camera)
                closer.start()
            stamp = seconds(message.header.stamp)
            if connection.topic == "/odom":
                joined.odometry(stamp, pose_of(message))
            elif connection.topic == "/image":
                joined.image(stamp, message)
            if (found := joined.newest()) is not None:
                assert closer is not None
                begin = time.process_time()
                closer.add(image_of(found[1]), found[0], found[2])
                spent.append(time.process_time() - begin)
    assert closer is not None
    closer.stop()
    closed = closer.closed()
    stamps, path = closer.path()
    assert len(stamps) == len(sequence)
    before, corrected = (ate_rmse_m(poses, sequence.poses) for poses in (odometry, path))
    used = int(np.count_nonzero(closed.accepted))
    assert not said
    counted = f"{used} of {len(closed.loops)} loops used, ATE {before:.3f} m before, {corrected:.3f} m after"
    print(f"{counted}, {1e3 * np.median(spent):.0f} ms per image")
    assert used >= 20
    assert corrected < 0.2 * before
    newer = after(closer.correction, odometry[-1])
    np.testing.assert_allclose(newer[:3], path[-1, :3], atol=1e-6)
    write_closed(tmp_path / "closed", closed, stamps, sequence.names)
    assert (tmp_path / "closed" / "closed.g2o").read_text().count("EDGE_SE3:QUAT") == len(sequence) - 1 + used


def at(x: float, turn_deg: float = 0.0) -> np.ndarray:
    return np.array([x, 0, 0, *Rotation.from_euler("z", turn_deg, degrees=True).as_quat()])


def test_an_image_gets_the_pose_between_two_of_the_odometry() -> None:
    said: list[str] = []
    joined = Synchronizer(gap_s=0.5, warn=said.append)
    joined.image(10.05, "a")
    assert joined.newest() is None  # nothing is known yet
    joined.odometry(10.0, at(1, 10))
    assert joined.newest() is None  # it may move on
    joined.odometry(10.1, at(2, 30))
    joined.odometry(10.06, at(9))  # late
    found = joined.newest()
    assert found is not None
    assert found[:2] == (10.05, "a")
    np.testing.assert_allclose(found[2], at(1.5, 20), atol=1e-9)
    assert joined.newest() is None
    for stamp, image in ((10.1, "b"), (10.12, "c"), (10.2, "d"), (10.3, "e")):
        joined.image(stamp, image)
    joined.odometry(10.2, at(3))
    assert joined.newest() == (10.2, "d", pytest.approx(at(3)))
    joined.odometry(11.0, at(4))
    assert joined.newest() is None
    joined.image(9.0, "before all")
    assert joined.newest() is None
    assert said == [f"the image at {t} has no odometry within 0.5 s; it is left out" for t in ("10.300000", "9.000000")]


def test_when_the_time_goes_back_the_poses_before_are_forgotten() -> None:
    said: list[str] = []
    joined = Synchronizer(warn=said.append)
    for stamp in np.arange(100, 400, 0.1):  # more than are kept
        joined.odometry(stamp, at(stamp))
    joined.image(399.55, "a")
    found = joined.newest()
    assert found is not None
    assert found[2][0] == pytest.approx(399.55)
    joined.image(600.0, "never")
    joined.odometry(50.0, at(5))
    joined.odometry(50.1, at(6))
    joined.image(50.05, "b")
    found = joined.newest()
    assert found is not None
    assert (found[1], found[2][0]) == ("b", pytest.approx(5.5))
    assert not said


def test_an_image_of_the_last_drive_gets_no_pose_of_the_next() -> None:
    joined = Synchronizer()
    for stamp in np.arange(0, 10, 0.1):
        joined.odometry(stamp, at(stamp))
    joined.image(10.05, "of the first drive")
    for stamp in np.arange(0, 10.3, 0.1):
        joined.odometry(stamp, at(100 + stamp))
        assert joined.newest() is None


def picture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    squares = [
        np.kron(rng.integers(0, 120, (120 // side, 160 // side, 3)), np.ones((side, side, 1))) for side in (8, 20)
    ]
    return np.sum(squares, axis=0).astype(np.uint8)


def test_keyframes_are_apart_by_a_step_or_a_turn() -> None:
    closer = closer_of(step_m=1.0, turn_rad=np.radians(30))
    for second, pose in enumerate((at(0), at(0.9), at(1.1), at(1.1, 29), at(1.1, 31))):
        closer.add(picture(second), second, pose)
    assert closer.path()[0].tolist() == [0, 2, 4]
    np.testing.assert_allclose(closer.path()[1], [at(0), at(1.1), at(1.1, 31)], atol=1e-12)
    assert np.isnan(closer.detector.poses).all(), "odometry is not a true pose"
    np.testing.assert_allclose(closer.detector.odometry[:, :3], [at(0)[:3], at(1.1)[:3], at(1.1)[:3]], atol=1e-12)


def test_faults_of_a_sensor_are_warned_of_and_left_out() -> None:
    said: list[str] = []
    closer = closer_of(warn=said.append)
    closer.add(picture(0), 100.0, at(0))
    closer.add(picture(1), 101.0, [np.nan] * 7)
    closer.add(picture(1), 101.0, [0] * 7)
    closer.add(picture(1), np.nan, at(1))
    closer.add(picture(1), 99.5, at(1))
    assert [text.split(",")[0].split(" is ")[0] for text in said] == [
        "the odometry at 101.000000",
        "the odometry at 101.000000",
        "the image at nan",
        "an image came late",
    ]
    assert len(closer.path()[0]) == 1
    closer.add(picture(2), 101.0, at(2))
    assert len(closer.path()[0]) == 2


@pytest.mark.usefixtures("solver")
def test_another_drive_is_no_step_of_the_odometry_and_is_joined_by_its_loops() -> None:
    """A recording that starts again: the robot is somewhere else by its odometry, and sees the first place again."""
    said: list[str] = []
    closer = closer_of(warn=said.append)
    pictures = [picture(seed) for seed in range(3)]
    for number, image in enumerate(pictures):
        closer.add(image, 100.0 + number, at(number))
    for number, image in enumerate(pictures):
        closer.add(image, 50.0 + number, at(10.0 + number))
    assert said == ["the time goes back by 52.0 s, to 50.000000: another drive begins"]
    closed = closer.closed()
    assert [(step.first, step.second) for step in closed.steps] == [(0, 1), (1, 2), (3, 4), (4, 5)]
    assert [(loop.query, loop.match) for loop in closed.loops] == [(3, 0), (4, 1), (5, 2)]
    assert closed.accepted.all()
    turns = relative_pose(closed.poses[:3], closed.poses[3:])
    np.testing.assert_allclose(turns[:, 3:], np.tile(STILL[3:], (3, 1)), atol=0.02)


def test_a_jump_of_the_odometry_begins_another_drive() -> None:
    said: list[str] = []
    closer = closer_of(warn=said.append)
    for number, x in enumerate([49.5, 49.75, 50.0, 0.0, 0.25]):
        closer.add(picture(number), 100 + 0.1 * number, at(x))
    assert len(said) == 1
    assert [(step.first, step.second) for step in closer.closed().steps] == [(0, 1), (1, 2), (3, 4)]
    assert closer.detector.sessions == [0, 3]


def test_images_do_not_wait_for_a_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = Event(), Event()

    def slow(*given: Any) -> Solution:
        begun.set()
        assert go_on.wait(60)
        return solve(*given)

    closer = closer_of()
    monkeypatch.setattr(closer, "_solve", slow)
    closer.start()
    for keyframe, number in enumerate((*range(12), 0)):
        closer.add(picture(number), 20.0 * keyframe, at(keyframe))
    assert begun.wait(60)
    assert closer.add(picture(1), 260.0, at(13))
    assert (closer.solutions, len(closer.path()[0])) == (0, 14)
    go_on.set()
    closer.stop()
    assert closer.solutions >= 1


def test_a_detector_with_frames_or_without_a_check_is_refused() -> None:
    used = LoopDetector(None, check=CHECK)
    used.add_descriptor(np.ones(3), image=picture(0))
    for detector in (used, LoopDetector(None, check=None)):
        with pytest.raises(InputError, match="the detector must be empty and have a check"):
            LoopCloser(detector, CAMERA)


def test_the_covariance_of_a_loop_is_about_the_axes_of_the_map() -> None:
    """Of a loop that is sure ahead of a camera turned to the left, and of one that measures its rotation alone."""
    closer = closer_of()
    closer.add(picture(0), 0.0, at(0, 90))
    closer.add(picture(1), 20.0, at(1, 90))
    sigmas = np.array([0.01, 0.3, 0.3, 0.02, 0.02, 0.02])
    pose, covariance = closer.by_loop(Loop(1, 0, Relative(at(1), METRIC, 30, np.diag(sigmas**2), "depth")))
    np.testing.assert_allclose(pose[:3], [0, 1, 0], atol=1e-9)
    common = DEPTH_SIGMAS.translation_m**2
    np.testing.assert_allclose(np.diag(covariance)[:3], [0.3**2 + common, 0.01**2 + common, 0.3**2 + common])
    _, covariance = closer.by_loop(Loop(1, 0, Relative(at(0), ROTATION_ONLY, 30, np.diag([0, 0, 0, *sigmas[3:] ** 2]))))
    np.testing.assert_allclose(np.diag(covariance)[:3], UNKNOWN)
    np.testing.assert_allclose(np.diag(covariance)[3:], 0.02**2 + LOOP_SIGMAS.rotation_rad**2)
