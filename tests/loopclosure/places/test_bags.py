"""Images, poses, odometry and calibration from ROS 1 and ROS 2 bags, written with the library that reads them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from graphs import read_graph
from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.places.bags import Topics, is_odometry, open_bag, right
from loopclosure.places.frames import live_frames
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.sequences import read_sequence
from loopclosure.places.source import Source, extract, open_sequence
from places_layouts import COUNT, path, picture, quaternions

pytest.importorskip("rosbags")
from faults.recordings import read_bag
from places_bags import START_S, Bag


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ros", "encoding"), [("a.bag", 1, "rgb8"), ("b", 2, "bgr8"), ("c.bag", 1, "png"), ("d", 2, "png")]
)
def test_a_bag_becomes_a_sequence(name: str, ros: int, encoding: str, tmp_path: Path) -> None:
    bag = Bag(tmp_path / name, ros, encoding, amcl=True).file
    extracted = extract(bag, tmp_path / "frames")
    assert extracted.said == (
        f"{bag}: 48 frames of /cam/image, poses of /amcl_pose, taken as the camera's, odometry of /odom, "
        f"moved from base to camera: {extracted.folder}"
    )
    sequence = read_sequence(extracted.folder)
    assert len(sequence) == COUNT
    image = cv2.imread(str(sequence.paths[7]))
    np.testing.assert_array_equal(image, picture(7))
    assert sequence.stamps is not None
    assert sequence.stamps[7] == START_S + 7
    for found in (sequence.poses, sequence.odometry):
        assert found is not None
        np.testing.assert_allclose(found[:, :3], path()[:, :3, 3], atol=1e-5)
        np.testing.assert_allclose(np.abs(np.sum(found[:, 3:] * quaternions(path()), axis=1)), 1, atol=1e-5)
    assert sequence.camera is not None
    assert (sequence.camera.fy, sequence.camera.distortion[:2]) == (28.25, (0.1, -0.2))
    assert extract(bag, tmp_path / "frames").said == f"{bag}: its frames are in {extracted.folder} already"


def test_a_dark_image_of_16_bits_stays_dark(tmp_path: Path) -> None:
    with open_bag(Bag(tmp_path / "a.bag", 1, "mono16", count=4).file) as bag:
        for i, (_, _, image) in enumerate(bag.images()):
            gray = np.asarray(cv2.cvtColor(picture(i), cv2.COLOR_BGR2GRAY), np.uint8)
            np.testing.assert_array_equal(image[..., 0], gray // 8 if i % 2 else gray)


def opened(file: Path, out: Path, **settings: str) -> ImageSequence:
    return open_sequence(Source("", file, {name.replace("_", "-"): text for name, text in settings.items()}), out)[0]


def drifting(i: int, pose: np.ndarray) -> np.ndarray:
    return pose + np.array([[0, 0, 0, i], *np.zeros((3, 4))])


def test_odometry_is_not_the_truth(tmp_path: Path) -> None:
    """The wheels drift by a meter a frame: they are odometry, and nothing is judged by them unless they are named."""
    sequence = opened(Bag(tmp_path / "a.bag", 1, "mono8", odometry=drifting).file, tmp_path / "a")
    assert sequence.poses is None
    assert sequence.odometry is not None
    assert sequence.odometry[40, 0] == pytest.approx(path()[40, 0, 3] + 40, abs=1e-5)
    with pytest.raises(InputError, match=r"has odometry, but no true poses; .* name its topic in pose-topic="):
        sequence.with_poses()
    named = opened(tmp_path / "a.bag", tmp_path / "b", pose_topic="/odom")
    assert named.odometry is None
    poses = named.with_poses().poses
    assert poses is not None
    np.testing.assert_allclose(poses[:, :3], sequence.odometry[:, :3])


def test_the_type_and_the_name_tell_odometry_from_poses() -> None:
    odometry, pose = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
    for topic in ("/odom", "/wheels", "/camera/odom/sample"):
        assert is_odometry(topic, odometry)
    for topic in ("/vio/pose", "/vins_estimator/camera_pose", "/orb_slam3/camera_pose", "/odometry/filtered"):
        assert is_odometry(topic, pose)
    for topic in (
        "/ground_truth/odom",
        "/gt",
        "/mocap/body/odom",
        "/vrpn_client_node/robot/pose",
        "/robot/ground_truth",
    ):
        assert not is_odometry(topic, odometry)
    for topic in ("/amcl_pose", "/vicon/firefly/firefly", "/leica/pose", "/pose"):
        assert not is_odometry(topic, pose)


def test_several_topics_with_poses_stop_only_what_needs_poses(tmp_path: Path) -> None:
    file = Bag(tmp_path / "a.bag", 1, "mono8", count=3, amcl=True).file
    data = file.read_bytes().replace(b"/odom", b"/mocp").replace(b"nav_msgs/Odometry", b"nav_msgs/Odometry")
    file.write_bytes(data)
    with pytest.raises(InputError, match="has odometry"):  # /mocp is an Odometry
        opened(file, tmp_path / "a", odometry_topic="/amcl_pose").with_poses()
    file.write_bytes(data.replace(b"/mocp", b"/a_gt"))
    for _ in range(2):  # also from the folder that was written before
        sequence = opened(file, tmp_path / "b")
        assert len(sequence) == 3
        (remark,) = sequence.remarks()
        assert "has several topics with poses: /a_gt, /amcl_pose; choose one with pose-topic=" in remark
        with pytest.raises(InputError, match="has several topics with poses: /a_gt, /amcl_pose; choose one"):
            sequence.with_poses()
    assert opened(file, tmp_path / "c", pose_topic="/a_gt").known.all()


DAY = 1_700_000_000.0


@pytest.mark.parametrize(
    ("stamps", "good"),
    [
        pytest.param([0.5, 1, 2], True, id="since the start"),
        pytest.param([0, 0, 1, 2], True, id="simulation"),
        pytest.param([DAY, DAY, DAY + 1], True, id="two of one time"),
        pytest.param([0, DAY, DAY + 1], False, id="no stamp at first"),
        pytest.param([DAY, 0, DAY + 1], False, id="no stamp"),
        pytest.param([DAY, DAY + 900, DAY + 1], False, id="clock set back"),
        pytest.param([0, 0, 0], False, id="standing at 0"),
        pytest.param([DAY, DAY, DAY], False, id="standing at a date"),
        pytest.param([DAY], True, id="one"),
    ],
)
def test_what_stamps_are_times(stamps: list[float], good: bool) -> None:
    assert right(np.array(stamps, float)) == good


@pytest.mark.parametrize("ros", [1, 2])
def test_with_a_wrong_stamp_all_times_are_those_of_receipt(ros: int, tmp_path: Path) -> None:
    name = "a.bag" if ros == 1 else "a"
    file = Bag(tmp_path / name, ros, "mono8", count=12, stamp=lambda i: 0.0 if i == 3 else START_S + i - 3.0).file
    sequence = opened(file, tmp_path / "frames")
    assert sequence.stamps is not None
    assert sequence.stamps.tolist() == [START_S + i for i in range(12)]
    assert any("times of receipt" in remark for remark in sequence.doubts)
    assert sequence.odometry is not None
    np.testing.assert_allclose(sequence.odometry[:, :3], path()[:12, :3, 3], atol=1e-5)
    assert [stamp for stamp, _ in live_frames(str(file))] == sequence.stamps.tolist()


def test_odometry_of_nan_is_no_odometry_there(tmp_path: Path) -> None:
    def faulty(i: int, pose: np.ndarray) -> np.ndarray:
        return pose * np.nan if i == 2 else pose

    sequence = opened(Bag(tmp_path / "a.bag", 1, "mono8", count=4, odometry=faulty).file, tmp_path / "frames")
    assert sequence.odometry is not None
    assert np.flatnonzero(np.isnan(sequence.odometry[:, 0])).tolist() == [2]
    assert sequence.doubts == (f"{tmp_path}/a.bag: poses of /odom that are NaN or no rotation, left out: 1 of 4",)


def test_a_folder_of_bags_is_one_recording(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    for name, begin in (("x_1.bag", 6), ("x_0.bag", 0)):
        later = {"stamp": lambda i, begin=begin: START_S + begin + i, "begin": begin}
        Bag(tmp_path / "parts" / name, 1, "mono8", count=3, **later)
    parts = opened(tmp_path / "parts", tmp_path / "frames")
    assert parts.stamps is not None
    assert parts.stamps.tolist() == [START_S + i for i in (0, 1, 2, 6, 7, 8)]


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_file_of_a_bag_of_ros_2_is_read(storage: str, tmp_path: Path) -> None:
    folder = Bag(tmp_path / "two", 2, "mono8", count=3, storage=storage).file
    assert len(opened(folder, tmp_path / "a")) == 3
    (folder / "metadata.yaml").unlink()
    (file,) = folder.iterdir()
    assert len(opened(file, tmp_path / "b")) == 3
    assert len(opened(folder, tmp_path / "c")) == 3
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(InputError, match="ros2 bag reindex"):
        opened(file, tmp_path / "d")


@pytest.mark.slow
def test_a_damaged_bag_is_reported_in_one_line(tmp_path: Path) -> None:
    """Damage in the index, in a header, in a message, in the text file next to it."""
    whole = Bag(tmp_path / "whole.bag", 1, "mono8", count=3).file.read_bytes()
    folder = Bag(tmp_path / "two", 2, "mono8", count=3).file
    text = (folder / "metadata.yaml").read_text()
    damaged = {tmp_path / f"{at}.bag": whole[:at] + b"\xff\xff" + whole[at + 2 :] for at in range(20, len(whole), 997)}
    damaged |= {tmp_path / f"{word}.bag": whole.replace(word.encode(), b"xx") for word in ("op=", "topic=", "frame")}
    refused = 0
    for file, data in damaged.items():
        file.write_bytes(data)
        refused += is_refused(file)
    assert refused > 5
    for old, new in (("nanoseconds_since_epoch", "'data'"), ("storage_identifier", "other"), ("files:", "files: 7 #")):
        (folder / "metadata.yaml").write_text(text.replace(old, new))
        assert is_refused(folder) or old == "files:"
    (folder / "metadata.yaml").write_text(text)
    (folder / "two.db3").write_bytes((folder / "two.db3").read_bytes()[:9000])
    assert is_refused(folder)


def is_refused(file: Path) -> bool:
    try:
        read_bag(file)
    except InputError:
        return True
    return False


def test_errors_of_the_caller_of_a_bag_are_passed_on(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "a.bag", 1, count=1).file
    with pytest.raises(ZeroDivisionError), open_bag(bag):
        raise ZeroDivisionError


@pytest.mark.slow
def test_one_of_several_topics_must_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "two.bag", 1, second_camera=True).file
    with pytest.raises(
        InputError, match="several topics with images: /cam/image, /other/image; choose one with topic="
    ):
        extract(bag, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()
    with pytest.raises(InputError, match='has no topic "/odom" with images; there are: /cam/image, /other/image'):
        extract(bag, tmp_path / "frames", Topics("/odom"))
    assert "48 frames of /other/image" in extract(bag, tmp_path / "frames", Topics("/other/image")).said


def test_other_files_than_bags_are_reported_in_one_line(tmp_path: Path) -> None:
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
def test_the_commands_accept_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = Bag(tmp_path / "drive.bag", 1, amcl=True, odometry=drifting).file
    line = f"evaluate {bag} --method thumbnails --out {tmp_path / 'report'}"
    assert main(line.split()) == 0
    line = f"detect {bag} --exclude-recent 10 --out {tmp_path / 'found'}"
    assert main(line.split()) == 0
    assert "loops are the same place by their poses" in (tmp_path / "found" / "chosen.txt").read_text()
    vertices, edges = read_graph(tmp_path / "found" / "loops.g2o")
    assert len(vertices) == COUNT
    assert vertices[40][0] == pytest.approx(path()[40, 0, 3] + 40, abs=1e-4)  # the odometry
    assert all(edge.second == edge.first + 1 for edge in edges)  # small pictures without points: no loop is measured
