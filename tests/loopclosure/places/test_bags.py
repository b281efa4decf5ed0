"""Images, poses, odometry and calibration from ROS 1 and ROS 2 bags, written with the library that reads them."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.closing.g2o import read_pose_graph
from loopclosure.errors import InputError
from loopclosure.places.bags import Topics, is_odometry, open_bag
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
        f"{bag}: 48 frames of /cam/image, poses of /amcl_pose are taken as the camera's, odometry of /odom, "
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
    np.testing.assert_array_equal(named.with_poses().poses, sequence.odometry)


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


@pytest.mark.parametrize("ros", [1, 2])
def test_stamps_that_are_0_or_go_back_are_times_of_receipt(ros: int, tmp_path: Path) -> None:
    """The clock of the camera is 3 s late; some of its stamps are 0 or of another day."""
    faulty = {3: 0.0, 4: 0.0, 6: START_S - 86_400.0, 9: START_S + 5_000.0}
    file = Bag(
        tmp_path / ("a.bag" if ros == 1 else "a"),
        ros,
        "mono8",
        count=12,
        stamp=lambda i: faulty.get(i, START_S + i - 3.0),
    ).file
    sequence = opened(file, tmp_path / "frames")
    assert sequence.stamps is not None
    assert sequence.stamps.tolist() == [START_S + i - 3 for i in range(12)]
    topics = [remark.split(" that are 0")[0].rsplit(" ")[-1] for remark in sequence.doubts]
    assert topics == ["/cam/image", "/odom"]
    assert all(remark.endswith("by the time of receipt: 4 of 12") for remark in sequence.doubts)
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


def test_bags_by_other_names_are_read(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    for name in ("A.BAG", "b.bag.active", "recording"):
        made = Bag(tmp_path / "made.bag", 1, "mono8", count=2).file
        assert len(opened(made.rename(tmp_path / name), tmp_path / f"frames of {name}")) == 2
    for name, begin in (("x_10.bag", 6), ("x_9.bag", 0)):
        Bag(
            tmp_path / "parts" / name,
            1,
            "mono8",
            count=3,
            stamp=lambda i, begin=begin: START_S + begin + i,
            begin=begin,
        )
    parts = opened(tmp_path / "parts", tmp_path / "frames")
    assert parts.stamps is not None
    assert parts.stamps.tolist() == [START_S + i for i in (0, 1, 2, 6, 7, 8)]
    Bag(tmp_path / "parts" / "again.bag", 1, "mono8", count=3)
    with pytest.raises(InputError, match="several bags that were recorded at the same time; name one of them: again"):
        opened(tmp_path / "parts", tmp_path / "frames 2")


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_bags_of_ros_2_without_metadata_are_read(storage: str, tmp_path: Path) -> None:
    folder = Bag(tmp_path / "two", 2, "mono8", count=3, storage=storage).file
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(re.sub("storage_identifier: .*", "storage_identifier: ''", text))
    assert len(opened(folder, tmp_path / "a")) == 3
    metadata.unlink()
    assert len(opened(folder, tmp_path / "b")) == 3
    (file,) = folder.iterdir()
    assert len(opened(file, tmp_path / "c")) == 3
    packed = file.rename(f"{file}.zstd")
    with pytest.raises(InputError, match=r"is compressed, and has no metadata.yaml beside it; run zstd -d two"):
        opened(packed, tmp_path / "d")


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
    line = f"detect {bag} --threshold -0.001 --exclude-recent 10 --out {tmp_path / 'found'}"
    assert main(line.split()) == 0
    assert "24 of 24 loops are the same place by their poses" in capsys.readouterr().out
    graph = read_pose_graph(tmp_path / "found" / "loops.g2o")
    assert len(graph.poses) == COUNT
    assert graph.poses[40, 0] == pytest.approx(path()[40, 0, 3] + 40, abs=1e-4)  # the odometry
    assert not graph.loops  # small pictures without points: no loop is measured
